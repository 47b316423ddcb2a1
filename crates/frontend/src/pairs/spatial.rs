//! Neighbours on the ground.
//!
//! Positions are taken without their heights: these come in unknown datums, and two flights over one place see the same
//! ground whatever their heights. Distances are chords of the ellipsoid, so nothing happens at the date line or a pole.

use std::collections::BTreeMap;
use std::num::NonZero;

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Vector3;
use rayon::prelude::*;
use terrane_geometry::geodesy::{Geodetic, ecef_from_geodetic};
use terrane_scene::{ImageRecord, ImageTable};

use super::PairOptions;

/// Without a given limit, neighbours beyond this many times the median reach are left out.
const REACH_FACTOR: f64 = 4.0;

/// An image with fewer neighbours within reach than this is also paired by other means.
const FEW_NEIGHBOURS: usize = 3;

/// Spatial neighbours as positions in the table.
pub(super) struct Found {
    /// Image and neighbour.
    pub(super) pairs: Vec<(usize, usize)>,
    /// For each image, whether it has no position or hardly a neighbour within reach.
    pub(super) alone: Vec<bool>,
    /// Images without a position.
    pub(super) without_position: u32,
    /// The reach that was used.
    pub(super) max_distance_m: Option<f64>,
}

/// The nearest images of each image that has a position.
pub(super) fn neighbours(table: &ImageTable, options: &PairOptions) -> Found {
    let num_images = table.images.len();
    let places = Places::new(table);
    let lists = places.nearest(options.spatial_neighbours as usize);
    let max_distance_m =
        options.max_distance_m.filter(|limit| *limit >= 0.0).or_else(|| typical_reach_m(&lists));
    let mut alone = vec![true; num_images];
    let mut pairs = Vec::new();
    for (image, list) in &lists {
        let within = |distance_m: f64| max_distance_m.is_none_or(|limit| distance_m <= limit);
        let near: Vec<usize> = list.iter().filter(|near| within(near.0)).map(|near| near.1).collect();
        alone[*image] = near.len() < FEW_NEIGHBOURS;
        pairs.extend(near.into_iter().map(|near| (*image, near)));
    }
    Found { pairs, alone, without_position: (num_images - lists.len()) as u32, max_distance_m }
}

/// A multiple of the median distance to the last neighbour; `None` without neighbours.
fn typical_reach_m(lists: &[(usize, Vec<(f64, usize)>)]) -> Option<f64> {
    let mut reaches: Vec<f64> = lists.iter().filter_map(|(_, list)| list.last()).map(|last| last.0).collect();
    reaches.sort_by(f64::total_cmp);
    reaches.get(reaches.len() / 2).map(|median| REACH_FACTOR * median)
}

/// Where an image was taken, on the surface of the WGS 84 ellipsoid, earth-centred in metres.
pub(super) fn position_m(image: &ImageRecord) -> Option<Vector3<f64>> {
    let gps = image.gps.as_ref()?;
    let (latitude, longitude) = (gps.latitude_deg, gps.longitude_deg);
    let is_possible = latitude.abs() <= 90.0 && longitude.abs() <= 360.0;
    // Receivers without a fix write zeros.
    if !is_possible || (latitude == 0.0 && longitude == 0.0) {
        return None;
    }
    Some(ecef_from_geodetic(&Geodetic::from_degrees(latitude, longitude, 0.0)))
}

/// Different positions, and the images at each.
struct Places {
    points: Vec<[f64; 3]>,
    images: Vec<Vec<usize>>,
}

impl Places {
    /// Groups images by position, so that the tree never sees the same point twice.
    fn new(table: &ImageTable) -> Self {
        let mut by_position: BTreeMap<[u64; 3], (Vector3<f64>, Vec<usize>)> = BTreeMap::new();
        for (at, image) in table.images.iter().enumerate() {
            let Some(x) = position_m(image) else { continue };
            let key = [x.x, x.y, x.z].map(f64::to_bits);
            by_position.entry(key).or_insert_with(|| (x, Vec::new())).1.push(at);
        }
        let (points, images) = by_position.into_values().map(|(x, images)| ([x.x, x.y, x.z], images)).unzip();
        Self { points, images }
    }

    /// For each image with a position, ascending: its `count` nearest as (distance in metres, image), nearest first,
    /// then by nearness in the table, so that ties do not hang on the tree's layout.
    fn nearest(&self, count: usize) -> Vec<(usize, Vec<(f64, usize)>)> {
        let Some(tree) = self.tree() else {
            return self.images.iter().flatten().map(|&at| (at, Vec::new())).collect();
        };
        let per_place: Vec<Vec<(usize, Vec<(f64, usize)>)>> = (0..self.points.len())
            .into_par_iter()
            .map(|place| self.nearest_of(place, &tree, count))
            .collect();
        let mut lists: Vec<_> = per_place.into_iter().flatten().collect();
        lists.sort_by_key(|list| list.0);
        lists
    }

    fn tree(&self) -> Option<ImmutableKdTree<f64, 3>> {
        if self.points.is_empty() {
            return None;
        }
        ImmutableKdTree::new_from_slice(&self.points).ok()
    }

    /// The neighbours of every image at one place.
    fn nearest_of(
        &self,
        place: usize,
        tree: &ImmutableKdTree<f64, 3>,
        count: usize,
    ) -> Vec<(usize, Vec<(f64, usize)>)> {
        let point = &self.points[place];
        let wanted = NonZero::new(count + 1).unwrap_or(NonZero::<usize>::MIN);
        let nearest = tree.query(point).nearest_n::<SquaredEuclidean<f64>>(wanted).execute();
        // All places as near as the last one: which of equals the tree gives is not ours to say.
        let reach = nearest.iter().map(|found| found.distance).fold(0.0, f64::max);
        let within = tree
            .query(point)
            .within::<SquaredEuclidean<f64>>(reach * (1.0 + 1e-9) + 1e-12)
            .unsorted()
            .execute();
        let mut candidates: Vec<(f64, usize)> = Vec::new();
        for found in within {
            let images = &self.images[found.item as usize];
            candidates.extend(images.iter().map(|&image| (found.distance, image)));
        }
        let of_image = |image: usize| {
            let mut list: Vec<(f64, usize)> =
                candidates.iter().copied().filter(|near| near.1 != image).collect();
            list.sort_by(|a, b| {
                let closer = a.1.abs_diff(image).cmp(&b.1.abs_diff(image));
                a.0.total_cmp(&b.0).then(closer).then(a.1.cmp(&b.1))
            });
            list.truncate(count);
            list.iter_mut().for_each(|near| near.0 = near.0.sqrt());
            (image, list)
        };
        self.images[place].iter().map(|&image| of_image(image)).collect()
    }
}
