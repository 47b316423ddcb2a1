//! Predictions of memory and time, from sizes that are known before a task runs.
//!
//! Bytes are bounds by construction of each stage plus a margin; seconds come from measurements on one 2.x GHz core and
//! serve the order of tasks and the time left, never a result.

use terrane_scene::{ImageId, ImageTable};

/// Peak bytes and seconds of a task.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Cost {
    pub bytes: u64,
    pub seconds: f64,
}

const MIB: u64 = 1 << 20;
/// Bytes of a feature: keypoint, colour, descriptor.
const FEATURE_BYTES: u64 = 16 + 3 + 128;
/// Bytes of what a matcher lays out of it.
const PREPARED_BYTES: u64 = 400;

fn pixels(table: &ImageTable, image: ImageId) -> u64 {
    let record = table.image(image);
    u64::from(record.width_px) * u64::from(record.height_px)
}

/// Reading every file once: one file per thread in memory.
pub(super) fn ingest(num_files: usize) -> Cost {
    Cost { bytes: 256 * MIB, seconds: 0.02 * num_files as f64 }
}

/// Features: per thread the pixels (4 bytes), and a scale space of about 44 bytes a pixel of the first octave.
pub(super) fn features(
    table: &ImageTable,
    (first, count): (ImageId, u32),
    most_features: usize,
    threads: u32,
) -> Cost {
    let images = || (first.0..first.0 + count).map(ImageId);
    let largest = images().map(|image| pixels(table, image)).max().unwrap_or(0);
    let sum: u64 = images().map(|image| pixels(table, image)).sum();
    Cost {
        bytes: u64::from(threads.min(count)) * largest * 48
            + u64::from(count) * most_features as u64 * FEATURE_BYTES * 2
            + 32 * MIB,
        seconds: sum as f64 * 0.5e-6,
    }
}

/// Pairs: the table and its pairs; with retrieval also what is learnt from (64 MiB and its products), the features of some
/// images, sketches of 1,024, and an image's descriptor and candidates.
pub(super) fn pairs(num_images: usize) -> Cost {
    let sketches = num_images.min(1024) as u64 * 72 * 1024;
    Cost { bytes: 192 * MIB + sketches + num_images as u64 * 7_000, seconds: 0.02 * num_images as f64 }
}

/// Matching: the features of the block's images, as they are and laid out for the matcher, and what one pair a thread
/// takes.
pub(super) fn matching(num_images: usize, num_pairs: usize, most_features: usize, threads: u32) -> Cost {
    let bytes = num_images as u64 * most_features as u64 * (FEATURE_BYTES * 2 + PREPARED_BYTES)
        + u64::from(threads) * 32 * MIB
        + 32 * MIB;
    Cost { bytes, seconds: 0.05 * num_pairs as f64 }
}

/// The view graph and its partition: some hundred bytes a pair.
pub(super) fn graph(num_pairs: usize) -> Cost {
    Cost { bytes: 64 * MIB + num_pairs as u64 * 1024, seconds: 1e-4 * num_pairs as f64 + 0.1 }
}

/// A submap: keypoints, matches, tracks and the reduced camera system of a cluster.
pub(super) fn submap(num_images: usize) -> Cost {
    let n = num_images as u64;
    Cost { bytes: 64 * MIB + n * 4 * MIB + n * n * 36 * 8 * 3, seconds: 0.5 * num_images as f64 }
}

/// Reading the submaps of so many images.
pub(super) fn submaps(num_images: usize) -> Cost {
    Cost { bytes: 64 * MIB + num_images as u64 * MIB, seconds: 0.02 * num_images as f64 + 0.1 }
}

/// Adjusting a component of so many images.
pub(super) fn adjust(num_images: usize) -> Cost {
    Cost { bytes: 128 * MIB + num_images as u64 * 3 * MIB, seconds: 0.5 * num_images as f64 }
}
