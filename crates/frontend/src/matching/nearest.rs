//! The two best scores of each row and each column of a product that is never stored.

/// Below every score; a lane that holds no descriptor scores less still.
const NOTHING: i32 = -(1 << 28);

/// The nearest neighbour of a descriptor, by squared Euclidean distance between bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Neighbour {
    /// The nearest descriptor, or `None` when there is none or when two are equally near.
    pub index: Option<u32>,
    /// Squared distance to it; `u32::MAX` when there is none.
    pub distance_squared: u32,
    /// Squared distance to the second nearest; `u32::MAX` when there is none.
    pub second_squared: u32,
}

/// Nearest neighbours in both directions, from one pass.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Nearest {
    /// For each descriptor of the first image, its neighbour in the second.
    pub rows: Vec<Neighbour>,
    /// For each descriptor of the second image, its neighbour in the first.
    pub columns: Vec<Neighbour>,
}

/// Best and second best score of each lane. A score is minus a squared distance, so the greatest is best.
pub(super) struct Best {
    pub(super) first: Vec<i32>,
    pub(super) second: Vec<i32>,
    at: Vec<u32>,
}

impl Best {
    pub(super) fn new(num_lanes: usize) -> Self {
        Self { first: vec![NOTHING; num_lanes], second: vec![NOTHING; num_lanes], at: vec![0; num_lanes] }
    }

    /// Takes the score of `lane` with `other` into account.
    #[inline]
    pub(super) fn offer(&mut self, lane: usize, other: usize, score: i32) {
        if score > self.first[lane] {
            self.second[lane] = self.first[lane];
            self.first[lane] = score;
            self.at[lane] = other as u32;
        } else if score > self.second[lane] {
            self.second[lane] = score;
        }
    }

    /// Squared distance to the second nearest so far.
    pub(super) fn second_squared(&self, lane: usize) -> u32 {
        squared_distance(self.second[lane])
    }

    /// The neighbours in the order that the descriptors came in: `order` is that of these lanes, `others` of the other side.
    pub(super) fn neighbours(&self, order: &[u32], others: &[u32]) -> Vec<Neighbour> {
        let nobody = Neighbour { index: None, distance_squared: u32::MAX, second_squared: u32::MAX };
        let mut neighbours = vec![nobody; order.len()];
        for (lane, &source) in order.iter().enumerate() {
            let (first, second) = (self.first[lane], self.second[lane]);
            neighbours[source as usize] = Neighbour {
                index: (first > second).then(|| others.get(self.at[lane] as usize).copied()).flatten(),
                distance_squared: squared_distance(first),
                second_squared: squared_distance(second),
            };
        }
        neighbours
    }
}

fn squared_distance(score: i32) -> u32 {
    if score <= NOTHING { u32::MAX } else { score.unsigned_abs() }
}
