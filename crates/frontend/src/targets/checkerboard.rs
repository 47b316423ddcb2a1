//! Checkerboards: a lattice of saddles, grown along edges and laid over the board's columns and rows.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::Vector2;

use super::gray::FloatImage;
use super::links::{Links, link};
use super::saddles::{Level, Saddle, refined};
use super::{NotFound, TargetView, scale_of};
use crate::FrontendError;

/// A checkerboard. Its frame: x along columns, y along rows, the first corner at the origin; the square between the first corner and
/// the board's own corner is black where the board has such a first corner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Checkerboard {
    /// Inner corners along x.
    pub columns: usize,
    /// Inner corners along y.
    pub rows: usize,
    /// Side of a square, metres.
    pub square_m: f64,
}

/// Parts of the corners that must be seen, within an outline that is whole. Rows of the outline of which fewer are seen are none
/// of the board's.
const MIN_SEEN: f64 = 0.8;

/// Parts of a square's side that a window around a corner reaches.
const WINDOW: f64 = 0.4;

impl Checkerboard {
    /// A board.
    ///
    /// # Errors
    /// Fewer than 3 x 3 inner corners (too like other things), more than 100 a side, or a square without a size.
    pub fn new(columns: usize, rows: usize, square_m: f64) -> Result<Self, FrontendError> {
        if !(3..=100).contains(&columns) || !(3..=100).contains(&rows) || !(square_m > 0.0) {
            return Err(FrontendError::invalid_option(
                "a checkerboard needs 3 to 100 inner corners a side and squares larger than 0",
            ));
        }
        Ok(Self { columns, rows, square_m })
    }
}

/// A corner of a lattice: the saddle, and which of its rays goes along x.
#[derive(Clone, Copy, Debug)]
struct Node {
    saddle: usize,
    base: usize,
}

type Lattice = BTreeMap<(i32, i32), Node>;

/// See [`super::detect`]; `levels` are the picture, then halved again and again.
pub(super) fn detect(board: &Checkerboard, levels: &[FloatImage]) -> Result<TargetView, NotFound> {
    let mut reason = NotFound::Nothing;
    let mut best_seen = 8;
    for (index, image) in levels.iter().enumerate().rev() {
        let level = Level::new(image);
        let saddles = level.saddles();
        let links = link(&level.fine, &saddles);
        for mut lattice in lattices(&saddles, &links) {
            let seen = lattice.len();
            match laid_over(board, &mut lattice, &saddles) {
                Ok(corners) => return Ok(placed(board, &corners, &levels[0], scale_of(index))),
                Err(why) if seen > best_seen => (reason, best_seen) = (why, seen),
                Err(_) => {}
            }
        }
    }
    Err(reason)
}

/// All lattices of nine corners and more, the largest first.
fn lattices(saddles: &[Saddle], links: &Links) -> Vec<Lattice> {
    let mut used = vec![false; saddles.len()];
    let mut found = Vec::new();
    for seed in 0..saddles.len() {
        if !used[seed] {
            let lattice = grown(seed, saddles, links, &mut used);
            if lattice.len() >= 9 {
                found.push(lattice);
            }
        }
    }
    found.sort_by_key(|lattice: &Lattice| std::cmp::Reverse(lattice.len()));
    found
}

/// Follows edges from a saddle, breadth first; what contradicts the lattice so far is left out.
fn grown(seed: usize, saddles: &[Saddle], links: &Links, used: &mut [bool]) -> Lattice {
    const WAYS: [(i32, i32); 4] = [(1, 0), (0, 1), (-1, 0), (0, -1)];
    let mut lattice = Lattice::from([((0, 0), Node { saddle: seed, base: 0 })]);
    let mut queue = VecDeque::from([((0, 0), lattice[&(0, 0)])]);
    used[seed] = true;
    while let Some(((column, row), node)) = queue.pop_front() {
        for (way, step) in WAYS.iter().enumerate() {
            let Some((saddle, back)) = links[node.saddle][(node.base + way) % 4] else { continue };
            let cell = (column + step.0, row + step.1);
            if used[saddle] || lattice.contains_key(&cell) {
                continue;
            }
            if !continues(&lattice, saddles, (column, row), *step, saddle) {
                continue;
            }
            // The ray that comes back lies against the way.
            let next = Node { saddle, base: (back + 4 - (way + 2) % 4) % 4 };
            used[saddle] = true;
            lattice.insert(cell, next);
            queue.push_back((cell, next));
        }
    }
    lattice
}

/// Whether the next corner of a row is as far on and as strong as those before it, which things beside the board are not.
fn continues(lattice: &Lattice, saddles: &[Saddle], cell: (i32, i32), step: (i32, i32), next: usize) -> bool {
    const MAX_OFF: f64 = 0.35;
    const MAX_CONTRAST_RATIO: f64 = 2.0;
    let saddle_at = |cell: (i32, i32)| lattice.get(&cell).map(|node| &saddles[node.saddle]);
    let Some(here) = saddle_at(cell) else { return false };
    let next = &saddles[next];
    let ratio = next.contrast / here.contrast;
    if !(1.0 / MAX_CONTRAST_RATIO..=MAX_CONTRAST_RATIO).contains(&ratio) {
        return false;
    }
    let Some(before) = saddle_at((cell.0 - step.0, cell.1 - step.1)) else { return true };
    let way = here.xy_px - before.xy_px;
    (next.xy_px - here.xy_px - way).norm() < MAX_OFF * way.norm()
}

/// The corners of the board by column and row, in the order of rows; the unseen ones are `None`.
type Corners = Vec<Option<Vector2<f64>>>;

fn laid_over(board: &Checkerboard, lattice: &mut Lattice, saddles: &[Saddle]) -> Result<Corners, NotFound> {
    trim(lattice);
    let (low, high) = extent(lattice);
    let (width, height) = ((high.0 - low.0 + 1) as usize, (high.1 - low.1 + 1) as usize);
    let (columns, rows) = (board.columns, board.rows);
    if (width, height) != (columns, rows) && (height, width) != (columns, rows) {
        return Err(NotFound::OtherBoard {
            columns: width,
            rows: height,
            wanted_columns: columns,
            wanted_rows: rows,
        });
    }
    if (lattice.len() as f64) < MIN_SEEN * (columns * rows) as f64 {
        return Err(NotFound::Covered { seen: lattice.len(), wanted: columns * rows });
    }
    // All turns of the lattice that fit; those with a black first square before others, then the one whose first corner is
    // nearest to the picture's.
    let mut best: Option<((bool, f64), Corners)> = None;
    for turns in 0..4 {
        if (if turns % 2 == 0 { (width, height) } else { (height, width) }) != (columns, rows) {
            continue;
        }
        let node_at = |column: usize, row: usize| {
            let (c, r) = (column as i32, row as i32);
            let cell = match turns {
                0 => (low.0 + c, low.1 + r),
                1 => (high.0 - r, low.1 + c),
                2 => (high.0 - c, high.1 - r),
                _ => (low.0 + r, high.1 - c),
            };
            lattice.get(&cell).copied()
        };
        let cells = (0..columns * rows).map(|i| (i % columns, i / columns));
        let nodes: Vec<Option<Node>> = cells.map(|(column, row)| node_at(column, row)).collect();
        let Some((first, node)) = nodes.iter().enumerate().find_map(|(i, node)| node.map(|n| (i, n))) else {
            continue;
        };
        // The sector towards smaller x and y is the third from the ray along x, in the board's own turn.
        let toward_first = saddles[node.saddle].is_bright((node.base + turns + 2) % 4);
        let is_white = toward_first ^ !(first % columns + first / columns).is_multiple_of(2);
        let at = saddles[node.saddle].xy_px;
        let rank = (is_white, at.x + at.y);
        if best.as_ref().is_none_or(|(least, _)| rank < *least) {
            best = Some((rank, nodes.iter().map(|n| n.map(|n| saddles[n.saddle].xy_px)).collect()));
        }
    }
    best.map(|(_, corners)| corners).ok_or(NotFound::Nothing)
}

fn extent(lattice: &Lattice) -> ((i32, i32), (i32, i32)) {
    lattice.keys().fold(((i32::MAX, i32::MAX), (i32::MIN, i32::MIN)), |(low, high), &(column, row)| {
        ((low.0.min(column), low.1.min(row)), (high.0.max(column), high.1.max(row)))
    })
}

/// Takes away outer rows and columns of which less than half is there: things beside the board.
fn trim(lattice: &mut Lattice) {
    while !lattice.is_empty() {
        let (low, high) = extent(lattice);
        let (width, height) = (high.0 - low.0 + 1, high.1 - low.1 + 1);
        let sides: [(i32, bool, i32); 4] =
            [(low.0, true, height), (high.0, true, height), (low.1, false, width), (high.1, false, width)];
        let thin = sides.into_iter().find(|&(at, is_column, length)| {
            let on_it = lattice.keys().filter(|cell| (if is_column { cell.0 } else { cell.1 }) == at).count();
            2 * on_it < length as usize
        });
        let Some((at, is_column, _)) = thin else { return };
        lattice.retain(|cell, _| (if is_column { cell.0 } else { cell.1 }) != at);
    }
}

/// Corners to fractions of a pixel of the whole picture, each in a window of the size that its neighbours allow.
fn placed(board: &Checkerboard, corners: &Corners, image: &FloatImage, scale: f64) -> TargetView {
    let smooth = image.smoothed();
    let mut view = TargetView::default();
    for (i, corner) in corners.iter().enumerate() {
        let Some(corner) = corner else { continue };
        let (column, row) = (i % board.columns, i / board.columns);
        let mut spacing_px = f64::INFINITY;
        let near = |c: usize, r: usize| corners[r * board.columns + c];
        let left = column.checked_sub(1).and_then(|c| near(c, row));
        let right = (column + 1 < board.columns).then(|| near(column + 1, row)).flatten();
        let above = row.checked_sub(1).and_then(|r| near(column, r));
        let below = (row + 1 < board.rows).then(|| near(column, row + 1)).flatten();
        for other in [left, right, above, below].into_iter().flatten() {
            spacing_px = spacing_px.min(scale * (other - corner).norm());
        }
        let radius_px = (WINDOW * spacing_px).clamp(2.5, 10.0);
        // A coarse place may be off by a pixel of its level.
        let start = corner * scale;
        let start = refined(&smooth, &start, radius_px.max(1.5 * scale)).unwrap_or(start);
        if let Some(xy_px) = refined(&smooth, &start, radius_px) {
            view.xy_on_target_m.push(Vector2::new(column as f64, row as f64) * board.square_m);
            view.xy_px.push(xy_px);
        }
    }
    view
}
