//! Every kind of artefact: what is written is read, in part and whole, and a flipped bit is found by whoever reads it.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::ops::Range;

use nalgebra::Vector3;
use proptest::prelude::*;
use terrane_geometry::{Camera, CameraModel, Rigid3, so3};

use super::*;
use crate::{
    CameraId, ClusterId, DescriptorKind, Features, ImageFate, ImageId, ImagePair, Keypoint, MatchedPair,
    Observation, PairKind, PairSummary, Reconstruction, RegisteredImage, SceneError, Submap, SubmapOutcome,
};

fn features(count: u32) -> Features {
    let keypoint =
        |n: u32| Keypoint { x_px: n as f32 + 0.5, y_px: 2.5, scale_px: 1.5, orientation_rad: -0.25 };
    Features {
        keypoints: (0..count).map(keypoint).collect(),
        kind: DescriptorKind::Bytes128,
        descriptors: (0..count * 128).map(|n| (n % 251) as u8).collect(),
        colors: (0..count).map(|n| [n as u8, 1, 2]).collect(),
    }
}

fn batch() -> Vec<u8> {
    let mut writer = FeatureBatchWriter::default();
    for outcome in [Ok(features(9)), Err("it is broken".to_owned()), Ok(features(0))] {
        writer.push(&outcome).unwrap();
    }
    writer.finish().unwrap()
}

fn matched(first: u32, second: u32, count: u32) -> MatchedPair {
    let turn = so3::exp(&Vector3::new(0.3, -0.2, 0.1));
    MatchedPair {
        summary: PairSummary {
            pair: ImagePair::new(ImageId(first), ImageId(second)).unwrap(),
            kind: if count > 2 { PairKind::Planar } else { PairKind::Panoramic },
            num_inliers: count,
            second_from_first: (count > 2).then(|| Rigid3::new(turn, Vector3::new(0.0, 0.6, 0.8))),
            median_angle_rad: 0.1,
        },
        matches: (0..count).map(|n| [n, n + 7]).collect(),
    }
}

fn block() -> MatchBlock {
    MatchBlock {
        pairs: vec![matched(0, 3, 30), matched(0, 4, 2), matched(2, 3, 5)],
        refused: BTreeMap::from([("too_few_matches".to_owned(), 4)]),
    }
}

fn reconstruction(offset: u32) -> Reconstruction {
    let camera =
        Camera::new(CameraModel::OpenCv, 640, 480, &[500.0, 501.0, 320.0, 240.0, 0.1, 0.01, 1e-3, 2e-3]);
    let mut made = Reconstruction { cameras: vec![(CameraId(2), camera.unwrap())], ..Default::default() };
    for image in [1, 4] {
        let rotation = so3::exp(&Vector3::new(0.1 * f64::from(image), 0.7, -0.2));
        let cam_from_world = Rigid3::new(rotation, Vector3::new(1.0, f64::from(offset), 1e-9));
        made.images.push(RegisteredImage { image: ImageId(image), camera: CameraId(2), cam_from_world });
    }
    for point in 0..20u32 {
        let seen = |image| Observation { image: ImageId(image), feature: point, x_px: 1.25, y_px: 3.5 };
        made.push_point(Vector3::new(f64::from(point), 0.1, 7.0), [1, 2, point as u8], &[seen(1), seen(4)]);
    }
    made
}

fn outcome() -> SubmapOutcome {
    SubmapOutcome {
        cluster: ClusterId(5),
        submaps: [0, 1].map(|n| Submap { reconstruction: reconstruction(n) }).to_vec(),
        fates: vec![
            (ImageId(1), ImageFate::Registered { submap: 0 }),
            (ImageId(9), ImageFate::LeftOut { reason: "alone".to_owned() }),
        ],
    }
}

fn read_batch(bytes: &[u8]) -> Result<Vec<Features>, SceneError> {
    let reader = FeatureBatchReader::open(bytes)?;
    (0..reader.outcomes().len()).map(|place| reader.features(place)).collect()
}

fn read_everything(kind: usize, bytes: &[u8]) -> Result<(), SceneError> {
    match kind {
        0 => read_batch(bytes).map(|_| ()),
        1 => read_pair_summaries(bytes).and_then(|_| read_matches(bytes, |_| true)).map(|_| ()),
        2 => decode_submap(bytes).and_then(|_| read_submap_report::<u32>(bytes)).map(|_| ()),
        3 => decode_reconstruction(bytes).map(|_| ()),
        _ => decode_pair_blocks::<String>(bytes).map(|_| ()),
    }
}

fn artefacts() -> Vec<Vec<u8>> {
    let blocks = vec![vec![block().pairs[0].summary.pair], vec![], vec![block().pairs[2].summary.pair]];
    vec![
        batch(),
        encode_match_block(&block()).unwrap(),
        encode_submap(&outcome(), &7u32).unwrap(),
        encode_reconstruction(&reconstruction(3)).unwrap(),
        encode_pair_blocks(&blocks, &"how".to_owned()).unwrap(),
    ]
}

#[test]
fn features_are_read_image_by_image() {
    let bytes = batch();
    let reader = FeatureBatchReader::open(bytes.as_slice()).unwrap();
    assert_eq!(reader.outcomes()[1].rejected.as_deref(), Some("it is broken"));
    assert_eq!(read_batch(&bytes).unwrap(), [features(9), Features::default(), Features::default()]);
    assert_eq!(reader.keypoints_and_colors(0).unwrap().1.len(), 9);
    assert!(reader.features(3).unwrap_err().is_corrupt());
    let unequal = Features { colors: Vec::new(), ..features(2) };
    assert!(FeatureBatchWriter::default().push(&Ok(unequal)).is_err());
}

fn binary_features(count: u32) -> Features {
    let descriptors = (0..count * 32).map(|n| (n % 253) as u8).collect();
    Features { kind: DescriptorKind::Bits256, descriptors, ..features(count) }
}

#[test]
fn binary_descriptors_are_read_as_such() {
    let mut writer = FeatureBatchWriter::default();
    for outcome in [Ok(features(0)), Err("no".to_owned()), Ok(binary_features(7)), Ok(features(0))] {
        writer.push(&outcome).unwrap();
    }
    let bytes = writer.finish().unwrap();
    let reader = FeatureBatchReader::open(bytes.as_slice()).unwrap();
    assert_eq!(reader.kind(), DescriptorKind::Bits256);
    assert_eq!(reader.features(2).unwrap(), binary_features(7));
    let empty = Features { kind: DescriptorKind::Bits256, ..Features::default() };
    assert_eq!(reader.features(0).unwrap(), empty);
    assert_eq!(reader.features(1).unwrap(), empty);
}

#[test]
fn a_batch_has_descriptors_of_one_kind() {
    let mut writer = FeatureBatchWriter::default();
    writer.push(&Ok(features(3))).unwrap();
    let refused = writer.push(&Ok(binary_features(3))).unwrap_err().to_string();
    assert!(refused.contains("256 bits") && refused.contains("128 bytes"), "{refused}");
    let mislabelled = Features { kind: DescriptorKind::Bits256, ..features(3) };
    assert!(FeatureBatchWriter::default().push(&Ok(mislabelled)).is_err());
}

#[test]
fn matches_submaps_and_pairs_survive() {
    let bytes = encode_match_block(&block()).unwrap();
    let (summaries, refused) = read_pair_summaries(bytes.as_slice()).unwrap();
    assert_eq!(summaries, block().pairs.iter().map(|pair| pair.summary.clone()).collect::<Vec<_>>());
    assert_eq!(refused, block().refused);
    let some = read_matches(bytes.as_slice(), |pair| pair.second() == ImageId(3)).unwrap();
    assert_eq!(some, [block().pairs[0].clone(), block().pairs[2].clone()]);

    let bytes = encode_submap(&outcome(), &"report").unwrap();
    assert_eq!(decode_submap(bytes.as_slice()).unwrap(), outcome());
    let (fates, report) = read_submap_report::<String>(bytes.as_slice()).unwrap();
    assert_eq!((fates, report.as_str()), (outcome().fates, "report"));

    let blocks = vec![vec![summaries[0].pair, summaries[1].pair], vec![], vec![summaries[2].pair]];
    let bytes = encode_pair_blocks(&blocks, &11u32).unwrap();
    assert_eq!(decode_pair_blocks::<u32>(bytes.as_slice()).unwrap(), (blocks, 11));
}

#[test]
fn flipped_bits_and_cut_ends_are_found_in_every_kind() {
    for (kind, bytes) in artefacts().into_iter().enumerate() {
        read_everything(kind, &bytes).unwrap();
        for bit in (0..bytes.len() * 8).step_by(3) {
            let mut broken = bytes.clone();
            broken[bit / 8] ^= 1 << (bit % 8);
            let error = read_everything(kind, &broken).expect_err("a flipped bit must be found");
            assert!(error.is_corrupt(), "kind {kind} bit {bit}: {error}");
        }
        for len in (0..bytes.len()).step_by(17) {
            assert!(read_everything(kind, &bytes[..len]).unwrap_err().is_corrupt());
        }
    }
}

/// Bytes that notes what is read of them.
struct Watched<'a>(&'a [u8], &'a RefCell<u64>);

impl Source for Watched<'_> {
    fn len(&self) -> u64 {
        self.0.len() as u64
    }

    fn read(
        &self,
        ranges: &[Range<u64>],
    ) -> Result<Vec<Box<dyn AsRef<[u8]> + '_>>, Box<dyn std::error::Error + Send + Sync>> {
        *self.1.borrow_mut() += ranges.iter().map(|range| range.end - range.start).sum::<u64>();
        (&self.0).read(ranges).map(|parts| {
            parts.into_iter().map(|part| Box::new(part.as_ref().as_ref().to_vec()) as _).collect()
        })
    }
}

#[test]
fn only_what_is_asked_for_is_read() {
    let mut writer = FeatureBatchWriter::default();
    for _ in 0..4 {
        writer.push(&Ok(features(1000))).unwrap();
    }
    let bytes = writer.finish().unwrap();
    let read = RefCell::new(0);
    let reader = FeatureBatchReader::open(Watched(&bytes, &read)).unwrap();
    assert!(*read.borrow() < 2000, "{}", read.borrow());
    reader.keypoints_and_colors(2).unwrap();
    assert!(*read.borrow() < 2000 + 20_000, "{}", read.borrow());
    reader.features(1).unwrap();
    assert!(*read.borrow() < 25_000 + 150_000, "{}", read.borrow());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn noise_is_refused_and_nothing_panics(kind in 0..5usize, bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        prop_assert!(read_everything(kind, &bytes).is_err());
    }

    #[test]
    fn damage_is_refused_and_nothing_panics(kind in 0..5usize, at in any::<prop::sample::Index>(), with in any::<[u8; 8]>()) {
        let mut bytes = artefacts().swap_remove(kind);
        let at = at.index(bytes.len() - 8);
        let changed = bytes[at..at + 8] != with;
        bytes[at..at + 8].copy_from_slice(&with);
        prop_assert_eq!(read_everything(kind, &bytes).is_err(), changed);
    }
}
