//! The exact answer from few products: bounds reject the pairs that can't change it.
//!
//! 1. Each descriptor's runner-up is bounded from above by the two nearest in two cells of the other image.
//! 2. A match is nearer than `max_ratio` times the runner-up, seen from both sides, and than `max_distance`. So a pair
//!    whose sketches prove it farther than the smaller of its two limits is no match: of all pairs about one in a
//!    thousand survives, and its distance is computed. It also tightens the limits.
//! 3. The few rows and columns that may still match get their exact two nearest: pairs whose sketches prove them farther
//!    than the bound on the runner-up are left out. For those that seem to match after the first step, this is part of
//!    the second.
//!
//! All others have no match, whatever their nearest is. The answer is that of all products, bit for bit, on any path.

use std::ops::Range;

use terrane_scene::DESCRIPTOR_LEN;

use super::cells::{Cells, Image, Two, near};
use super::distance::{Measured, distances};
use super::kernel::MatchKernel;
use super::nearest::{Best, Nearest, Neighbour};
use super::sketch::{Code, LOOSE, Sketches};
use super::sweep::{
    ANY_REACH, CHUNK, Limits, MOST_SURVIVORS, NO_REACH, SweepColumns, SweepPath, SweepRows, sweep,
};
use super::{MatchOptions, passing_ratio};

/// Pairs of images with fewer products than this are not worth the bounds.
const LEAST_PRODUCTS: usize = 1 << 18;
/// When more than one pair in this many survives, bounds cost more than they save.
const LEAST_REJECTED: usize = 12;

/// When more than one descriptor in this many has no useful bound, likewise.
const LEAST_TIGHT: usize = 64;

/// Cells in which each descriptor looks for a bound on its runner-up.
const NUM_PROBES: usize = 2;

/// What the cascade keeps of an image, sorted by cell.
pub(super) struct Prepared {
    order: Vec<u32>,
    descriptors: Measured,
    cells: Cells,
    sketches: Sketches,
    sweep_rows: SweepRows,
    sweep_columns: SweepColumns,
    least_norm: i32,
    greatest_norm: i32,
}

/// One way to run the cascade; all give the same answer.
#[derive(Clone, Copy, Debug)]
pub(super) struct CascadePaths {
    pub(super) kernel: MatchKernel,
    pub(super) sweep: SweepPath,
}

impl Prepared {
    pub(super) fn new(paths: CascadePaths, descriptors: &[[u8; DESCRIPTOR_LEN]]) -> Self {
        let (cells, sketches, order) = Cells::new(Sketches::new(descriptors), paths.sweep);
        let descriptors = Measured::new(descriptors, &order);
        Self {
            order,
            cells,
            sweep_rows: paths.sweep.rows(&sketches.coarse.codes),
            sweep_columns: paths.sweep.columns(&sketches.fine.codes),
            sketches,
            least_norm: descriptors.norms.iter().copied().min().unwrap_or(0),
            greatest_norm: descriptors.norms.iter().copied().max().unwrap_or(0),
            descriptors,
        }
    }

    /// In the order of [`Prepared::order`].
    pub(super) fn descriptors(&self) -> &[[u8; DESCRIPTOR_LEN]] {
        self.descriptors.descriptors()
    }

    /// Where each descriptor was among those given.
    pub(super) fn order(&self) -> &[u32] {
        &self.order
    }

    fn image(&self) -> Image<'_> {
        Image { descriptors: &self.descriptors, sketches: &self.sketches, cells: &self.cells }
    }
}

/// Nearest neighbours as far as they matter to matches, in the orders of both images; others have none. `None` where bounds
/// are of no use and all products are to be computed.
pub(super) fn nearest(
    paths: CascadePaths,
    first: &Prepared,
    second: &Prepared,
    options: &MatchOptions,
) -> Option<Nearest> {
    if first.descriptors.len() * second.descriptors.len() < LEAST_PRODUCTS {
        return None;
    }
    let (near_rows, near_columns) = near::<NUM_PROBES>(first.image(), second.image());
    let row_bases = first.sketches.row_bases(&second.sketches);
    let column_bases = second.sketches.column_bases(&first.sketches);
    let mut rows = Side::new(first, second, row_bases, &near_rows, options);
    let mut columns = Side::new(second, first, column_bases, &near_columns, options);
    if (rows.loose.len() + columns.loose.len()) * LEAST_TIGHT
        > first.descriptors.len() + second.descriptors.len()
    {
        return None;
    }
    if !options.mutual {
        columns.open();
    }
    mark_likely(&mut rows, &mut columns, (&near_rows, &near_columns));
    let candidates = candidates(&mut rows, &mut columns)?;
    let mut open_rows: Vec<u32> = candidates.iter().map(|&(row, _)| row).collect();
    let mut open_columns: Vec<u32> = candidates.iter().map(|&(_, column)| column).collect();
    if !options.mutual {
        open_columns.clear();
    }
    Some(Nearest {
        rows: settle(paths.sweep, &rows, &mut open_rows)?,
        columns: settle(paths.sweep, &columns, &mut open_columns)?,
    })
}

/// One image's part in a pair.
struct Side<'a> {
    image: &'a Prepared,
    other: &'a Prepared,
    options: &'a MatchOptions,
    /// The runner-up is at most this far, squared.
    second: Vec<u32>,
    /// A match is at most this far, squared.
    greatest: Vec<u32>,
    /// `greatest` for the sweep.
    limits: Limits,
    /// Those without a useful bound, left out of sweeps.
    loose: Vec<u32>,
    /// Which are likely to match, so that their two nearest are wanted.
    is_likely: Vec<bool>,
    /// Of those whose distances are known.
    best: Best,
}

impl<'a> Side<'a> {
    fn new(
        image: &'a Prepared,
        other: &'a Prepared,
        base: Vec<i32>,
        near: &[Two],
        options: &'a MatchOptions,
    ) -> Self {
        let second: Vec<u32> = near.iter().map(Two::second_squared).collect();
        let loose = loose(&base);
        let limits = Limits { reach: vec![ANY_REACH; base.len()], lone: vec![NO_REACH; base.len()], base };
        let greatest = vec![u32::MAX; second.len()];
        let best = Best::new(second.len());
        let is_likely = vec![false; second.len()];
        let mut side = Self { image, other, options, second, greatest, limits, loose, is_likely, best };
        (0..side.second.len()).for_each(|at| side.limit(at));
        side
    }

    /// Sets what follows from `second`.
    fn limit(&mut self, at: usize) {
        let by_ratio = match self.second[at] {
            u32::MAX => u32::MAX,
            second => ((self.options.max_ratio.powi(2) * f64::from(second)) as u32).saturating_add(2),
        };
        // The squared distance of descriptors whose unit vectors are `max_distance` apart is convex in either length.
        let cosine = 1.0 - 0.5 * self.options.max_distance.powi(2);
        let norm = f64::from(self.image.descriptors.norms[at]);
        let at_length = |other: i32| {
            let other = f64::from(other);
            norm + other - 2.0 * cosine * (norm * other).sqrt()
        };
        let by_distance = at_length(self.other.least_norm).max(at_length(self.other.greatest_norm));
        self.greatest[at] = by_ratio.min((by_distance as u32).saturating_add(2));
        if self.limits.base[at] == LOOSE {
            self.limits.reach[at] = NO_REACH;
            return;
        }
        let reach = |squared: u32| self.image.sketches.reach(&self.other.sketches, squared);
        self.limits.reach[at] = reach(self.greatest[at]);
        if self.is_likely[at] {
            self.limits.lone[at] = reach(self.second[at]);
        }
    }

    fn mark_likely(&mut self, at: usize) {
        self.is_likely[at] = true;
        self.limit(at);
    }

    /// Lets the other side decide alone.
    fn open(&mut self) {
        self.greatest.fill(u32::MAX);
        for (reach, &base) in self.limits.reach.iter_mut().zip(&self.limits.base) {
            *reach = if base == LOOSE { NO_REACH } else { ANY_REACH };
        }
    }

    /// Takes a distance into account.
    fn offer(&mut self, at: usize, other: usize, squared_distance: i32) {
        self.best.offer(at, other, -squared_distance);
        let second = self.best.second_squared(at);
        if second < self.second[at] {
            self.second[at] = second;
            self.limit(at);
        }
    }
}

/// Marks what would match if those found first were the nearest.
fn mark_likely(rows: &mut Side<'_>, columns: &mut Side<'_>, (near_rows, near_columns): (&[Two], &[Two])) {
    let passing = |two: &Two, options: &MatchOptions| {
        let neighbour = two.neighbour();
        passing_ratio(&neighbour, options).and(neighbour.index)
    };
    for (row, two) in near_rows.iter().enumerate() {
        let Some(column) = passing(two, rows.options) else { continue };
        let column = column as usize;
        if !rows.options.mutual {
            rows.mark_likely(row);
        } else if passing(&near_columns[column], columns.options) == Some(row as u32) {
            rows.mark_likely(row);
            columns.mark_likely(column);
        }
    }
}

fn loose(bases: &[i32]) -> Vec<u32> {
    (0..bases.len() as u32).filter(|&at| bases[at as usize] == LOOSE).collect()
}

/// The pairs of a range of columns whose distances are wanted, each once: those that survive the sweep, and all of those
/// whose row or column bounds nothing. `None` when there are too many.
fn wanted(
    (sweep_rows, rows): (&SweepRows, &Limits),
    (sweep_columns, columns): (&SweepColumns, &Limits),
    range: Range<usize>,
    pairs: &mut Vec<(u32, u32)>,
) -> Option<()> {
    pairs.clear();
    sweep((sweep_rows, rows), (sweep_columns, columns), range.clone(), pairs);
    if pairs.len() > MOST_SURVIVORS {
        return None;
    }
    let loose_rows = loose(&rows.base);
    let mut loose_columns = loose(&columns.base);
    loose_columns.retain(|&column| range.contains(&(column as usize)));
    if loose_rows.is_empty() && loose_columns.is_empty() {
        return Some(());
    }
    let is_loose = |base: &[i32], at: u32| base[at as usize] == LOOSE;
    pairs.retain(|&(row, column)| !is_loose(&rows.base, row) && !is_loose(&columns.base, column));
    for row in loose_rows {
        pairs.extend(range.clone().map(|column| (row, column as u32)));
    }
    for column in loose_columns {
        let tight = (0..rows.base.len() as u32).filter(|&row| !is_loose(&rows.base, row));
        pairs.extend(tight.map(|row| (row, column)));
    }
    Some(())
}

/// Every pair that may be a match, among others. Tightens both sides' limits.
fn candidates(rows: &mut Side<'_>, columns: &mut Side<'_>) -> Option<Vec<(u32, u32)>> {
    let (num_rows, num_columns) = (rows.second.len(), columns.second.len());
    let (mut survivors, mut squared) = (Vec::new(), Vec::new());
    let (mut found, mut num_survivors) = (Vec::new(), 0);
    for start in (0..num_columns).step_by(CHUNK) {
        wanted(
            (&rows.image.sweep_rows, &rows.limits),
            (&columns.image.sweep_columns, &columns.limits),
            start..num_columns.min(start + CHUNK),
            &mut survivors,
        )?;
        num_survivors += survivors.len();
        // One chunk more, since one may hold more than its share.
        if num_survivors > num_rows * (start + 2 * CHUNK) / LEAST_REJECTED {
            return None;
        }
        distances(&rows.image.descriptors, &columns.image.descriptors, &survivors, &mut squared);
        for (&(row, column), &distance) in survivors.iter().zip(&squared) {
            let (at_row, at_column) = (row as usize, column as usize);
            if distance as u32 <= rows.greatest[at_row].min(columns.greatest[at_column]) {
                found.push((row, column, distance as u32));
            }
            rows.offer(at_row, at_column, distance);
            if rows.options.mutual {
                columns.offer(at_column, at_row, distance);
            }
        }
    }
    let is_open = |&&(row, column, distance): &&(u32, u32, u32)| {
        distance <= rows.greatest[row as usize].min(columns.greatest[column as usize])
    };
    Some(found.iter().filter(is_open).map(|&(row, column, _)| (row, column)).collect())
}

/// The exact neighbours of some of a side's descriptors.
fn settle(path: SweepPath, side: &Side<'_>, open: &mut Vec<u32>) -> Option<Vec<Neighbour>> {
    open.sort_unstable();
    open.dedup();
    let everyone = |len: usize| (0..len as u32).collect::<Vec<_>>();
    let (num_own, num_others) = (side.second.len(), side.other.descriptors.len());
    let known = side.best.neighbours(&everyone(num_own), &everyone(num_others));
    let mut neighbours = Best::new(num_own).neighbours(&everyone(num_own), &[]);
    for &at in open.iter().filter(|&&at| side.is_likely[at as usize]) {
        neighbours[at as usize] = known[at as usize];
    }
    open.retain(|&at| !side.is_likely[at as usize]);
    let best = all_distances(path, side, open)?;
    for (&at, neighbour) in open.iter().zip(best.neighbours(&everyone(open.len()), &everyone(num_others))) {
        neighbours[at as usize] = neighbour;
    }
    Some(neighbours)
}

/// The two nearest of some of a side's descriptors, which become lanes.
fn all_distances(path: SweepPath, side: &Side<'_>, open: &[u32]) -> Option<Best> {
    let mut best = Best::new(open.len());
    if open.is_empty() {
        return Some(best);
    }
    let (image, other) = (side.image, side.other);
    let reach = |second: u32| image.sketches.reach(&other.sketches, second);
    let bases = image.sketches.row_bases(&other.sketches);
    let base: Vec<i32> = open.iter().map(|&at| bases[at as usize]).collect();
    let reach_of = |(&at, &base): (&u32, &i32)| match base {
        LOOSE => NO_REACH,
        _ => reach(side.second[at as usize]),
    };
    let mut limits = Limits {
        reach: vec![NO_REACH; open.len()],
        lone: open.iter().zip(&base).map(reach_of).collect(),
        base,
    };
    let num_others = other.descriptors.len();
    let alone = || vec![NO_REACH; num_others];
    let other_base = other.sketches.column_bases(&image.sketches);
    let other_limits = Limits { base: other_base, reach: alone(), lone: alone() };
    let codes: Vec<Code> = open.iter().map(|&at| image.sketches.coarse.codes[at as usize]).collect();
    let rows = path.rows(&codes);
    let (mut survivors, mut lanes, mut squared) = (Vec::new(), Vec::new(), Vec::new());
    for start in (0..num_others).step_by(CHUNK) {
        let range = start..num_others.min(start + CHUNK);
        wanted((&rows, &limits), (&other.sweep_columns, &other_limits), range, &mut survivors)?;
        lanes.clear();
        lanes.extend(survivors.iter().map(|&(lane, _)| lane as usize));
        survivors.iter_mut().for_each(|(lane, _)| *lane = open[*lane as usize]);
        distances(&image.descriptors, &other.descriptors, &survivors, &mut squared);
        for ((&lane, &(_, column)), &distance) in lanes.iter().zip(&survivors).zip(&squared) {
            best.offer(lane, column as usize, -distance);
        }
        for (lane, limit) in limits.lone.iter_mut().enumerate().filter(|(_, limit)| **limit != NO_REACH) {
            *limit = reach(side.second[open[lane] as usize].min(best.second_squared(lane)));
        }
    }
    Some(best)
}
