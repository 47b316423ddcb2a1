//! Which observation is which 2D point: gathered image by image while memory stays bounded.

use std::ops::Range;

use super::Point2;
use crate::{Model, SceneError};

/// Counts of a model.
pub(super) struct Layout {
    pub num_points: u64,
    observations_of_image: Vec<u64>,
    observations_of_shard: Vec<usize>,
}

/// One observation on its way to its image.
struct Gathered {
    feature: u32,
    point: u64,
    xy_px: [f64; 2],
    shard: u32,
    at: u32,
}

impl Layout {
    pub fn of(model: &dyn Model) -> Result<Self, SceneError> {
        let mut layout = Self {
            num_points: 0,
            observations_of_image: vec![0; model.images().len()],
            observations_of_shard: Vec::new(),
        };
        for shard_index in 0..model.num_shards() {
            let shard = model.shard(shard_index)?;
            layout.num_points += shard.points.len() as u64;
            let mut count = 0;
            for observation in shard.points.iter().flat_map(|point| shard.track(point)) {
                let at = position(model, observation.image)?;
                layout.observations_of_image[at] += 1;
                count += 1;
            }
            layout.observations_of_shard.push(count);
        }
        Ok(layout)
    }

    /// For each observation of each shard its place among the points of its image, to be filled by `gather`.
    pub fn empty_ranks(&self) -> Vec<Vec<u32>> {
        self.observations_of_shard.iter().map(|count| vec![0; *count]).collect()
    }

    /// Consecutive images that together have at most so many observations, one image at least.
    pub fn batches(&self, observations: u64) -> Vec<Range<usize>> {
        let mut batches = Vec::new();
        let (mut start, mut sum) = (0, 0);
        for (at, count) in self.observations_of_image.iter().enumerate() {
            if at > start && sum + count > observations {
                batches.push(start..at);
                (start, sum) = (at, 0);
            }
            sum += count;
        }
        if start < self.observations_of_image.len() {
            batches.push(start..self.observations_of_image.len());
        }
        batches
    }

    /// The 2D points of a batch of images, each in the order of features; notes their ranks.
    pub fn gather(
        &self,
        model: &dyn Model,
        images: Range<usize>,
        ranks: &mut [Vec<u32>],
    ) -> Result<Vec<Vec<Point2>>, SceneError> {
        let mut of_image: Vec<Vec<Gathered>> = images.clone().map(|_| Vec::new()).collect();
        let mut number = 0;
        for shard_index in 0..model.num_shards() {
            let shard = model.shard(shard_index)?;
            let mut at = 0;
            for scene_point in &shard.points {
                number += 1;
                for observation in shard.track(scene_point) {
                    let image = position(model, observation.image)?;
                    if images.contains(&image) {
                        of_image[image - images.start].push(Gathered {
                            feature: observation.feature,
                            point: number,
                            xy_px: observation.xy_px().into(),
                            shard: shard_index as u32,
                            at,
                        });
                    }
                    at += 1;
                }
            }
        }
        for gathered in &mut of_image {
            gathered.sort_by_key(|entry| (entry.feature, entry.point));
            for (rank, entry) in gathered.iter().enumerate() {
                ranks[entry.shard as usize][entry.at as usize] = rank as u32;
            }
        }
        let points = |gathered: Vec<Gathered>| {
            gathered.into_iter().map(|entry| Point2 { xy_px: entry.xy_px, point: entry.point }).collect()
        };
        Ok(of_image.into_iter().map(points).collect())
    }
}

fn position(model: &dyn Model, image: crate::ImageId) -> Result<usize, SceneError> {
    model
        .images()
        .binary_search_by_key(&image, |entry| entry.image)
        .map_err(|_| SceneError::invalid(format!("a point is seen by image {image}, which has no pose")))
}
