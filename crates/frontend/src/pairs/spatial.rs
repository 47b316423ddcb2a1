//! Neighbours on the ground: by what they see where that is known, else by where they were taken.
//!
//! Positions are taken without their heights: these come in unknown datums, and two flights over one place see the same
//! ground whatever their heights. Distances are chords of the ellipsoid, so nothing happens at the date line or a pole.

use nalgebra::Vector3;
use terrane_geometry::geodesy::{Geodetic, ecef_from_geodetic};
use terrane_scene::{GpsPrior, ImageRecord, ImageTable};

use super::PairOptions;
use super::overlap;
use super::places::Places;

/// Without a given limit, neighbours beyond this many times the median reach are left out.
const REACH_FACTOR: f64 = 4.0;

/// An image with fewer neighbours within reach than this is also paired by other means.
const FEW_NEIGHBOURS: usize = 3;

/// Of the neighbours wanted, the share that comes from the nearest positions when footprints give fewer: one part in
/// this. Heights and angles may be wrong, and where few overlap, each counts.
const FILLED_PART: usize = 3;

/// Spatial neighbours as positions in the table.
pub(super) struct Found {
    /// Image and neighbour.
    pub(super) pairs: Vec<(usize, usize)>,
    /// Pairs of overlapping footprints among them, by image.
    pub(super) by_footprint: Vec<(usize, usize)>,
    /// For each image, whether it has no position or hardly a neighbour within reach.
    pub(super) alone: Vec<bool>,
    /// Images without a position.
    pub(super) without_position: u32,
    /// Images whose footprint was used.
    pub(super) num_footprints: u32,
    /// The reach that was used.
    pub(super) max_distance_m: Option<f64>,
}

/// The neighbours of each image that has a position.
pub(super) fn neighbours(table: &ImageTable, options: &PairOptions) -> Found {
    let num_images = table.images.len();
    let wanted = options.spatial_neighbours as usize;
    let positions: Vec<Option<Vector3<f64>>> = table.images.iter().map(position_m).collect();
    let lists = Places::new(&positions).map_nearest(wanted, |_, near| near.to_vec());
    let max_distance_m =
        options.max_distance_m.filter(|limit| *limit >= 0.0).or_else(|| typical_reach_m(&lists));
    let overlaps = match options.footprints {
        true => overlap::neighbours(table, wanted, options.min_overlap),
        false => overlap::Overlaps { lists: vec![None; num_images], num_footprints: 0 },
    };
    let trusted = are_plausible(&overlaps.lists);
    let mut found = Found {
        pairs: Vec::new(),
        by_footprint: Vec::new(),
        alone: vec![true; num_images],
        without_position: (num_images - lists.len()) as u32,
        num_footprints: if trusted { overlaps.num_footprints } else { 0 },
        max_distance_m,
    };
    for (image, nearest) in &lists {
        let is_within = |distance_m: f64| max_distance_m.is_none_or(|limit| distance_m <= limit);
        let within = nearest.iter().filter(|near| is_within(near.0)).map(|near| near.1);
        let near: Vec<usize> = match overlaps.lists[*image].as_ref().filter(|_| trusted) {
            Some(overlapping) => {
                found.by_footprint.extend(overlapping.iter().map(|&other| (*image, other)));
                filled(overlapping, within, wanted.div_ceil(FILLED_PART))
            }
            None => within.collect(),
        };
        found.alone[*image] = near.len() < FEW_NEIGHBOURS;
        found.pairs.extend(near.into_iter().map(|near| (*image, near)));
    }
    found
}

/// A list with others added until it has `least`.
fn filled(list: &[usize], others: impl Iterator<Item = usize>, least: usize) -> Vec<usize> {
    let mut all = list.to_vec();
    for other in others {
        if all.len() >= least {
            break;
        }
        if !list.contains(&other) {
            all.push(other);
        }
    }
    all
}

/// Whether footprints can be believed: photographs that are meant to be joined overlap. Where most of them share ground
/// with hardly any other, heights or angles are wrong.
fn are_plausible(lists: &[Option<Vec<usize>>]) -> bool {
    let known = lists.iter().flatten().count();
    let lonely = lists.iter().flatten().filter(|list| list.len() < FEW_NEIGHBOURS).count();
    2 * lonely <= known
}

/// A multiple of the median distance to the last neighbour; `None` without neighbours.
fn typical_reach_m(lists: &[(usize, Vec<(f64, usize)>)]) -> Option<f64> {
    let mut reaches: Vec<f64> = lists.iter().filter_map(|(_, list)| list.last()).map(|last| last.0).collect();
    reaches.sort_by(f64::total_cmp);
    reaches.get(reaches.len() / 2).map(|median| REACH_FACTOR * median)
}

/// Whether a receiver had a fix: those without one write zeros.
pub(super) fn is_position(gps: &GpsPrior) -> bool {
    let (latitude, longitude) = (gps.latitude_deg, gps.longitude_deg);
    let has_fix = latitude != 0.0 || longitude != 0.0;
    has_fix && latitude.abs() <= 90.0 && longitude.abs() <= 360.0
}

/// Where an image was taken, on the surface of the WGS 84 ellipsoid, earth-centred in metres.
pub(super) fn position_m(image: &ImageRecord) -> Option<Vector3<f64>> {
    let gps = image.gps.as_ref().filter(|gps| is_position(gps))?;
    Some(ecef_from_geodetic(&Geodetic::from_degrees(gps.latitude_deg, gps.longitude_deg, 0.0)))
}
