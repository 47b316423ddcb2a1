//! One image's descriptors in cells around some of them, to find near ones of another image quickly: an inverted file
//! (Sivic & Zisserman 2003). What it finds is not always the nearest, but bounds how far the nearest are.

use super::distance::{Measured, distances};
use super::nearest::Neighbour;
use super::sketch::Sketches;
use super::sweep::closest::{Guessed, NOBODY, closest};

/// Descriptors of a cell, on average.
const CELL_SIZE: usize = 64;

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
    pub(super) fn new(sketches: &Sketches, with_avx2: bool) -> Self {
        let len = sketches.fine.codes.len();
        let num_leaders = len.div_ceil(CELL_SIZE);
        let leaders: Vec<u32> = (0..num_leaders).map(|at| (at * len / num_leaders) as u32).collect();
        let guessed = |of: &[u32]| Guessed::new(&gathered(&sketches.fine.codes, of), with_avx2);
        let leaders_guessed = guessed(&leaders);
        let mut members = vec![Vec::new(); num_leaders];
        let bases = sketches.score_bases(sketches);
        let nearest = closest(&sketches.coarse.codes, &leaders_guessed, &gathered(&bases, &leaders));
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
/// the `num_probes` cells that it would go to, and of those that found it.
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
    let mut arrivals = vec![Vec::new(); into.cells.cells.len()];
    for (at, found) in closest(codes, &into.cells.leaders_guessed, &leader_bases).iter().enumerate() {
        for leader in &found[..num_probes.min(found.len())] {
            if let Some(arrivals) = arrivals.get_mut(*leader as usize) {
                arrivals.push(at as u32);
            }
        }
    }
    let (mut pairs, mut squared) = (Vec::new(), Vec::new());
    for (cell, arrivals) in into.cells.cells.iter().zip(&arrivals) {
        let guesses = closest(&gathered(codes, arrivals), &cell.guessed, &gathered(&bases, &cell.members));
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

/// The two nearest so far, which may be offered more than once.
#[derive(Clone, Copy)]
pub(super) struct Two {
    first: (u32, u32),
    second: (u32, u32),
}

impl Default for Two {
    fn default() -> Self {
        Self { first: (u32::MAX, NOBODY), second: (u32::MAX, NOBODY) }
    }
}

impl Two {
    fn offer(&mut self, at: u32, distance: u32) {
        if distance >= self.second.0 || at == self.first.1 {
            return;
        }
        self.second = (distance, at);
        if distance < self.first.0 {
            std::mem::swap(&mut self.first, &mut self.second);
        }
    }

    pub(super) fn second_squared(&self) -> u32 {
        self.second.0
    }

    pub(super) fn neighbour(&self) -> Neighbour {
        Neighbour {
            index: (self.first.0 < self.second.0).then_some(self.first.1),
            distance_squared: self.first.0,
            second_squared: self.second.0,
        }
    }
}

fn gathered<T: Copy>(all: &[T], at: &[u32]) -> Vec<T> {
    at.iter().map(|&at| all[at as usize]).collect()
}
