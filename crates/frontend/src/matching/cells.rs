//! One image's descriptors in cells around some of them, to find near ones of another image quickly: an inverted file
//! (Sivic & Zisserman 2003). What it finds is not always the nearest, but bounds how far the nearest are.

use std::ops::Range;

use super::distance::{Measured, distances};
use super::nearest::Neighbour;
use super::sketch::Sketches;
use super::sweep::SweepPath;
use super::sweep::closest::{Guessed, NOBODY, closest};

/// Descriptors of a cell, on average.
const CELL_SIZE: usize = 64;

/// Members of a cell that are guessed at, for each that looks into it.
const GUESSES: usize = 2;
/// Cells of an image. Leaders are descriptors at equal steps; each descriptor goes to the leader that seems nearest.
///
/// Descriptors are sorted by cell, so that what is looked at together lies together.
pub(super) struct Cells {
    leaders: Vec<u32>,
    leaders_guessed: Guessed,
    cells: Vec<Cell>,
}

struct Cell {
    members: Range<usize>,
    guessed: Guessed,
}

/// What is searched and searched for, in the order of the cells.
#[derive(Clone, Copy)]
pub(super) struct Image<'a> {
    pub(super) descriptors: &'a Measured,
    pub(super) sketches: &'a Sketches,
    pub(super) cells: &'a Cells,
}

impl Cells {
    /// Sorts sketches by cell, of each cell in rising order; with where each of them was before.
    pub(super) fn new(sketches: Sketches, path: SweepPath) -> (Self, Sketches, Vec<u32>) {
        let len = sketches.len();
        let num_leaders = len.div_ceil(CELL_SIZE);
        let leaders: Vec<u32> = (0..num_leaders).map(|at| (at * len / num_leaders) as u32).collect();
        let leaders_guessed = Guessed::new(&gathered(&sketches.fine.codes, &leaders), path);
        let bases = gathered(&sketches.score_bases(&sketches), &leaders);
        let nearest = closest::<1>(&sketches.coarse.codes, &leaders_guessed, &bases);
        let arrivals = Arrivals::new(&nearest, num_leaders);
        // Nobody's member comes last.
        let strays = (0..len as u32).filter(|&at| nearest[at as usize] == [NOBODY]);
        let order: Vec<u32> = arrivals.all.iter().copied().chain(strays).collect();
        let mut place_of = vec![0; len];
        order.iter().zip(0..).for_each(|(&at, place)| place_of[at as usize] = place);
        let sorted = sketches.in_order(&order);
        let cell = |members: Range<usize>| Cell {
            guessed: Guessed::new(&sorted.fine.codes[members.clone()], path),
            members,
        };
        let cells = Self {
            leaders: gathered(&place_of, &leaders),
            leaders_guessed,
            cells: arrivals.ranges().map(cell).collect(),
        };
        (cells, sorted, order)
    }
}

/// For each descriptor of two images the two nearest among some of the other's: of those that seem nearest in each of
/// the `P` cells that it would go to, and of those that found it.
pub(super) fn near<const P: usize>(first: Image<'_>, second: Image<'_>) -> (Vec<Two>, Vec<Two>) {
    let mut rows = vec![Two::default(); first.descriptors.len()];
    let mut columns = vec![Two::default(); second.descriptors.len()];
    probe::<P>(first, second, &mut rows, &mut columns);
    probe::<P>(second, first, &mut columns, &mut rows);
    (rows, columns)
}

fn probe<const P: usize>(from: Image<'_>, into: Image<'_>, from_best: &mut [Two], into_best: &mut [Two]) {
    let bases = into.sketches.score_bases(from.sketches);
    let codes = &from.sketches.coarse.codes;
    let leader_bases = gathered(&bases, &into.cells.leaders);
    let leaders = closest::<P>(codes, &into.cells.leaders_guessed, &leader_bases);
    let arrivals = Arrivals::new(&leaders, into.cells.cells.len());
    let (mut rows, mut pairs, mut squared) = (Vec::new(), Vec::new(), Vec::new());
    for (cell, arrivals) in into.cells.cells.iter().zip(arrivals.by_cell()) {
        gather(codes, arrivals, &mut rows);
        let guesses = closest::<GUESSES>(&rows, &cell.guessed, &bases[cell.members.clone()]);
        pairs.clear();
        for (&at, guesses) in arrivals.iter().zip(&guesses) {
            let known = guesses.iter().filter(|&&guess| guess != NOBODY);
            pairs.extend(known.map(|&guess| (at, cell.members.start as u32 + guess)));
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
    /// `leaders` are the cells that each goes to.
    fn new<const N: usize>(leaders: &[[u32; N]], num_cells: usize) -> Self {
        let visits = |at: usize| leaders[at].iter().take_while(|&&leader| leader != NOBODY);
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

    /// Where each cell's are among all.
    fn ranges(&self) -> impl Iterator<Item = Range<usize>> {
        self.starts.windows(2).map(|bounds| bounds[0] as usize..bounds[1] as usize)
    }

    fn by_cell(&self) -> impl Iterator<Item = &[u32]> {
        self.ranges().map(|range| &self.all[range])
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

pub(super) fn gathered<T: Copy>(all: &[T], at: &[u32]) -> Vec<T> {
    let mut out = Vec::new();
    gather(all, at, &mut out);
    out
}

fn gather<T: Copy>(all: &[T], at: &[u32], out: &mut Vec<T>) {
    out.clear();
    out.extend(at.iter().map(|&at| all[at as usize]));
}
