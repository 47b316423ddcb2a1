//! How many features of each image match a point of the model, and how well they cover the image.
//!
//! The score is that of Schönberger & Frahm 2016, section 4.2: a pyramid of grids over the image, each occupied cell of
//! level `l` counting `4^l`, so that points spread over the image count for more than points in a clump.

use crate::cluster::Cluster;

/// Grids of 2×2 to 64×64 cells.
const LEVELS: u32 = 6;
/// Cells of all levels: the sum of `4^l` for `l` from 1 to [`LEVELS`].
const NUM_CELLS: usize = ((1 << (2 * (LEVELS + 1))) - 4) / 3;

/// Matched points of one image.
#[derive(Clone)]
struct ImageCover {
    cells: Vec<u32>,
    score: u64,
    num_visible: u32,
}

/// Visibility of the model's points in all images, kept up to date point by point.
#[derive(Clone)]
pub(crate) struct Visibility {
    images: Vec<ImageCover>,
    /// Matches of each feature that are part of some point.
    matched_points: Vec<u32>,
}

impl Visibility {
    /// Nothing is visible yet.
    pub fn new(cluster: &Cluster<'_>) -> Self {
        let cover = ImageCover { cells: vec![0; NUM_CELLS], score: 0, num_visible: 0 };
        Self { images: vec![cover; cluster.num_images()], matched_points: vec![0; cluster.num_features()] }
    }

    /// Features of an image that match some point.
    pub fn num_visible(&self, image: usize) -> u32 {
        self.images[image].num_visible
    }

    /// How well these features cover the image.
    pub fn score(&self, image: usize) -> u64 {
        self.images[image].score
    }

    /// Whether a feature matches some point.
    pub fn is_visible(&self, feature: u32) -> bool {
        self.matched_points[feature as usize] > 0
    }

    /// A feature became part of a point: its matches see that point.
    pub fn add(&mut self, cluster: &Cluster<'_>, feature: u32) {
        for &neighbour in cluster.neighbours(feature) {
            let count = &mut self.matched_points[neighbour as usize];
            *count += 1;
            if *count == 1 {
                let cover = &mut self.images[cluster.image_of(neighbour)];
                cover.num_visible += 1;
                for (cell, weight) in cells_of(cluster, neighbour) {
                    cover.cells[cell] += 1;
                    if cover.cells[cell] == 1 {
                        cover.score += weight;
                    }
                }
            }
        }
    }

    /// A feature is no longer part of a point.
    pub fn remove(&mut self, cluster: &Cluster<'_>, feature: u32) {
        for &neighbour in cluster.neighbours(feature) {
            let count = &mut self.matched_points[neighbour as usize];
            *count -= 1;
            if *count == 0 {
                let cover = &mut self.images[cluster.image_of(neighbour)];
                cover.num_visible -= 1;
                for (cell, weight) in cells_of(cluster, neighbour) {
                    cover.cells[cell] -= 1;
                    if cover.cells[cell] == 0 {
                        cover.score -= weight;
                    }
                }
            }
        }
    }
}

/// The cell of a feature on each level, with the level's weight.
fn cells_of(cluster: &Cluster<'_>, feature: u32) -> impl Iterator<Item = (usize, u64)> {
    let camera = &cluster.cameras[cluster.camera_of[cluster.image_of(feature)]].1.camera;
    let [x_px, y_px] = cluster.xy_px_f32(feature);
    let share = |value: f32, size: u32| (value / size as f32).clamp(0.0, 1.0);
    let (x, y) = (share(x_px, camera.width_px), share(y_px, camera.height_px));
    let mut first = 0usize;
    (1..=LEVELS).map(move |level| {
        let side = 1usize << level;
        let place = |share: f32| ((share * side as f32) as usize).min(side - 1);
        let cell = first + place(y) * side + place(x);
        first += side * side;
        (cell, (side * side) as u64)
    })
}
