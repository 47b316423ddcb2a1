//! The whole chain on a synthetic aerial block: cut, map each cluster, align, place, average, merge, adjust; beside
//! the same block mapped in one shot.

use nalgebra::Vector3;
use terrane_fusion::adjust::{AdjustInput, AdjustOptions, adjust};
use terrane_fusion::align::{AlignOptions, Seam, align};
use terrane_fusion::average::{CameraAverageOptions, PlaceOptions, average_cameras, place};
use terrane_fusion::georegister::{GeoOutcome, LocalPosition};
use terrane_fusion::merge::{MergeOptions, assemble, merge};
use terrane_fusion::{SubmapSummary, seams};
use terrane_geometry::Seed;
use terrane_mapping::{ClusterImage, ClusterInput, MappingOptions, reconstruct};
use terrane_scene::{ClusterId, FocalSource, ImageId, PairSummary, Reconstruction};
use terrane_testkit::compare;
use terrane_testkit::scene::{Layout, SceneOptions, SyntheticScene};
use terrane_viewgraph::{PartitionOptions, ViewGraph, ViewGraphOptions, partition};

const SEED: Seed = Seed(5);
const NUM_IMAGES: u32 = 48;

fn scene() -> SyntheticScene {
    SyntheticScene::new(&SceneOptions {
        layout: Layout::Nadir { height_m: 60.0, spacing_m: 12.0, row_spacing_m: 16.0, relief_m: 8.0 },
        num_images: NUM_IMAGES as usize,
        num_points: 3500,
        outlier_fraction: 0.02,
        focal_source: FocalSource::Exif,
        ..Default::default()
    })
}

fn map(scene: &SyntheticScene, images: &[ImageId], cluster: u32) -> Option<Reconstruction> {
    let inside = |image: ImageId| images.binary_search(&image).is_ok();
    let input = ClusterInput {
        cluster: ClusterId(cluster),
        images: images
            .iter()
            .map(|image| &scene.images[image.index()])
            .map(|image| ClusterImage {
                image: image.image,
                camera: image.camera,
                keypoints_px: image.keypoints_px.clone(),
                colors: image.colors.clone(),
                position_prior: None,
            })
            .collect(),
        cameras: scene.cameras.clone(),
        pairs: scene
            .pairs
            .iter()
            .filter(|pair| inside(pair.summary.pair.first()) && inside(pair.summary.pair.second()))
            .cloned()
            .collect(),
    };
    let seed = SEED.item(&[u64::from(cluster)]);
    let (outcome, _) = reconstruct(&input, &MappingOptions::default(), seed).expect("the input is valid");
    outcome.submaps.into_iter().next().map(|submap| submap.reconstruction)
}

fn positions(truth: &Reconstruction, sigma_m: f64) -> Vec<LocalPosition> {
    let unit = |image: u32, axis: u64| {
        let draws =
            (0..6).map(|k| SEED.item(&[u64::from(image), axis, k]).0 as f64 / u64::MAX as f64 * 2.0 - 1.0);
        draws.sum::<f64>() / 2f64.sqrt()
    };
    let position = |image: &terrane_scene::RegisteredImage| {
        let noise = Vector3::new(unit(image.image.0, 0), unit(image.image.0, 1), unit(image.image.0, 2));
        let x_in_enu = image.cam_from_world.center() + sigma_m * noise;
        LocalPosition { image: image.image, x_in_enu, sigma_m: Vector3::repeat(sigma_m) }
    };
    truth.images.iter().map(position).collect()
}

#[test]
fn a_block_in_clusters_is_as_good_as_in_one_shot() {
    let scene = scene();
    let summaries: Vec<PairSummary> = scene.pairs.iter().map(|pair| pair.summary.clone()).collect();
    let (graph, graph_report) = ViewGraph::build(NUM_IMAGES, &summaries, &ViewGraphOptions::default());
    assert_eq!(graph_report.component_sizes, [NUM_IMAGES]);
    let cut = PartitionOptions { max_cluster_size: 22, ..Default::default() };
    let parts = partition(&graph, &cut, SEED);
    assert!(parts.clusters.len() >= 4, "{:?}", parts.report);

    let submaps: Vec<Reconstruction> = parts
        .clusters
        .iter()
        .map(|cluster| map(&scene, &cluster.images, cluster.id.0).expect("every cluster can be mapped"))
        .collect();
    let aligned: Vec<Seam> = parts
        .seams
        .iter()
        .map(|seam| {
            let (a, b) = (&submaps[seam.a.index()], &submaps[seam.b.index()]);
            let seed = SEED.item(&[u64::from(seam.a.0), u64::from(seam.b.0)]);
            Seam { a: seam.a.0, b: seam.b.0, outcome: align(a, b, &AlignOptions::default(), seed) }
        })
        .collect();
    let accepted = aligned.iter().filter(|seam| seam.outcome.accepted().is_some()).count();
    assert!(accepted * 10 >= aligned.len() * 8, "{accepted} of {} seams: {aligned:#?}", aligned.len());

    let summaries: Vec<SubmapSummary> = submaps.iter().map(|submap| SubmapSummary::of(submap, 20)).collect();
    let gps = positions(&scene.truth, 2.0);
    let placement = place(&summaries, &aligned, &gps, &PlaceOptions::default(), SEED);
    assert_eq!(placement.components.len(), 1, "{:#?}", placement.seams);
    assert!(matches!(placement.components[0].geo, GeoOutcome::Registered { .. }));
    let averages = average_cameras(&summaries, &placement, 0, &CameraAverageOptions::default());
    let all: Vec<&Reconstruction> = submaps.iter().collect();
    let mut merged = merge(
        &all,
        &placement,
        &averages,
        0,
        &MergeOptions { observations_per_shard: 6000, ..Default::default() },
    );
    assert!(merged.shards.len() >= 2);
    let before = assemble(&merged.cameras, &merged.shards);
    let seams = seams::seam_images(&summaries, &placement, 0);
    let input = AdjustInput { positions: &gps, seams: &seams, ..Default::default() };
    let report = adjust(&mut merged.cameras, &mut merged.shards, &input, &AdjustOptions::default())
        .expect("it adjusts");
    let whole = assemble(&merged.cameras, &merged.shards);

    let every_image: Vec<ImageId> = (0..NUM_IMAGES).map(ImageId).collect();
    let one_shot = map(&scene, &every_image, 99).expect("the whole can be mapped");
    let error = |got: &Reconstruction, fit| compare::cameras(got, &scene.truth, fit).expect("enough cameras");
    let (merged_error, averaged_error, one_shot_error) =
        (error(&whole, true), error(&before, true), error(&one_shot, true));
    println!(
        "clusters {} seams {} | centre RMSE: one shot {:.4} m, averaged {:.4} m, adjusted {:.4} m, absolute {:.3} m | \
         reprojection: one shot {:.4} px, merged {:.4} px, adjusted {:.4} px | points {} and {} | tracks {:.2} and {:.2}",
        parts.clusters.len(),
        aligned.len(),
        one_shot_error.center_rmse_m,
        averaged_error.center_rmse_m,
        merged_error.center_rmse_m,
        error(&whole, false).center_rmse_m,
        one_shot.mean_reprojection_error_px(),
        report.initial_mean_error_px,
        report.mean_error_px,
        one_shot.points.len(),
        whole.points.len(),
        one_shot.mean_track_length(),
        whole.mean_track_length(),
    );
    assert_eq!(whole.images.len(), one_shot.images.len());
    assert!(merged_error.center_rmse_m <= 1.25 * one_shot_error.center_rmse_m + 0.01);
    assert!(averaged_error.center_rmse_m > merged_error.center_rmse_m, "adjustment must help");
    assert!(report.mean_error_px <= 1.02 * one_shot.mean_reprojection_error_px());
    assert!(error(&whole, false).center_rmse_m < 1.5, "the frame is that of the positions");
}
