//! Pixels from the bytes of a photograph: JPEG, PNG and TIFF.
//!
//! A photograph is decoded once: its luma is what features are found in, its colours are looked up at keypoints. Broken
//! files are errors, never grey areas. The pixel grid is that of the file; EXIF orientation turns nothing.
//!
//! What a header states is believed only as far as the file's length allows, so that memory is bounded by the bytes at
//! hand: see [`DECODING_BYTES_PER_PIXEL`].

mod canvas;
mod format;
mod jpeg;
mod levels;
mod png;
#[cfg(test)]
mod tests;
pub(crate) mod tiff;

use serde::{Deserialize, Serialize};

use crate::FrontendError;
pub use format::Format;
pub(crate) use png::chunk as png_chunk;

/// Bytes a pixel that [`decode`] needs at most besides the file itself, by any format.
///
/// A baseline JPEG takes 3.75, of which 1.75 are kept; PNG and TIFF are reduced row by row and take 1.75, or 5.25 of 16
/// bits and 8.75 of floating point; an interlaced PNG, and a TIFF in tiles or with JPEG inside, hold what they interleave
/// besides. A progressive JPEG without subsampling takes 9: 6 of coefficients and 3 of pixels.
pub const DECODING_BYTES_PER_PIXEL: u64 = 10;

/// One channel of eight bits, row after row without padding.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GrayImage {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` values.
    pub data: Vec<u8>,
}

/// Red, green and blue of eight bits, interleaved, row after row without padding.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RgbImage {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `3 * width * height` values.
    pub data: Vec<u8>,
}

impl RgbImage {
    /// The colour of a pixel of a grid of `full` columns and rows, of which this image may be a reduction; `None` outside
    /// of it.
    pub fn at_pixel(&self, column: usize, row: usize, full: (usize, usize)) -> Option<[u8; 3]> {
        let cell = |full: usize, len: usize| full.div_ceil(len.max(1)).max(1);
        let (column, row) = (column / cell(full.0, self.width), row / cell(full.1, self.height));
        if column >= self.width {
            return None;
        }
        self.data.get(3 * (row * self.width + column)..)?.first_chunk::<3>().copied()
    }
}

/// A photograph as it was stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DecodedImage {
    /// Brightness (ITU-R BT.601, the Y of JPEG).
    pub luma: GrayImage,
    /// Colours of cells of 2 x 2 pixels (see [`RgbImage::at_pixel`]); `None` for a photograph in greys or when they
    /// were not asked for.
    pub rgb: Option<RgbImage>,
}

/// What to decode and how much at most.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DecodeOptions {
    /// The most pixels that an image may have. Range: above 0. Default 250 million: beyond the largest aerial frames
    /// that are offered as one JPEG, and it bounds what a forged header can make us allocate.
    pub max_pixels: u64,
    /// Whether colours are wanted besides luma. Default: yes.
    pub color: bool,
}

impl Default for DecodeOptions {
    fn default() -> Self {
        Self { max_pixels: 250_000_000, color: true }
    }
}

/// What a file says of itself before its pixels are decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Probe {
    /// The file's format.
    pub format: Format,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Format and size of an image, and whether the file is whole, without decoding pixels.
///
/// Completeness is judged by walking the segments of JPEG and PNG to the end marker, and by where a TIFF's strips and
/// tiles end, so that a truncated copy is found when photographs are listed and not hours later.
///
/// # Errors
/// When the bytes are no image that can be read; the message names the remedy.
pub fn probe(bytes: &[u8]) -> Result<Probe, FrontendError> {
    let format = format::identify(bytes)?;
    let (width, height) = match format {
        Format::Jpeg => jpeg::probe(bytes),
        Format::Png => png::probe(bytes),
        Format::Tiff => tiff::probe(bytes),
    }?;
    if width == 0 || height == 0 {
        return Err(FrontendError::corrupt(format!(
            "the {format} file states a size of {width} x {height} pixels"
        )));
    }
    Ok(Probe { format, width, height })
}

/// Decodes a photograph.
///
/// Transparency is ignored, palettes are looked up. Samples of more than eight bits keep the upper eight when their
/// brightness fills the range. Where 99.8 % of it lie within a quarter of the range (thermal frames, dark scans, twelve
/// bits in sixteen), and for floating point, that part is stretched to eight bits.
///
/// # Errors
/// When the bytes are no image that can be read, are broken or truncated, or exceed `options.max_pixels`; the message
/// names what is wrong and the remedy.
pub fn decode(bytes: &[u8], options: &DecodeOptions) -> Result<DecodedImage, FrontendError> {
    let probe = probe(bytes)?;
    let pixels = u64::from(probe.width) * u64::from(probe.height);
    if pixels > options.max_pixels {
        return Err(FrontendError::unsupported(format!(
            "the image has {} x {} pixels, more than the limit of {} million: scale it down or raise max_pixels",
            probe.width,
            probe.height,
            options.max_pixels / 1_000_000
        )));
    }
    guarded(probe.format, || match probe.format {
        Format::Jpeg => jpeg::decode(bytes, &probe, options),
        Format::Png => png::decode(bytes, &probe, options),
        Format::Tiff => tiff::decode(bytes, options),
    })
}

/// Refuses a header that states more samples than so many bytes can hold at this ratio of compression: it is forged or
/// broken, and must not make us allocate.
fn check_plausible(
    format: Format,
    num_bytes: usize,
    decoded_bytes: u64,
    max_ratio: u64,
) -> Result<(), FrontendError> {
    if decoded_bytes / max_ratio > num_bytes as u64 {
        return Err(FrontendError::corrupt(format!(
            "the {format} file of {num_bytes} bytes can't hold the pixels that its header states: copy it again from \
             its source"
        )));
    }
    Ok(())
}

/// Runs a third party's reader on bytes from outside: should it panic, that is a broken file and not the end of the run.
fn guarded<T>(format: Format, read: impl FnOnce() -> Result<T, FrontendError>) -> Result<T, FrontendError> {
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(read)).unwrap_or_else(|_| {
        Err(FrontendError::corrupt(format!(
            "the {format} file can't be decoded: save it again with another program"
        )))
    })
}
