//! A cluster checked and indexed: ordinals for images, cameras and features, and the graph of matches between features.
//!
//! Inside this crate an image is its place among the cluster's images in ascending order of id, and a feature is its place
//! in the concatenation of all images' features. Both are plain numbers that never leave the crate.

use nalgebra::Vector2;
use terrane_scene::{CameraId, CameraRecord, ClusterId, MatchedPair, PairKind};

use crate::error::Kind;
use crate::{ClusterImage, ClusterInput, MappingError};

/// A pair by ordinals.
pub(crate) struct ClusterPair<'a> {
    /// Ordinal of the image with the lower id.
    pub first: usize,
    /// Ordinal of the image with the higher id.
    pub second: usize,
    /// Summary and matches.
    pub source: &'a MatchedPair,
}

impl ClusterPair<'_> {
    /// The other image of the pair.
    pub fn other(&self, image: usize) -> usize {
        if image == self.first { self.second } else { self.first }
    }
}

/// The indexed cluster.
pub(crate) struct Cluster<'a> {
    /// Which cluster.
    pub id: ClusterId,
    /// Images, ascending by id.
    pub images: Vec<&'a ClusterImage>,
    /// Cameras, ascending by id.
    pub cameras: Vec<(CameraId, &'a CameraRecord)>,
    /// Ordinal of each image's camera.
    pub camera_of: Vec<usize>,
    /// Pairs that may carry tracks, ascending.
    pub pairs: Vec<ClusterPair<'a>>,
    /// Places in `pairs` of each image's pairs.
    pub pairs_of: Vec<Vec<usize>>,
    /// First feature of each image, and the number of all features.
    offsets: Vec<u32>,
    /// Image of each feature.
    image_of: Vec<u32>,
    /// First neighbour of each feature, and the number of all neighbours.
    starts: Vec<u32>,
    /// Matched features, ascending within each feature's range.
    neighbours: Vec<u32>,
    /// Features whose only match no third image shares, in pairs that do without.
    lone: Vec<bool>,
}

impl<'a> Cluster<'a> {
    /// Checks an input and indexes it. For `two_view_limit` see [`Cluster::is_lone`].
    pub fn new(input: &'a ClusterInput, two_view_limit: usize) -> Result<Self, MappingError> {
        let mut images: Vec<&ClusterImage> = input.images.iter().collect();
        images.sort_by_key(|image| image.image);
        if let Some(twice) = images.windows(2).find(|two| two[0].image == two[1].image) {
            return Err(Kind::DuplicateImage(twice[0].image).into());
        }
        let cameras = check_cameras(input)?;
        let mut camera_of = Vec::with_capacity(images.len());
        let mut offsets = vec![0u32];
        let mut total = 0usize;
        for image in &images {
            camera_of.push(check_image(image, &cameras)?);
            total += image.keypoints_px.len();
            // Neighbours count each match twice and must fit 32 bits as well; 2^31 features are far beyond memory anyway.
            if total > i32::MAX as usize {
                return Err(Kind::TooManyFeatures(total).into());
            }
            offsets.push(total as u32);
        }
        let mut image_of = Vec::with_capacity(total);
        for (ordinal, image) in images.iter().enumerate() {
            image_of.resize(image_of.len() + image.keypoints_px.len(), ordinal as u32);
        }
        let pairs = check_pairs(input, &images)?;
        let mut pairs_of = vec![Vec::new(); images.len()];
        for (at, pair) in pairs.iter().enumerate() {
            pairs_of[pair.first].push(at);
            pairs_of[pair.second].push(at);
        }
        let (starts, neighbours) = adjacency(&pairs, &offsets);
        let mut cluster = Self {
            id: input.cluster,
            images,
            cameras,
            camera_of,
            pairs,
            pairs_of,
            offsets,
            image_of,
            starts,
            neighbours,
            lone: vec![false; total],
        };
        cluster.find_lone(two_view_limit);
        Ok(cluster)
    }

    /// Marks the features of matches that no third image shares, in pairs with enough others.
    fn find_lone(&mut self, two_view_limit: usize) {
        let mut lone = std::mem::take(&mut self.lone);
        for pair in &self.pairs {
            let is_lone =
                |&(a, b): &(u32, u32)| self.neighbours(a).len() == 1 && self.neighbours(b).len() == 1;
            let (alone, shared): (Vec<_>, Vec<_>) = self.matches(pair).partition(is_lone);
            if shared.len() >= two_view_limit {
                alone.into_iter().flat_map(|(a, b)| [a, b]).for_each(|feature| lone[feature as usize] = true);
            }
        }
        self.lone = lone;
    }

    /// Whether a feature's only match is one that no third image shares, in a pair with at least `two_view_limit` others.
    /// Nothing confirms such matches, so they are left out where they are not needed.
    pub fn is_lone(&self, feature: u32) -> bool {
        self.lone[feature as usize]
    }

    /// How many images there are.
    pub fn num_images(&self) -> usize {
        self.images.len()
    }

    /// How many features all images have.
    pub fn num_features(&self) -> usize {
        self.image_of.len()
    }

    /// The features of an image.
    pub fn features_of(&self, image: usize) -> std::ops::Range<u32> {
        self.offsets[image]..self.offsets[image + 1]
    }

    /// The image of a feature.
    pub fn image_of(&self, feature: u32) -> usize {
        self.image_of[feature as usize] as usize
    }

    /// A feature's number within its image.
    pub fn index_in_image(&self, feature: u32) -> u32 {
        feature - self.offsets[self.image_of(feature)]
    }

    /// Where a feature is, in pixels.
    pub fn xy_px(&self, feature: u32) -> Vector2<f64> {
        let [x_px, y_px] = self.xy_px_f32(feature);
        Vector2::new(f64::from(x_px), f64::from(y_px))
    }

    /// Where a feature is, in pixels, as stored.
    pub fn xy_px_f32(&self, feature: u32) -> [f32; 2] {
        self.images[self.image_of(feature)].keypoints_px[self.index_in_image(feature) as usize]
    }

    /// Features matched to a feature.
    pub fn neighbours(&self, feature: u32) -> &[u32] {
        let at = feature as usize;
        &self.neighbours[self.starts[at] as usize..self.starts[at + 1] as usize]
    }

    /// The matches of a pair as features.
    pub fn matches<'s>(&'s self, pair: &'s ClusterPair<'a>) -> impl Iterator<Item = (u32, u32)> + 's {
        let (first, second) = (self.offsets[pair.first], self.offsets[pair.second]);
        pair.source.matches.iter().map(move |[a, b]| (first + a, second + b))
    }

    /// The colour of a feature, grey when the image has none.
    pub fn color(&self, feature: u32) -> [u8; 3] {
        let image = self.images[self.image_of(feature)];
        image.colors.get(self.index_in_image(feature) as usize).copied().unwrap_or([128; 3])
    }
}

fn check_cameras(input: &ClusterInput) -> Result<Vec<(CameraId, &CameraRecord)>, MappingError> {
    let mut cameras: Vec<_> = input.cameras.iter().map(|(id, record)| (*id, record)).collect();
    cameras.sort_by_key(|entry| entry.0);
    if let Some(twice) = cameras.windows(2).find(|two| two[0].0 == two[1].0) {
        return Err(Kind::DuplicateCamera(twice[0].0).into());
    }
    for (id, record) in &cameras {
        let camera = &record.camera;
        let finite = camera.params().iter().all(|value| value.is_finite());
        if !finite || camera.focal_px().min() <= 0.0 || camera.width_px == 0 || camera.height_px == 0 {
            return Err(Kind::BadCamera(*id).into());
        }
    }
    Ok(cameras)
}

/// Checks one image; its camera's ordinal.
fn check_image(image: &ClusterImage, cameras: &[(CameraId, &CameraRecord)]) -> Result<usize, MappingError> {
    let unknown = Kind::UnknownCamera { image: image.image, camera: image.camera };
    let camera = cameras.binary_search_by_key(&image.camera, |entry| entry.0).map_err(|_| unknown)?;
    let (keypoints, colors) = (image.keypoints_px.len(), image.colors.len());
    if colors != 0 && colors != keypoints {
        return Err(Kind::ColorCount { image: image.image, keypoints, colors }.into());
    }
    if !image.keypoints_px.iter().flatten().all(|value| value.is_finite()) {
        return Err(Kind::NotFinite(image.image).into());
    }
    Ok(camera)
}

fn check_pairs<'a>(
    input: &'a ClusterInput,
    images: &[&ClusterImage],
) -> Result<Vec<ClusterPair<'a>>, MappingError> {
    let mut pairs = Vec::with_capacity(input.pairs.len());
    for source in &input.pairs {
        let pair = source.summary.pair;
        let ordinal = |image| images.binary_search_by_key(&image, |entry| entry.image);
        let (Ok(first), Ok(second)) = (ordinal(pair.first()), ordinal(pair.second())) else {
            return Err(Kind::UnknownImage(pair).into());
        };
        for [a, b] in &source.matches {
            for (ordinal, feature) in [(first, *a), (second, *b)] {
                if feature as usize >= images[ordinal].keypoints_px.len() {
                    return Err(Kind::UnknownFeature { pair, image: images[ordinal].image, feature }.into());
                }
            }
        }
        pairs.push(ClusterPair { first, second, source });
    }
    pairs.sort_by_key(|pair| (pair.first, pair.second));
    if let Some(twice) = pairs.windows(2).find(|two| two[0].source.summary.pair == two[1].source.summary.pair)
    {
        return Err(Kind::DuplicatePair(twice[0].source.summary.pair).into());
    }
    // What stays put in the image says nothing of the scene.
    pairs.retain(|pair| pair.source.summary.kind != PairKind::Watermark);
    Ok(pairs)
}

/// Rows of matched features, ascending and without repetition.
fn adjacency(pairs: &[ClusterPair<'_>], offsets: &[u32]) -> (Vec<u32>, Vec<u32>) {
    let num_features = offsets.last().copied().unwrap_or(0) as usize;
    let edges = || {
        pairs.iter().flat_map(|pair| {
            let (first, second) = (offsets[pair.first], offsets[pair.second]);
            pair.source.matches.iter().map(move |[a, b]| (first + a, second + b))
        })
    };
    let mut starts = vec![0u32; num_features + 1];
    for (a, b) in edges() {
        starts[a as usize + 1] += 1;
        starts[b as usize + 1] += 1;
    }
    for at in 0..num_features {
        starts[at + 1] += starts[at];
    }
    let mut filled: Vec<u32> = starts[..num_features].to_vec();
    let mut neighbours = vec![0u32; starts[num_features] as usize];
    for (a, b) in edges() {
        for (from, to) in [(a, b), (b, a)] {
            neighbours[filled[from as usize] as usize] = to;
            filled[from as usize] += 1;
        }
    }
    for at in 0..num_features {
        neighbours[starts[at] as usize..starts[at + 1] as usize].sort_unstable();
    }
    (starts, neighbours)
}
