//! `terrane compare`: how far the cameras of two results are apart after a robust similarity.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use terrane_geometry::alignment::umeyama;
use terrane_geometry::{Rigid3, Sim3};
use terrane_scene::colmap::ColmapModel;

use crate::args::CompareFlags;
use crate::exit::Failure;
use crate::models;

/// Differences between the cameras of two results that have the same names. Lengths are in the unit of `b`.
#[derive(Clone, Debug, PartialEq)]
struct Differences {
    images: usize,
    only_a: usize,
    only_b: usize,
    kept: usize,
    b_from_a: Sim3,
    center_median: f64,
    center_rmse: f64,
    center_max: f64,
    rotation_median_deg: f64,
    rotation_max_deg: f64,
    worst: String,
}

/// Compares the largest components.
pub fn compare(flags: &CompareFlags, json: bool) -> Result<(), Failure> {
    let a = cameras(&models::read(&models::folder(&flags.a, 0)?)?);
    let b = cameras(&models::read(&models::folder(&flags.b, 0)?)?);
    let found = differences(&a, &b)
        .ok_or_else(|| Failure::short("fewer than three photographs of the same name with cameras that are not on a line: nothing to compare"))?;
    if json {
        println!("{}", as_json(&found));
    } else {
        print!("{}", as_text(&found));
    }
    Ok(())
}

fn cameras(model: &ColmapModel) -> BTreeMap<String, Rigid3> {
    let poses = model.reconstruction.images.iter();
    poses.filter_map(|image| Some((model.name(image.image)?.to_owned(), image.cam_from_world))).collect()
}

/// Fits the similarity of camera centres (Umeyama 1991), leaves out those beyond three medians and fits again until that
/// changes nothing; differences are over all photographs in both.
fn differences(a: &BTreeMap<String, Rigid3>, b: &BTreeMap<String, Rigid3>) -> Option<Differences> {
    let names: Vec<&String> = a.keys().filter(|name| b.contains_key(*name)).collect();
    let from: Vec<Vector3<f64>> = names.iter().map(|name| a[*name].center()).collect();
    let to: Vec<Vector3<f64>> = names.iter().map(|name| b[*name].center()).collect();
    let mut weights = vec![1.0; names.len()];
    let mut b_from_a = umeyama(&from, &to, Some(&weights))?;
    for _ in 0..20 {
        let distances = distances(&b_from_a, &from, &to);
        let limit = (3.0 * median(&distances)).max(1e-12);
        let next: Vec<f64> =
            distances.iter().map(|distance| if *distance <= limit { 1.0 } else { 0.0 }).collect();
        if next == weights {
            break;
        }
        let Some(better) = umeyama(&from, &to, Some(&next)) else { break };
        (b_from_a, weights) = (better, next);
    }
    let centers = distances(&b_from_a, &from, &to);
    let angle = |name: &&String| {
        b_from_a.transform_camera(&a[*name]).rotation.angle_to(&b[*name].rotation).to_degrees()
    };
    let angles: Vec<f64> = names.iter().map(angle).collect();
    let max = |values: &[f64]| values.iter().copied().fold(0.0, f64::max);
    let center_max = max(&centers);
    let worst = centers
        .iter()
        .position(|distance| *distance == center_max)
        .map_or_else(String::new, |at| names[at].clone());
    Some(Differences {
        images: names.len(),
        only_a: a.len() - names.len(),
        only_b: b.len() - names.len(),
        kept: weights.iter().filter(|weight| **weight > 0.0).count(),
        b_from_a,
        center_median: median(&centers),
        center_rmse: (centers.iter().map(|d| d * d).sum::<f64>() / centers.len() as f64).sqrt(),
        center_max,
        rotation_median_deg: median(&angles),
        rotation_max_deg: max(&angles),
        worst,
    })
}

fn distances(b_from_a: &Sim3, from: &[Vector3<f64>], to: &[Vector3<f64>]) -> Vec<f64> {
    from.iter().zip(to).map(|(a, b)| (b_from_a.transform_point(a) - b).norm()).collect()
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(0.0)
}

fn as_json(found: &Differences) -> serde_json::Value {
    serde_json::json!({
        "event": "compare",
        "images": found.images,
        "only_in_a": found.only_a,
        "only_in_b": found.only_b,
        "images_fitted": found.kept,
        "scale_b_from_a": found.b_from_a.scale,
        "center_median": found.center_median,
        "center_rmse": found.center_rmse,
        "center_max": found.center_max,
        "rotation_median_deg": found.rotation_median_deg,
        "rotation_max_deg": found.rotation_max_deg,
        "worst_image": found.worst,
    })
}

fn as_text(found: &Differences) -> String {
    format!(
        "{} images in both, {} only in A, {} only in B; fitted on {}, scale {:.9}\n\
         centres    median {:.6}  rmse {:.6}  max {:.6} ({})  in the unit of B\n\
         rotations  median {:.6}  max {:.6} degrees\n",
        found.images,
        found.only_a,
        found.only_b,
        found.kept,
        found.b_from_a.scale,
        found.center_median,
        found.center_rmse,
        found.center_max,
        found.worst,
        found.rotation_median_deg,
        found.rotation_max_deg,
    )
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;

    fn scene() -> BTreeMap<String, Rigid3> {
        let pose = |i: u32| {
            let center = Vector3::new(f64::from(i % 4), f64::from(i / 4), f64::from(i * i) / 30.0);
            let rotation = UnitQuaternion::from_euler_angles(0.1 * f64::from(i), 0.2, -0.05 * f64::from(i));
            (format!("{i:02}.jpg"), Rigid3::from_rotation_and_center(rotation, &center))
        };
        (0..12).map(pose).collect()
    }

    #[test]
    fn a_similarity_is_no_difference() {
        let moved =
            Sim3::new(2.5, UnitQuaternion::from_euler_angles(1.0, -0.4, 2.0), Vector3::new(5.0, 6.0, -7.0));
        let (a, mut b) = (scene(), BTreeMap::new());
        for (name, pose) in &a {
            b.insert(name.clone(), moved.transform_camera(pose));
        }
        b.remove("03.jpg");
        let found = differences(&a, &b).unwrap();
        assert!(found.center_max < 1e-9 && found.rotation_max_deg < 1e-5, "{found:?}");
        assert!((found.b_from_a.scale - 2.5).abs() < 1e-9);
        assert_eq!((found.images, found.only_a, found.only_b), (11, 1, 0));
    }

    #[test]
    fn a_moved_camera_is_seen_in_full_and_does_not_move_the_others() {
        let (a, mut b) = (scene(), scene());
        let pose = b["05.jpg"];
        b.insert(
            "05.jpg".into(),
            Rigid3::from_rotation_and_center(pose.rotation, &(pose.center() + Vector3::new(0.0, 0.0, 3.0))),
        );
        let found = differences(&a, &b).unwrap();
        assert_eq!((found.worst.as_str(), found.kept), ("05.jpg", 11));
        assert!((found.center_max - 3.0).abs() < 1e-6 && found.center_median < 1e-6, "{found:?}");
    }

    #[test]
    fn too_little_in_common_is_nothing_to_compare() {
        let a = scene();
        let b = a.iter().take(2).map(|(name, pose)| (name.clone(), *pose)).collect();
        assert_eq!(differences(&a, &b), None);
    }
}
