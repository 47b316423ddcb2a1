//! Which keypoints stay: one of each blob, and the best when there are more than asked for.

use std::collections::BTreeMap;

/// What the choice looks at.
#[derive(Clone, Copy)]
pub(super) struct Ranked {
    /// Position in pixels of the photograph.
    pub x_px: f32,
    /// Position in pixels of the photograph.
    pub y_px: f32,
}

/// Cells that a photograph is divided into: about sixteen by sixteen.
const CELLS: f64 = 256.0;

/// Chooses at most `limit` of `ranked`, which are in falling strength; returns their positions, ascending.
///
/// A share `spread` of the places is handed to the cells of a grid in equal parts, each to the strongest of its cell;
/// what cells do not use goes, with the rest, to the strongest of all. So strong keypoints are kept everywhere, and weak
/// surroundings keep some: well spread observations hold a camera's pose better than many in one corner.
pub(super) fn select(
    ranked: &[Ranked],
    limit: usize,
    spread: f64,
    (width, height): (usize, usize),
) -> Vec<usize> {
    if ranked.len() <= limit {
        return (0..ranked.len()).collect();
    }
    let cell_px = ((width * height) as f64 / CELLS).sqrt().max(1.0);
    let columns = (width as f64 / cell_px).ceil() as usize;
    let rows = (height as f64 / cell_px).ceil() as usize;
    let quota = (spread * limit as f64 / (columns * rows) as f64) as usize;
    let cell_of = |place: &Ranked| {
        let column = ((f64::from(place.x_px) / cell_px) as usize).min(columns - 1);
        let row = ((f64::from(place.y_px) / cell_px) as usize).min(rows - 1);
        row * columns + column
    };
    let mut used = vec![0; columns * rows];
    let mut is_chosen = vec![false; ranked.len()];
    let mut left = limit;
    for (place, is_chosen) in ranked.iter().zip(&mut is_chosen) {
        let used = &mut used[cell_of(place)];
        if *used < quota {
            *used += 1;
            *is_chosen = true;
            left -= 1;
        }
    }
    for is_chosen in is_chosen.iter_mut().filter(|c| !**c).take(left) {
        *is_chosen = true;
    }
    (0..ranked.len()).filter(|&k| is_chosen[k]).collect()
}

/// A blob as it is compared with others.
#[derive(Clone, Copy)]
pub(super) struct Placed {
    /// Position in pixels of the photograph.
    pub x_px: f32,
    /// Position in pixels of the photograph.
    pub y_px: f32,
    /// Standard deviation in pixels of the photograph, at most [`WIDEST`] steps.
    pub scale_px: f32,
    /// The octave that it was found in, and its pixel in pixels of the photograph.
    pub octave: usize,
    pub step_px: f32,
}

/// The largest scale in pixels of its octave, rounded up.
const WIDEST: f32 = 5.0;
/// Blobs nearer than this part of their scale are one, if their scales are alike.
const SAME_PLACE: f32 = 0.5;
/// Scales whose ratio is below this are alike: less than a level apart.
const SAME_SCALE: f32 = 1.25;

/// Whether each is the first of its blob: one blob may be found from several cells, and in two octaves.
pub(super) fn first_at_places(places: &[Placed]) -> Vec<bool> {
    let cell = |place: &Placed, octave: usize, step_px: f32| {
        let cell_px = WIDEST * step_px;
        (octave, (place.y_px / cell_px).floor() as i32, (place.x_px / cell_px).floor() as i32)
    };
    let mut grid: BTreeMap<(usize, i32, i32), Vec<usize>> = BTreeMap::new();
    let mut is_first = Vec::with_capacity(places.len());
    for (index, place) in places.iter().enumerate() {
        let is_same = |other: usize| {
            let other = &places[other];
            let ratio = other.scale_px / place.scale_px;
            (other.x_px - place.x_px).powi(2) + (other.y_px - place.y_px).powi(2)
                < (SAME_PLACE * place.scale_px).powi(2)
                && (1.0 / SAME_SCALE..SAME_SCALE).contains(&ratio)
        };
        // Half of the widest scale fits into a cell of the finer octave too.
        let octaves = [(-1, 0.5), (0, 1.0), (1, 2.0)];
        let is_found = octaves.iter().any(|(up, factor)| {
            let Some(octave) = place.octave.checked_add_signed(*up) else { return false };
            let (octave, row, column) = cell(place, octave, factor * place.step_px);
            (-1..=1).any(|dy| {
                let row = grid.range((octave, row + dy, column - 1)..=(octave, row + dy, column + 1));
                row.flat_map(|(_, others)| others).any(|&other| is_same(other))
            })
        });
        is_first.push(!is_found);
        if !is_found {
            grid.entry(cell(place, place.octave, place.step_px)).or_default().push(index);
        }
    }
    is_first
}
