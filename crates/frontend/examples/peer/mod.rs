//! A peer's features, for examples that compare.

use std::path::{Path, PathBuf};

use terrane_scene::{DESCRIPTOR_LEN, Features, Keypoint};

/// Features as `benches/peers/sift_colmap.py` writes them: their number in 64 bits, x, y, scale and orientation of each in
/// 32-bit floating point, then the descriptors.
pub fn read(picture: &Path) -> Features {
    let file = PathBuf::from(format!("{}.sift", picture.display()));
    let bytes = std::fs::read(&file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    let count = u64::from_le_bytes(bytes[..8].try_into().expect("eight bytes")) as usize;
    let number = |k: usize| f32::from_le_bytes(bytes[8 + 4 * k..][..4].try_into().expect("four bytes"));
    let keypoint = |k: usize| Keypoint {
        x_px: number(4 * k),
        y_px: number(4 * k + 1),
        scale_px: number(4 * k + 2),
        orientation_rad: number(4 * k + 3),
    };
    Features {
        keypoints: (0..count).map(keypoint).collect(),
        descriptors: bytes[8 + 16 * count..][..DESCRIPTOR_LEN * count].to_vec(),
        colors: vec![[0; 3]; count],
        ..Features::default()
    }
}
