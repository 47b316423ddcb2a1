//! Merging parts of a known scene gives the scene back.

use terrane_geometry::Sim3;

use super::*;
use crate::average::{PlacedComponent, Placement};
use crate::georegister::GeoOutcome;
use crate::test_support::{Draws, EXACT, Noise, USUAL, block, ids, submap};

/// Two overlapping parts, placed by the truth, with the true cameras.
fn two_parts(noise: Noise) -> (Reconstruction, Vec<Reconstruction>, Placement, CameraAverages) {
    let scene = block(40, 2000);
    let mut draws = Draws::new(4);
    let moves = [draws.similarity(), draws.similarity()];
    let parts = vec![
        submap(&scene.truth, &ids(0..24), &moves[0], noise, 1),
        submap(&scene.truth, &ids(16..40), &moves[1], noise, 2),
    ];
    let geo = GeoOutcome::NotRegistered { reason: "no positions".into(), frame_from_local: Sim3::identity() };
    let placement = Placement {
        world_from_submap: moves.iter().map(Sim3::inverse).collect(),
        component_of: vec![0, 0],
        components: vec![PlacedComponent { submaps: vec![0, 1], num_images: 40, geo }],
        seams: Vec::new(),
    };
    let averages = CameraAverages { images: scene.truth.images.clone(), ..Default::default() };
    (scene.truth, parts, placement, averages)
}

fn merged(noise: Noise, options: &MergeOptions) -> (Reconstruction, MergedComponent) {
    let (truth, parts, placement, averages) = two_parts(noise);
    let parts: Vec<&Reconstruction> = parts.iter().collect();
    (truth, merge(&parts, &placement, &averages, 0, options))
}

#[test]
fn exact_parts_give_the_whole_back() {
    let (truth, component) = merged(EXACT, &MergeOptions::default());
    let whole = assemble(&component.cameras, &component.shards);
    // Points that both see are one; points with fewer than two cameras in either part are lost.
    assert!(component.report.num_joined > 100, "{:?}", component.report);
    assert_eq!(
        component.report.num_conflicts + component.report.num_too_far + component.report.num_contested,
        0
    );
    assert!(whole.points.len() <= truth.points.len());
    assert!((whole.mean_reprojection_error_px() / truth.mean_reprojection_error_px() - 1.0).abs() < 0.05);
    let params = whole.cameras[0].1.params().iter().zip(truth.cameras[0].1.params());
    params.for_each(|(got, wanted)| assert!((got - wanted).abs() < 1e-9));
}

#[test]
fn every_observation_is_owned_once_and_images_are_seen_once_by_a_track() {
    let (_, component) = merged(USUAL, &MergeOptions::default());
    let mut owned = Vec::new();
    for shard in &component.shards {
        for point in &shard.points {
            let track = shard.track(point);
            assert!(track.len() >= 2);
            assert!(
                track.windows(2).all(|pair| pair[0].image < pair[1].image),
                "an image twice, or out of order"
            );
            owned.extend(track.iter().map(|seen| (seen.image, seen.feature)));
        }
    }
    let count = owned.len();
    owned.sort_unstable();
    owned.dedup();
    assert_eq!(owned.len(), count);
    assert_eq!(count as u64, component.report.num_observations);
}

#[test]
fn shards_are_small_and_apart_and_hold_everything() {
    let whole = merged(EXACT, &MergeOptions::default()).1;
    let options = MergeOptions { observations_per_shard: 1500, ..Default::default() };
    let (_, sharded) = merged(EXACT, &options);
    assert!(sharded.shards.len() >= 4);
    assert!(sharded.shards.iter().all(|shard| shard.observations.len() <= 1500 && !shard.points.is_empty()));
    assert_eq!(sharded.report, whole.report);
}

#[test]
fn points_that_lie_apart_are_not_joined() {
    let (_, mut parts, placement, averages) = two_parts(EXACT);
    let shift = 20.0 / placement.world_from_submap[0].scale;
    parts[0].points.iter_mut().for_each(|point| point.x_in_world.x += shift);
    let parts: Vec<&Reconstruction> = parts.iter().collect();
    let component = merge(&parts, &placement, &averages, 0, &MergeOptions::default());
    assert_eq!(component.report.num_joined, 0);
    assert!(component.report.num_too_far > 100);
    assert!(component.report.num_contested > 100, "what both claim is given to one");
}

#[test]
fn tracks_that_conflict_stay_apart() {
    let (_, mut parts, placement, averages) = two_parts(EXACT);
    // In one part, a shared point's track also owns a wrong feature of a shared image.
    let wrong = ImageId(18);
    for seen in parts[1].observations.iter_mut().filter(|seen| seen.image == wrong) {
        seen.feature += 100_000;
    }
    let parts: Vec<&Reconstruction> = parts.iter().collect();
    let component = merge(&parts, &placement, &averages, 0, &MergeOptions::default());
    assert!(component.report.num_conflicts > 20, "{:?}", component.report);
    assert!(component.report.num_joined > 20, "{:?}", component.report);
}

#[test]
fn nothing_merges_to_nothing() {
    let component =
        merge(&[], &Placement::default(), &CameraAverages::default(), 0, &MergeOptions::default());
    assert!(component.shards.is_empty() && component.cameras.images.is_empty());
}
