//! One image's descriptors in cells around some of them, to find near ones of another image quickly: an inverted file
//! (Sivic & Zisserman 2003). What it finds is not always the nearest, but bounds how far the nearest are.

use super::distance::{Measured, distances};
use super::nearest::Neighbour;
use super::sketch::Sketches;
use super::sweep::SweepPath;
use super::sweep::closest::{Guessed, NOBODY, closest};

/// Descriptors of a cell, on average.
const CELL_SIZE: usize = 64;

/// Members of a cell that are guessed at, for each that looks into it.
const GUESSES: usize = 2;
/// Most cells that one looks into.
pub(super) const MOST_PROBES: usize = 6;

/// Cells of an image. Leaders are descriptors at equal steps; each descriptor goes to the leader that seems nearest.
pub(super) struct Cells {
    leaders: Vec<u32>,
    leaders_guessed: Guessed,
    cells: Vec<Cell>,
}

struct Cell {
    members: Vec<u32>,
    guessed: Guessed,
}

/// What is searched and searched for.
#[derive(Clone, Copy)]
pub(super) struct Image<'a> {
    pub(super) descriptors: &'a Measured,
    pub(super) sketches: &'a Sketches,
    pub(super) cells: &'a Cells,
}

impl Cells {
    pub(super) fn new(sketches: &Sketches, path: SweepPath) -> Self {
        let len = sketches.fine.codes.len();
        let num_leaders = len.div_ceil(CELL_SIZE);
        let leaders: Vec<u32> = (0..num_leaders).map(|at| (at * len / num_leaders) as u32).collect();
        let guessed = |of: &[u32]| Guessed::new(&gathered(&sketches.fine.codes, of), path);
        let leaders_guessed = guessed(&leaders);
        let mut members = vec![Vec::new(); num_leaders];
        let bases = sketches.score_bases(sketches);
        let nearest = closest::<1>(&sketches.coarse.codes, &leaders_guessed, &gathered(&bases, &leaders));
        for (at, found) in nearest.iter().enumerate() {
            if let Some(cell) = members.get_mut(found[0] as usize) {
                cell.push(at as u32);
            }
        }
        let cell = |members: Vec<u32>| Cell { guessed: guessed(&members), members };
        Self { leaders, leaders_guessed, cells: members.into_iter().map(cell).collect() }
    }
}

/// For each descriptor of two images the two nearest among some of the other's: of those that seem nearest in each of
/// the `num_probes` cells, at most [`MOST_PROBES`], that it would go to, and of those that found it.
pub(super) fn near(first: Image<'_>, second: Image<'_>, num_probes: usize) -> (Vec<Two>, Vec<Two>) {
    let mut rows = vec![Two::default(); first.descriptors.len()];
    let mut columns = vec![Two::default(); second.descriptors.len()];
    probe(first, second, num_probes, &mut rows, &mut columns);
    probe(second, first, num_probes, &mut columns, &mut rows);
    (rows, columns)
}

fn probe(from: Image<'_>, into: Image<'_>, num_probes: usize, from_best: &mut [Two], into_best: &mut [Two]) {
    let bases = into.sketches.score_bases(from.sketches);
    let codes = &from.sketches.coarse.codes;
    let leader_bases = gathered(&bases, &into.cells.leaders);
    let leaders = closest::<MOST_PROBES>(codes, &into.cells.leaders_guessed, &leader_bases);
    let arrivals = Arrivals::new(&leaders, num_probes, into.cells.cells.len());
    let (mut rows, mut columns, mut pairs, mut squared) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for (cell, arrivals) in into.cells.cells.iter().zip(arrivals.by_cell()) {
        gather(codes, arrivals, &mut rows);
        gather(&bases, &cell.members, &mut columns);
        let guesses = closest::<GUESSES>(&rows, &cell.guessed, &columns);
        pairs.clear();
        for (&at, guesses) in arrivals.iter().zip(&guesses) {
            let known = guesses.iter().filter(|&&guess| guess != NOBODY);
            pairs.extend(known.map(|&guess| (at, cell.members[guess as usize])));
        }
        distances(from.descriptors, into.descriptors, &pairs, &mut squared);
        for (&(a, b), &distance) in pairs.iter().zip(&squared) {
            from_best[a as usize].offer(b, distance as u32);
            into_best[b as usize].offer(a, distance as u32);
        }
    }
}

/// Who looks into which cell: by cell, and in each in rising order.
struct Arrivals {
    /// Where each cell's begin, and where the last one's end.
    starts: Vec<u32>,
    all: Vec<u32>,
}

impl Arrivals {
    /// `leaders` are the cells that each would go to, the first `num_probes` of which it does.
    fn new<const N: usize>(leaders: &[[u32; N]], num_probes: usize, num_cells: usize) -> Self {
        let visits = |at: usize| leaders[at][..num_probes].iter().take_while(|&&leader| leader != NOBODY);
        let mut starts = vec![0; num_cells + 1];
        (0..leaders.len()).flat_map(visits).for_each(|&leader| starts[leader as usize + 1] += 1);
        let mut sum = 0;
        for start in &mut starts {
            sum += *start;
            *start = sum;
        }
        let mut next = starts.clone();
        let mut all = vec![0; sum as usize];
        for at in 0..leaders.len() {
            for &leader in visits(at) {
                let place = &mut next[leader as usize];
                all[*place as usize] = at as u32;
                *place += 1;
            }
        }
        Self { starts, all }
    }

    fn by_cell(&self) -> impl Iterator<Item = &[u32]> {
        self.starts.windows(2).map(|bounds| &self.all[bounds[0] as usize..bounds[1] as usize])
    }
}

/// The two nearest so far, which may be offered more than once: a squared distance above the place of each.
#[derive(Clone, Copy)]
pub(super) struct Two {
    first: u64,
    second: u64,
}

impl Default for Two {
    fn default() -> Self {
        Self { first: u64::MAX, second: u64::MAX }
    }
}

impl Two {
    /// Without branches: which of the two is beaten can't be foretold.
    #[inline]
    fn offer(&mut self, at: u32, distance: u32) {
        let offered = u64::from(distance) << 32 | u64::from(at);
        let other = if offered == self.first { u64::MAX } else { offered };
        self.second = self.second.min(self.first.max(other));
        self.first = self.first.min(other);
    }

    pub(super) fn second_squared(&self) -> u32 {
        (self.second >> 32) as u32
    }

    pub(super) fn neighbour(&self) -> Neighbour {
        let distance_squared = (self.first >> 32) as u32;
        let second_squared = self.second_squared();
        let index = (distance_squared < second_squared).then_some(self.first as u32);
        Neighbour { index, distance_squared, second_squared }
    }
}

fn gathered<T: Copy>(all: &[T], at: &[u32]) -> Vec<T> {
    let mut out = Vec::new();
    gather(all, at, &mut out);
    out
}

fn gather<T: Copy>(all: &[T], at: &[u32], out: &mut Vec<T>) {
    out.clear();
    out.extend(at.iter().map(|&at| all[at as usize]));
}
