//! Pixels from the bytes of a photograph: JPEG, PNG and TIFF.
//!
//! A photograph is decoded once: its luma is what features are found in, its colours are looked up at keypoints. Broken
//! files are errors, never grey areas. The pixel grid is that of the file; EXIF orientation turns nothing.

mod format;
mod jpeg;
mod png;
#[cfg(test)]
mod tests;
mod tiff;

use serde::{Deserialize, Serialize};

use crate::FrontendError;
pub use format::Format;

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

/// A photograph as it was stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DecodedImage {
    /// Brightness (ITU-R BT.601, the Y of JPEG).
    pub luma: GrayImage,
    /// Colours; `None` for a photograph in greys or when they were not asked for.
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
/// Completeness of JPEG and PNG is judged by walking their segments to the end marker, so that a truncated copy is
/// found when photographs are listed and not hours later.
///
/// # Errors
/// When the bytes are no image that can be read; the message names the remedy.
pub fn probe(bytes: &[u8]) -> Result<Probe, FrontendError> {
    let format = format::identify(bytes)?;
    let (width, height) = guarded(format, || match format {
        Format::Jpeg => jpeg::probe(bytes),
        Format::Png => png::probe(bytes),
        Format::Tiff => tiff::probe(bytes),
    })?;
    if width == 0 || height == 0 {
        return Err(FrontendError::corrupt(format!(
            "the {format} file states a size of {width} x {height} pixels"
        )));
    }
    Ok(Probe { format, width, height })
}

/// Decodes a photograph.
///
/// Sixteen-bit samples keep their upper eight bits, transparency is ignored, palettes are looked up.
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
    let samples = guarded(probe.format, || match probe.format {
        Format::Jpeg => jpeg::decode(bytes, &probe, options),
        Format::Png => png::decode(bytes),
        Format::Tiff => tiff::decode(bytes, options),
    })?;
    samples.into_image(&probe, options)
}

/// Pixels as a decoder delivers them, eight bits a sample, interleaved.
struct Samples {
    kind: SampleKind,
    data: Vec<u8>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum SampleKind {
    Gray,
    GrayAlpha,
    Rgb,
    RgbAlpha,
    YCbCr,
}

impl SampleKind {
    fn channels(self) -> usize {
        match self {
            Self::Gray => 1,
            Self::GrayAlpha => 2,
            Self::Rgb | Self::YCbCr => 3,
            Self::RgbAlpha => 4,
        }
    }
}

impl Samples {
    fn into_image(self, probe: &Probe, options: &DecodeOptions) -> Result<DecodedImage, FrontendError> {
        let (width, height) = (probe.width as usize, probe.height as usize);
        let channels = self.kind.channels();
        if self.data.len() != width * height * channels {
            return Err(FrontendError::corrupt(format!(
                "the {} file holds {} samples where {width} x {height} pixels need {}: copy it again from its source",
                probe.format,
                self.data.len(),
                width * height * channels
            )));
        }
        let luma: Vec<u8> = match self.kind {
            SampleKind::Gray => {
                return Ok(DecodedImage { luma: GrayImage { width, height, data: self.data }, rgb: None });
            }
            SampleKind::GrayAlpha | SampleKind::YCbCr => {
                self.data.chunks_exact(channels).map(|p| p[0]).collect()
            }
            SampleKind::Rgb | SampleKind::RgbAlpha => {
                self.data.chunks_exact(channels).map(|p| luma_of([p[0], p[1], p[2]])).collect()
            }
        };
        let luma = GrayImage { width, height, data: luma };
        if !options.color || self.kind == SampleKind::GrayAlpha {
            return Ok(DecodedImage { luma, rgb: None });
        }
        let mut data = self.data;
        match self.kind {
            SampleKind::YCbCr => rgb_from_ycbcr(&mut data),
            SampleKind::RgbAlpha => data = data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect(),
            _ => {}
        }
        Ok(DecodedImage { luma, rgb: Some(RgbImage { width, height, data }) })
    }
}

/// BT.601 luma in 16-bit fixed point; the three weights add up to 65,536, so that greys stay as they are.
fn luma_of([r, g, b]: [u8; 3]) -> u8 {
    ((19_595 * u32::from(r) + 38_470 * u32::from(g) + 7_471 * u32::from(b) + 32_768) >> 16) as u8
}

/// JFIF's YCbCr to RGB in place, in 16-bit fixed point.
fn rgb_from_ycbcr(data: &mut [u8]) {
    for pixel in data.as_chunks_mut::<3>().0 {
        let y = (i32::from(pixel[0]) << 16) + 32_768;
        let cb = i32::from(pixel[1]) - 128;
        let cr = i32::from(pixel[2]) - 128;
        pixel[0] = ((y + 91_881 * cr) >> 16).clamp(0, 255) as u8;
        pixel[1] = ((y - 22_554 * cb - 46_802 * cr) >> 16).clamp(0, 255) as u8;
        pixel[2] = ((y + 116_130 * cb) >> 16).clamp(0, 255) as u8;
    }
}

/// Runs a third party's reader on bytes from outside: should it panic, that is a broken file and not the end of the run.
fn guarded<T>(format: Format, read: impl FnOnce() -> Result<T, FrontendError>) -> Result<T, FrontendError> {
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(read)).unwrap_or_else(|_| {
        Err(FrontendError::corrupt(format!(
            "the {format} file can't be decoded: save it again with another program"
        )))
    })
}
