//! Image files made by code: each kind that cameras and scanners write, for tests and as a start for fuzzing.

mod specimens;
mod tiff;

pub use specimens::{exif_specimens, image_specimens, interlaced_png, mend_png, words, xmp_specimens};
pub use tiff::{Compression, TiffWriter};
