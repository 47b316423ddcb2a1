//! Nearest neighbours among points, of which many may be equal.

use std::collections::BTreeMap;
use std::num::NonZero;

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Vector3;
use rayon::prelude::*;

/// Different positions, and the images at each.
pub(super) struct Places {
    points: Vec<[f64; 3]>,
    /// Ascending.
    images: Vec<Vec<usize>>,
}

impl Places {
    /// Groups images by position, so that the tree never sees the same point twice.
    pub(super) fn new(positions: &[Option<Vector3<f64>>]) -> Self {
        let mut by_position: BTreeMap<[u64; 3], (Vector3<f64>, Vec<usize>)> = BTreeMap::new();
        for (at, position) in positions.iter().enumerate() {
            let Some(x) = position else { continue };
            let key = [x.x, x.y, x.z].map(f64::to_bits);
            by_position.entry(key).or_insert_with(|| (*x, Vec::new())).1.push(at);
        }
        let (points, images) = by_position.into_values().map(|(x, images)| ([x.x, x.y, x.z], images)).unzip();
        Self { points, images }
    }

    /// What `of` makes of each image that has a position and its `count` nearest as (distance in metres, image), nearest
    /// first, then by nearness in the table, so that ties do not hang on the tree's layout. Ascending by image.
    pub(super) fn map_nearest<T: Send>(
        &self,
        count: usize,
        of: impl Fn(usize, &[(f64, usize)]) -> T + Sync,
    ) -> Vec<(usize, T)> {
        let tree = match self.points.is_empty() {
            true => None,
            false => ImmutableKdTree::<f64, 3>::new_from_slice(&self.points).ok(),
        };
        let of_place = |place: usize| -> Vec<(usize, T)> {
            let near = tree.as_ref().map(|tree| self.places_near(place, tree, count)).unwrap_or_default();
            let of_image = |&image: &usize| (image, of(image, &self.nearest_to(image, &near, count)));
            // Many images at one place are shared out as well.
            self.images[place].par_iter().map(of_image).collect()
        };
        let per_place: Vec<Vec<(usize, T)>> = (0..self.points.len()).into_par_iter().map(of_place).collect();
        let mut lists: Vec<(usize, T)> = per_place.into_iter().flatten().collect();
        lists.sort_by_key(|list| list.0);
        lists
    }

    /// All places as near as the one with the `count`-th nearest image, as (squared distance, place): which of equals the
    /// tree gives is not ours to say.
    fn places_near(&self, place: usize, tree: &ImmutableKdTree<f64, 3>, count: usize) -> Vec<(f64, usize)> {
        let point = &self.points[place];
        let wanted = NonZero::new(count + 1).unwrap_or(NonZero::<usize>::MIN);
        let nearest = tree.query(point).nearest_n::<SquaredEuclidean<f64>>(wanted).execute();
        let mut by_distance: Vec<(f64, usize)> =
            nearest.iter().map(|found| (found.distance, found.item as usize)).collect();
        by_distance.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut reach = 0.0_f64;
        let mut num_images = 0;
        for &(distance, place) in &by_distance {
            reach = reach.max(distance);
            num_images += self.images[place].len();
            if num_images > count {
                break;
            }
        }
        let within = tree
            .query(point)
            .within::<SquaredEuclidean<f64>>(reach * (1.0 + 1e-9) + 1e-12)
            .unsorted()
            .execute();
        within.iter().map(|found| (found.distance, found.item as usize)).collect()
    }

    /// The nearest images of places near an image. Of each place only the `count` next in the table can be among them.
    fn nearest_to(&self, image: usize, near: &[(f64, usize)], count: usize) -> Vec<(f64, usize)> {
        let mut list: Vec<(f64, usize)> = Vec::new();
        for &(distance, place) in near {
            let images = &self.images[place];
            let middle = images.partition_point(|&at| at < image);
            let window = &images[middle.saturating_sub(count)..images.len().min(middle + count + 1)];
            list.extend(window.iter().filter(|&&at| at != image).map(|&at| (distance, at)));
        }
        list.sort_by(|a, b| {
            let closer = a.1.abs_diff(image).cmp(&b.1.abs_diff(image));
            a.0.total_cmp(&b.0).then(closer).then(a.1.cmp(&b.1))
        });
        list.truncate(count);
        list.iter_mut().for_each(|near| near.0 = near.0.sqrt());
        list
    }
}
