//! Pair selection against its definition on made-up tables, and blocks against their limits.

use super::*;
use rand::RngExt;
use terrane_geometry::{Camera, CameraModel, Seed};
use terrane_scene::{CameraId, CameraRecord, FocalSource, GpsPrior, ImageRecord, Orientation};

fn image(path: &str, gps: Option<(f64, f64)>, captured_s: Option<f64>) -> ImageRecord {
    let gps = gps.map(|(latitude_deg, longitude_deg)| GpsPrior {
        latitude_deg,
        longitude_deg,
        altitude_m: None,
        sigma_horizontal_m: 5.0,
        sigma_vertical_m: 10.0,
    });
    ImageRecord {
        path: path.into(),
        content_hash: String::new(),
        camera: CameraId(0),
        width_px: 100,
        height_px: 100,
        orientation: Orientation::default(),
        gps,
        flight: None,
        captured_s,
    }
}

fn table(images: Vec<ImageRecord>) -> ImageTable {
    let camera = CameraRecord {
        camera: Camera::centered(CameraModel::SimpleRadial, 100, 100, 120.0),
        focal_source: FocalSource::Guess,
        name: "test".into(),
    };
    ImageTable { cameras: vec![camera], images, rejected: Vec::new() }
}

fn plain(count: usize) -> ImageTable {
    table((0..count).map(|at| image(&format!("a/{at:04}.jpg"), None, None)).collect())
}

/// A square grid of positions, `spacing_m` apart, at 45 degrees north across the date line.
pub(super) fn grid(side: usize, spacing_m: f64) -> ImageTable {
    let (north_deg, east_deg) = (spacing_m / 111_132.0, spacing_m / 78_847.0);
    let place = |at: usize| {
        let (row, column) = (at / side, at % side);
        let longitude_deg = 179.9995 + column as f64 * east_deg;
        let wrapped = if longitude_deg > 180.0 { longitude_deg - 360.0 } else { longitude_deg };
        (45.0 + row as f64 * north_deg, wrapped)
    };
    table((0..side * side).map(|at| image(&format!("{at:04}.jpg"), Some(place(at)), None)).collect())
}

pub(super) fn options(mode: PairMode) -> PairOptions {
    PairOptions { mode, ..PairOptions::default() }
}

fn similar(index: u32) -> Similar {
    Similar { index, similarity: 0.5, votes: 0 }
}

pub(super) fn as_numbers(pairs: &[ImagePair]) -> Vec<(u32, u32)> {
    pairs.iter().map(|pair| (pair.first().0, pair.second().0)).collect()
}

#[test]
fn small_runs_take_every_pair_and_large_ones_do_not() {
    for count in [0, 1, 2, 60] {
        let selection = select(&plain(count), None, &PairOptions::default());
        assert_eq!(selection.pairs.len(), count * count.saturating_sub(1) / 2);
        assert_eq!(selection.report.from_exhaustive, selection.report.num_pairs);
    }
    let selection = select(&plain(61), None, &PairOptions::default());
    assert!(selection.report.retrieval_missing);
    assert_eq!(selection.report.from_exhaustive, 0);
    assert_eq!(selection.pairs.len(), 61 * 10 - 55, "ten neighbours onwards, less what is cut at the end");
}

#[test]
fn spatial_neighbours_are_the_nearest_across_the_date_line() {
    let table = grid(12, 20.0);
    let mut wanted = options(PairMode::Gps);
    wanted.spatial_neighbours = 4;
    let selection = select(&table, None, &wanted);
    let pairs = as_numbers(&selection.pairs);
    for at in (0..144u32).filter(|at| at % 12 > 0 && at % 12 < 11 && *at >= 12 && *at < 132) {
        for other in [at - 1, at + 1, at - 12, at + 12] {
            assert!(pairs.contains(&(at.min(other), at.max(other))), "{at} and {other} are 20 m apart");
        }
    }
    assert_eq!(selection.report.without_gps, 0);
    let reach = selection.report.max_distance_m.expect("a typical reach");
    assert!(reach > 75.0 && reach < 90.0, "{reach}");
}

#[test]
fn auto_uses_gps_and_pairs_images_without_it_by_other_means() {
    let mut mixed = grid(10, 20.0);
    mixed.images[37].gps = None;
    mixed.images[38].gps =
        Some(GpsPrior { latitude_deg: f64::NAN, ..mixed.images[0].gps.expect("set above") });
    mixed.images[39].gps = Some(GpsPrior { latitude_deg: 12.0, ..mixed.images[0].gps.expect("set above") });
    let wanted = wanted_similar(&mixed, &PairOptions::default()).expect("some need their looks");
    let named: Vec<usize> = (0..100).filter(|&image| wanted[image]).collect();
    assert_eq!(named, [37, 38, 39]);
    assert!(wanted_similar(&grid(10, 20.0), &PairOptions::default()).is_none());
    let looks: Vec<Vec<Similar>> = (0..100).map(|at| vec![similar((at + 50) % 100)]).collect();
    let selection = select(&mixed, Some(&looks), &PairOptions::default());
    let pairs = as_numbers(&selection.pairs);
    assert_eq!(selection.report.without_gps, 2);
    assert!(pairs.contains(&(37, 87)), "the most similar image");
    assert!(pairs.contains(&(39, 89)), "an image far from all others is also found by its looks");
    assert!(!pairs.contains(&(4, 54)), "looks are not asked for where there is a position");
    assert!(selection.report.images_without_pair.is_empty());
}

#[test]
fn many_images_at_one_place_are_no_trouble() {
    let mut crowd = grid(10, 20.0);
    let first = crowd.images[0].gps;
    crowd.images[..80].iter_mut().for_each(|image| image.gps = first);
    let mut wanted = options(PairMode::Gps);
    wanted.spatial_neighbours = 6;
    let selection = select(&crowd, None, &wanted);
    assert!(selection.report.images_without_pair.is_empty());
    let of_40 = as_numbers(&selection.pairs).into_iter().filter(|pair| pair.0 == 40 || pair.1 == 40).count();
    assert!((6..=12).contains(&of_40), "{of_40}");
    crowd.images.iter_mut().for_each(|image| image.gps = first);
    assert!(!select(&crowd, None, &wanted).pairs.is_empty());
    wanted.spatial_neighbours = 0;
    wanted.max_distance_m = Some(f64::NAN);
    select(&crowd, None, &wanted);
}

#[test]
fn sequence_follows_time_within_folders() {
    let images = vec![
        image("a/1.jpg", None, Some(30.0)),
        image("a/2.jpg", None, Some(10.0)),
        image("a/3.jpg", None, Some(20.0)),
        image("b/1.jpg", None, None),
        image("b/2.jpg", None, Some(0.0)),
    ];
    let mut wanted = options(PairMode::Sequential);
    wanted.sequence_overlap = Some(1);
    let selection = select(&table(images), None, &wanted);
    assert_eq!(as_numbers(&selection.pairs), [(0, 2), (0, 3), (1, 2), (3, 4)]);
    assert_eq!(selection.report.from_sequence, 4);
}

#[test]
fn lists_name_paths_and_report_what_they_can_not_use() {
    let mut wanted = options(PairMode::List);
    let entry = |a: &str, b: &str| [a.to_string(), b.to_string()];
    wanted.list = vec![
        entry("a/0002.jpg", "a/0000.jpg"),
        entry("a/0000.jpg", "a/0002.jpg"),
        entry("a/0001.jpg", "a/0001.jpg"),
        entry("a/0001.jpg", "missing.jpg"),
    ];
    let selection = select(&plain(4), None, &wanted);
    assert_eq!(as_numbers(&selection.pairs), [(0, 2)]);
    assert_eq!(selection.report.unusable_list_entries, wanted.list[2..]);
    assert_eq!(selection.report.images_without_pair, [ImageId(1), ImageId(3)]);
}

#[test]
fn retrieval_pairs_the_similar() {
    let looks: Vec<Vec<Similar>> =
        (0..8).map(|at| (1..4).map(|k| similar((at + 2 * k) % 8)).collect()).collect();
    let mut wanted = options(PairMode::Retrieval);
    wanted.retrieval_neighbours = 3;
    let selection = select(&plain(8), Some(&looks), &wanted);
    assert_eq!(selection.pairs.len(), 12);
    assert!(selection.pairs.iter().all(|pair| (pair.first().0 + pair.second().0) % 2 == 0));
    assert!(select(&plain(9), Some(&looks), &wanted).report.retrieval_missing, "one list is missing");
    let strangers = vec![vec![similar(7), similar(8), similar(99)]; 8];
    select(&plain(8), Some(&strangers), &wanted);
}

#[test]
fn loops_are_closed_by_looks_beyond_the_sequence() {
    let looks: Vec<Vec<Similar>> =
        (0..40).map(|at| [(at + 1) % 40, (at + 20) % 40, (at + 19) % 40].map(similar).to_vec()).collect();
    let mut wanted = options(PairMode::Sequential);
    (wanted.sequence_overlap, wanted.loop_closures) = (Some(2), 1);
    assert_eq!(wanted_similar(&plain(40), &wanted), Some(vec![true; 40]));
    let selection = select(&plain(40), Some(&looks), &wanted);
    let pairs = as_numbers(&selection.pairs);
    assert_eq!(selection.report.from_sequence, 39 + 38);
    // 0 and 39 are next to each other in looks and far apart in the sequence.
    assert_eq!(selection.report.from_loops, 20 + 1);
    assert!(pairs.contains(&(3, 23)) && pairs.contains(&(0, 39)) && !pairs.contains(&(3, 22)));
    wanted.loop_closures = 0;
    assert_eq!(wanted_similar(&plain(40), &wanted), None);
    assert_eq!(select(&plain(40), None, &wanted).report.from_loops, 0);
}

#[test]
fn gps_and_looks_are_combined_for_every_image() {
    let table = grid(10, 20.0);
    let looks: Vec<Vec<Similar>> = (0..100).map(|at| vec![similar(99 - at)]).collect();
    let mut wanted = options(PairMode::GpsAndRetrieval);
    wanted.spatial_neighbours = 4;
    let selection = select(&table, Some(&looks), &wanted);
    let pairs = as_numbers(&selection.pairs);
    assert!(pairs.contains(&(0, 99)) && pairs.contains(&(0, 1)) && pairs.contains(&(0, 10)));
    assert_eq!(selection.report.from_retrieval, 50);
}

#[test]
fn blocks_hold_every_pair_once_within_their_limits() {
    let mut rng = Seed(1).rng();
    let random = (0..900)
        .filter_map(|_| ImagePair::new(ImageId(rng.random_range(0..200)), ImageId(rng.random_range(0..200))));
    let mut random: Vec<ImagePair> = random.collect();
    random.sort_unstable();
    random.dedup();
    let near = select(&grid(14, 20.0), None, &options(PairMode::Gps)).pairs;
    for pairs in [&random, &near] {
        for (max_pairs, max_images) in [(0, 0), (1, 2), (50, 10), (200, 48), (100_000, 100_000)] {
            let made = blocks(pairs, &BlockOptions { max_pairs, max_images });
            let mut all = made.concat();
            all.sort_unstable();
            assert_eq!(&all, pairs);
            for block in &made {
                let mut images: Vec<_> =
                    block.iter().flat_map(|pair| [pair.first(), pair.second()]).collect();
                images.sort_unstable();
                images.dedup();
                assert!(
                    block.len() <= max_pairs.max(1) as usize && images.len() <= max_images.max(2) as usize
                );
                assert!(block.is_sorted());
            }
        }
    }
    assert!(blocks(&[], &BlockOptions::default()).is_empty());
}

#[test]
fn blocks_read_each_image_few_times() {
    let table = grid(20, 20.0);
    let pairs = select(&table, None, &options(PairMode::Gps)).pairs;
    let made = blocks(&pairs, &BlockOptions::default());
    let reads: usize = made
        .iter()
        .map(|block| {
            let mut images: Vec<_> = block.iter().flat_map(|pair| [pair.first(), pair.second()]).collect();
            images.sort_unstable();
            images.dedup();
            images.len()
        })
        .sum();
    // About 6,400 pairs of 400 images: 12,800 reads pair by pair.
    assert!(made.len() >= pairs.len() / 200 && made.len() <= pairs.len() / 100, "{} blocks", made.len());
    assert!(5 * reads < 2 * pairs.len(), "{reads} reads for {} pairs", pairs.len());
}
