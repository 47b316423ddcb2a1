//! A cheap look at two photographs: do their largest features lie in the same pattern?
//!
//! Features of large scale are few and found again more often than small ones, so that some hundred of them tell whether
//! two photographs can be matched at all (Wu 2013). Those that match must agree on one similarity transform, which
//! strangers' matches hardly do (weak geometric consistency, Jégou et al. 2008).

use terrane_scene::{DESCRIPTOR_LEN, Features};

use crate::matching::{MatchKernel, Neighbour};

/// The largest features of a photograph.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sketch {
    descriptors: Vec<[u8; DESCRIPTOR_LEN]>,
    /// Column and row in pixels.
    xy_px: Vec<[f32; 2]>,
    /// Greatest coordinate: about the size of the image.
    extent_px: f32,
}

/// Greatest distance to a match over the distance to the runner-up. With few features the runner-up is far; geometry
/// does the rest.
const MAX_RATIO: f64 = 0.9;
/// Matches whose pairs propose a transform, those with the best ratio first.
const MAX_PROPOSERS: usize = 24;
/// Distance within which a match agrees with a transform, in parts of the image's extent: relief and perspective are no
/// similarity.
const TOLERANCE: f32 = 0.04;
/// Two matches that are nearer to each other than this, in parts of the extent, determine no rotation.
const LEAST_BASELINE: f32 = 0.05;
/// Greatest change of scale.
const MAX_SCALE: f32 = 4.0;

impl Sketch {
    /// The `count` features of largest scale; of equals the stronger.
    pub fn new(features: &Features, count: usize) -> Self {
        let mut order: Vec<usize> = (0..features.len()).filter(|&at| is_finite(features, at)).collect();
        let scale = |at: usize| features.keypoints[at].scale_px;
        order.sort_by(|&a, &b| scale(b).total_cmp(&scale(a)).then(a.cmp(&b)));
        order.truncate(count);
        let rows = features.vectors();
        let descriptors = order.iter().filter_map(|&at| rows.get(at).copied()).collect();
        let xy_px: Vec<[f32; 2]> =
            order.iter().map(|&at| [features.keypoints[at].x_px, features.keypoints[at].y_px]).collect();
        let extent_px = xy_px.iter().flatten().fold(0.0_f32, |extent, &value| extent.max(value));
        Self { descriptors, xy_px, extent_px }
    }

    /// How many matches between the two agree on one similarity transform. Two always do, and three by chance.
    pub fn votes(&self, other: &Self) -> u32 {
        let matches = self.matches(other);
        if matches.len() < 3 {
            return matches.len() as u32;
        }
        let points: Vec<([f32; 2], [f32; 2])> =
            matches.iter().map(|&(_, a, b)| (self.xy_px[a], other.xy_px[b])).collect();
        let mut best = 2;
        let proposers = points.len().min(MAX_PROPOSERS);
        for i in 0..proposers {
            for j in i + 1..proposers {
                if let Some(transform) = self.transform(points[i], points[j]) {
                    best = best.max(agreeing(&points, transform, TOLERANCE * other.extent_px));
                }
            }
        }
        best
    }

    /// Mutual nearest neighbours that pass the ratio test, best first.
    fn matches(&self, other: &Self) -> Vec<(f64, usize, usize)> {
        let nearest = MatchKernel::fastest().nearest(&self.descriptors, &other.descriptors);
        let mut matches = Vec::new();
        for (row, neighbour) in nearest.rows.iter().enumerate() {
            let Some(column) = neighbour.index.map(|column| column as usize) else { continue };
            let back = &nearest.columns[column];
            let ratio = ratio(neighbour).max(ratio(back));
            if back.index == Some(row as u32) && ratio <= MAX_RATIO {
                matches.push((ratio, row, column));
            }
        }
        matches.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        matches
    }

    /// The similarity that takes two points to two others, as the complex numbers of `b = turn · a + shift`.
    fn transform(
        &self,
        (a0, b0): ([f32; 2], [f32; 2]),
        (a1, b1): ([f32; 2], [f32; 2]),
    ) -> Option<([f32; 2], [f32; 2])> {
        let a = [a1[0] - a0[0], a1[1] - a0[1]];
        let b = [b1[0] - b0[0], b1[1] - b0[1]];
        let square = a[0] * a[0] + a[1] * a[1];
        let least = LEAST_BASELINE * self.extent_px;
        if square < least * least {
            return None;
        }
        let turn = [(b[0] * a[0] + b[1] * a[1]) / square, (b[1] * a[0] - b[0] * a[1]) / square];
        let scale_squared = turn[0] * turn[0] + turn[1] * turn[1];
        if !(1.0 / (MAX_SCALE * MAX_SCALE)..=MAX_SCALE * MAX_SCALE).contains(&scale_squared) {
            return None;
        }
        let turned = [turn[0] * a0[0] - turn[1] * a0[1], turn[1] * a0[0] + turn[0] * a0[1]];
        Some((turn, [b0[0] - turned[0], b0[1] - turned[1]]))
    }
}

fn is_finite(features: &Features, at: usize) -> bool {
    let keypoint = &features.keypoints[at];
    keypoint.x_px.is_finite() && keypoint.y_px.is_finite() && keypoint.scale_px.is_finite()
}

fn ratio(neighbour: &Neighbour) -> f64 {
    if neighbour.second_squared == u32::MAX {
        return 0.0;
    }
    (f64::from(neighbour.distance_squared) / f64::from(neighbour.second_squared)).sqrt()
}

fn agreeing(points: &[([f32; 2], [f32; 2])], (turn, shift): ([f32; 2], [f32; 2]), tolerance_px: f32) -> u32 {
    let is_near = |&(a, b): &([f32; 2], [f32; 2])| {
        let x = turn[0] * a[0] - turn[1] * a[1] + shift[0] - b[0];
        let y = turn[1] * a[0] + turn[0] * a[1] + shift[1] - b[1];
        x * x + y * y <= tolerance_px * tolerance_px
    };
    points.iter().filter(|pair| is_near(pair)).count() as u32
}
