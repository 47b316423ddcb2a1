//! From finished models to the outcome: submaps in the scene's terms, and every image's fate.

use terrane_scene::{ImageFate, Observation, Reconstruction, RegisteredImage, Submap, SubmapOutcome};

use crate::cluster::Cluster;
use crate::model::Model;

/// The outcome of a cluster: `models` largest first, `reasons` for the images of no model.
pub(crate) fn outcome(cluster: &Cluster<'_>, models: &[Model<'_>], reasons: &[String]) -> SubmapOutcome {
    let mut fates = Vec::with_capacity(cluster.num_images());
    for (ordinal, image) in cluster.images.iter().enumerate() {
        let submap = models.iter().position(|model| model.is_registered(ordinal));
        let fate = match submap {
            Some(submap) => ImageFate::Registered { submap: submap as u32 },
            None => ImageFate::LeftOut { reason: reasons.get(ordinal).cloned().unwrap_or_default() },
        };
        fates.push((image.image, fate));
    }
    let submaps = models.iter().map(|model| Submap { reconstruction: reconstruction(model) }).collect();
    SubmapOutcome { cluster: cluster.id, submaps, fates }
}

/// A model in the scene's terms. Points keep the order of their creation, which is the same for the same input.
pub(crate) fn reconstruction(model: &Model<'_>) -> Reconstruction {
    let cluster = model.cluster;
    let mut result = Reconstruction::default();
    let registered = model.registered();
    let mut used = vec![false; cluster.cameras.len()];
    for &image in &registered {
        used[cluster.camera_of[image]] = true;
        if let Some(cam_from_world) = model.poses[image] {
            let source = cluster.images[image];
            result.images.push(RegisteredImage {
                image: source.image,
                camera: source.camera,
                cam_from_world,
            });
        }
    }
    for (camera, (id, _)) in cluster.cameras.iter().enumerate() {
        if used[camera] {
            result.cameras.push((*id, model.cameras[camera]));
        }
    }
    for (_, point) in model.points() {
        let mut sum = [0u64; 3];
        let mut track = Vec::with_capacity(point.track.len());
        for &feature in &point.track {
            let [x_px, y_px] = cluster.xy_px_f32(feature);
            let image = cluster.images[cluster.image_of(feature)].image;
            track.push(Observation { image, feature: cluster.index_in_image(feature), x_px, y_px });
            for (total, channel) in sum.iter_mut().zip(cluster.color(feature)) {
                *total += u64::from(channel);
            }
        }
        let count = track.len() as u64;
        let color = sum.map(|total| ((total + count / 2) / count.max(1)) as u8);
        result.push_point(point.x_in_world, color, &track);
    }
    result
}
