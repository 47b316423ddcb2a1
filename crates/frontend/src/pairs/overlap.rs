//! Neighbours by the ground that they see.

use nalgebra::Vector3;
use rayon::prelude::*;
use terrane_scene::ImageTable;

use super::footprint::Footprint;
use super::places::Places;
use super::spatial::is_position;
use super::views::views;

/// Footprints whose centres are nearest, as a multiple of the neighbours wanted: with several cameras or heights over one
/// place, only a part of them are alike.
const CANDIDATES_PER_NEIGHBOUR: usize = 6;

/// Of the neighbours of an image, the share kept for those that look elsewhere by more than [`OTHER_SIDE`]: the best
/// overlaps all look the same way, and only the others tie the directions of an oblique flight together.
const OTHER_SIDES_SHARE: f64 = 0.3;

/// Cosine of the angle between two views that counts as another side: 20 degrees.
const OTHER_SIDE: f64 = 0.94;

/// Scores are compared in steps of this, so that the last bits of a sine don't decide.
const SCORE_STEPS: f64 = 65_536.0;

/// Footprints of a table and the lists that follow from them.
pub(super) struct Overlaps {
    /// For each image with a footprint its neighbours, best first; `None` for the others.
    pub(super) lists: Vec<Option<Vec<usize>>>,
    /// Images with a footprint.
    pub(super) num_footprints: u32,
}

/// For each image with a footprint, the `count` images that share most of their ground with it, at least `min_overlap` of
/// what both see (intersection over union, weighed by how alike they look at it).
pub(super) fn neighbours(table: &ImageTable, count: usize, min_overlap: f64) -> Overlaps {
    let footprints = footprints(table);
    let num_footprints = footprints.iter().flatten().count() as u32;
    let centers: Vec<Option<Vector3<f64>>> =
        footprints.iter().map(|footprint| footprint.as_ref().map(|f| f.center)).collect();
    let places = Places::new(&centers);
    let mut lists = vec![None; table.images.len()];
    let found: Vec<(usize, Vec<usize>)> =
        places.map_nearest(CANDIDATES_PER_NEIGHBOUR * count, |image, near| {
            let Some(footprint) = &footprints[image] else { return Vec::new() };
            let scored = near.iter().filter_map(|&(_, other)| {
                let (score, cosine) = alike(footprint, footprints[other].as_ref()?);
                (score >= min_overlap).then_some(((score * SCORE_STEPS) as u32, cosine < OTHER_SIDE, other))
            });
            best(scored.collect(), count)
        });
    for (image, list) in found {
        lists[image] = Some(list);
    }
    Overlaps { lists, num_footprints }
}

fn footprints(table: &ImageTable) -> Vec<Option<Footprint>> {
    let views = views(table);
    table
        .images
        .par_iter()
        .zip(views)
        .map(|(image, view)| {
            let gps = image.gps.as_ref().filter(|gps| is_position(gps))?;
            let camera = &table.cameras.get(image.camera.index())?.camera;
            Footprint::new(gps.latitude_deg, gps.longitude_deg, camera, &view?)
        })
        .collect()
}

/// How much ground two photographs share, of what either sees, times the squared cosine between their views: features
/// seen from sides more than a right angle apart don't match. Also the cosine.
fn alike(a: &Footprint, b: &Footprint) -> (f64, f64) {
    let cosine = a.axis.dot(&b.axis);
    if cosine <= 0.0 {
        return (0.0, cosine);
    }
    let (shared, together) = a.overlap_m2(b);
    if shared > 0.0 { (shared / together * cosine * cosine, cosine) } else { (0.0, cosine) }
}

/// The best of (score, whether it looks elsewhere, image), those that look elsewhere in their share if there are any.
fn best(mut scored: Vec<(u32, bool, usize)>, count: usize) -> Vec<usize> {
    scored.sort_by_key(|&(score, _, image)| (std::cmp::Reverse(score), image));
    let elsewhere = scored.iter().filter(|found| found.1).count();
    let reserved = elsewhere.min((OTHER_SIDES_SHARE * count as f64) as usize);
    let mut left = [count - reserved, reserved];
    let mut kept = vec![false; scored.len()];
    for (at, found) in scored.iter().enumerate() {
        // What looks elsewhere may also win an open place, but not the other way round.
        let pool = if found.1 && left[1] > 0 { 1 } else { 0 };
        if left[pool] > 0 {
            left[pool] -= 1;
            kept[at] = true;
        }
    }
    scored.iter().zip(kept).filter(|(_, kept)| *kept).map(|(found, _)| found.2).collect()
}
