//! Which keypoints stay when there are more than asked for.

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
