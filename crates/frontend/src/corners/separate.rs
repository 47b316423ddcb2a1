//! One corner a place: what a stronger one stands beside is left out.

/// A corner's place in pixels of the photograph, and those of a pixel of its level.
#[derive(Clone, Copy)]
pub(super) struct Place {
    pub x_px: f32,
    pub y_px: f32,
    pub step_px: f32,
}

/// No corner.
const NONE: u32 = u32::MAX;

/// Of corners in falling strength, those that lie no nearer to a stronger one that stays than `separation` pixels of the
/// coarser level of the two; ascending.
pub(super) fn separate(places: &[Place], separation: f32, (width, height): (usize, usize)) -> Vec<usize> {
    let coarsest = places.iter().map(|place| place.step_px).fold(1.0, f32::max);
    if !(separation > 0.0) {
        return (0..places.len()).collect();
    }
    // Cells as wide as the greatest distance that matters: neighbours lie in adjacent ones.
    let cell_px = separation * coarsest;
    let cell = |value_px: f32, count: usize| ((value_px / cell_px).max(0.0) as usize).min(count - 1);
    let columns = (width as f32 / cell_px) as usize + 1;
    let rows = (height as f32 / cell_px) as usize + 1;
    // Those that stay, as a chain in each cell.
    let mut first = vec![NONE; columns * rows];
    let mut next = vec![NONE; places.len()];
    let mut kept = Vec::new();
    for (at, place) in places.iter().enumerate() {
        let (column, row) = (cell(place.x_px, columns), cell(place.y_px, rows));
        let near_rows = row.saturating_sub(1)..=(row + 1).min(rows - 1);
        let is_crowded = near_rows.into_iter().any(|row| {
            (column.saturating_sub(1)..=(column + 1).min(columns - 1)).any(|column| {
                let mut other = first[row * columns + column];
                while let Some(neighbor) = places.get(other as usize) {
                    if are_near(place, neighbor, separation) {
                        return true;
                    }
                    other = next[other as usize];
                }
                false
            })
        });
        if !is_crowded {
            next[at] = std::mem::replace(&mut first[row * columns + column], at as u32);
            kept.push(at);
        }
    }
    kept
}

fn are_near(a: &Place, b: &Place, separation: f32) -> bool {
    let (dx, dy) = (a.x_px - b.x_px, a.y_px - b.y_px);
    let reach = separation * a.step_px.max(b.step_px);
    dx * dx + dy * dy < reach * reach
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_stays_is_apart_and_what_goes_was_near_a_stronger_one() {
        let mut state = 3_u64;
        let mut uniform = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1 << 24) as f32
        };
        let places: Vec<Place> = (0..2000)
            .map(|k| Place {
                x_px: 300.0 * uniform(),
                y_px: 200.0 * uniform(),
                step_px: [1.0, 1.5, 3.0][k % 3],
            })
            .collect();
        let kept = separate(&places, 2.0, (300, 200));
        assert!(kept.is_sorted() && kept.len() > 300 && kept.len() < 1900, "{}", kept.len());
        for (at, place) in places.iter().enumerate() {
            let mut stronger = kept.iter().take_while(|&&k| k < at);
            let is_crowded = stronger.any(|&k| are_near(place, &places[k], 2.0));
            assert_eq!(kept.contains(&at), !is_crowded, "{at}");
        }
        assert_eq!(separate(&places, 0.0, (300, 200)).len(), 2000);
        assert!(separate(&[], 2.0, (0, 0)).is_empty());
    }
}
