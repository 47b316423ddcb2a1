//! The model's running counts against a count from scratch.

use nalgebra::Vector3;
use proptest::prelude::*;
use terrane_geometry::Rigid3;
use terrane_testkit::scene::{SceneOptions, SyntheticScene};

use super::cluster_of;
use crate::cluster::Cluster;
use crate::model::Model;
use crate::visibility::Visibility;

/// What the model should say, counted anew.
fn check(model: &Model<'_>) {
    let cluster = model.cluster;
    let mut visibility = Visibility::new(cluster);
    let mut observed = vec![0u32; cluster.num_images()];
    let mut observations = 0;
    for (id, point) in model.points() {
        assert!(point.track.len() >= 2);
        assert!(point.track.windows(2).all(|two| cluster.image_of(two[0]) < cluster.image_of(two[1])));
        for &feature in &point.track {
            assert_eq!(model.point_of(feature), Some(id));
            assert!(model.observes(id, cluster.image_of(feature)));
            observed[cluster.image_of(feature)] += 1;
            observations += 1;
            visibility.add(cluster, feature);
        }
    }
    assert_eq!(model.num_observations(), observations);
    assert_eq!(model.num_points(), model.points().count());
    for image in 0..cluster.num_images() {
        assert_eq!(model.num_observed(image), observed[image]);
        assert_eq!(model.visibility.num_visible(image), visibility.num_visible(image));
        assert_eq!(model.visibility.score(image), visibility.score(image));
        assert_eq!(model.points_of_image(image).len(), observed[image] as usize);
    }
    let linked =
        (0..cluster.num_features() as u32).filter(|&feature| model.point_of(feature).is_some()).count();
    assert_eq!(linked, observations);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn counts_follow_every_change(steps in prop::collection::vec((0u8..5, any::<u32>(), any::<u32>()), 1..60)) {
        let options = SceneOptions { num_images: 4, num_points: 60, min_matches: 5, ..SceneOptions::default() };
        let input = cluster_of(&SyntheticScene::new(&options));
        let cluster = Cluster::new(&input, 0).expect("the input is sound");
        let cameras = cluster.cameras.iter().map(|(_, record)| record.camera).collect();
        let mut model = Model::new(&cluster, cameras, vec![false]);
        let count = cluster.num_features() as u32;
        for (what, a, b) in steps {
            let ids = model.point_ids();
            match what {
                0 | 1 => {
                    model.set_pose(cluster.image_of(a % count), Rigid3::identity());
                    model.add_point(Vector3::zeros(), &[a % count, b % count, (a ^ b) % count]);
                }
                2 if !ids.is_empty() => {
                    model.add_observation(ids[a as usize % ids.len()], b % count);
                }
                3 => model.remove_observation(a % count),
                4 if b % 8 == 0 => model.deregister(cluster.image_of(a % count)),
                _ => {}
            }
        }
        check(&model);
    }
}

#[test]
fn spread_points_score_higher_than_a_clump() {
    let input = cluster_of(&SyntheticScene::new(&SceneOptions { num_images: 2, ..SceneOptions::default() }));
    let cluster = Cluster::new(&input, 0).expect("the input is sound");
    let mut by_column: Vec<(u32, u32)> = cluster.matches(&cluster.pairs[0]).collect();
    by_column.sort_by(|a, b| cluster.xy_px(a.1).x.total_cmp(&cluster.xy_px(b.1).x));
    let score = |features: &mut dyn Iterator<Item = u32>| {
        let mut visibility = Visibility::new(&cluster);
        features.for_each(|feature| visibility.add(&cluster, feature));
        assert_eq!(visibility.num_visible(1), 40);
        visibility.score(1)
    };
    let clump = score(&mut by_column.iter().take(40).map(|entry| entry.0));
    let step = by_column.len() / 40;
    let spread = score(&mut by_column.iter().step_by(step).take(40).map(|entry| entry.0));
    assert!(spread > clump, "{spread} {clump}");
}
