//! JPEG through zune-jpeg, with a walk over the file's segments that tells a whole file from a truncated one.
//!
//! The decoder fills what is missing with grey and reports success, so completeness is judged here.

use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

use super::{DecodeOptions, Probe, SampleKind, Samples};
use crate::FrontendError;

const REMEDY: &str = "copy it again from its source";

pub(super) fn probe(bytes: &[u8]) -> Result<(u32, u32), FrontendError> {
    let mut size = None;
    let mut at = 2;
    loop {
        let (marker, payload) = next_marker(bytes, at).ok_or_else(|| truncated(bytes, size))?;
        match marker {
            END_OF_IMAGE => {
                return size
                    .ok_or_else(|| FrontendError::corrupt(format!("the JPEG file has no image: {REMEDY}")));
            }
            0xd0..=0xd8 | 0x01 => {
                at = payload;
                continue;
            }
            _ => {}
        }
        let length = bytes.get(payload..payload + 2).ok_or_else(|| truncated(bytes, size))?;
        let length = usize::from(u16::from_be_bytes([length[0], length[1]]));
        if let (true, Some(header)) = (is_frame_header(marker), bytes.get(payload + 3..payload + 7)) {
            let pair = |i: usize| u32::from(u16::from_be_bytes([header[i], header[i + 1]]));
            size = size.or(Some((pair(2), pair(0))));
        }
        at = payload + length.max(2);
    }
}

const END_OF_IMAGE: u8 = 0xd9;

/// The next marker at or after `at` and where its payload starts. Entropy-coded data hold 0xff only as 0xff 0x00, so
/// that the same search passes over them.
fn next_marker(bytes: &[u8], mut at: usize) -> Option<(u8, usize)> {
    loop {
        at += bytes.get(at..)?.iter().position(|&b| b == 0xff)?;
        let marker = *bytes.get(at + 1)?;
        match marker {
            0x00 => at += 2,
            0xff => at += 1,
            _ => return Some((marker, at + 2)),
        }
    }
}

fn is_frame_header(marker: u8) -> bool {
    matches!(marker, 0xc0..=0xcf) && !matches!(marker, 0xc4 | 0xc8 | 0xcc)
}

fn truncated(bytes: &[u8], size: Option<(u32, u32)>) -> FrontendError {
    let size = size.map_or_else(String::new, |(width, height)| format!(" of {width} x {height} pixels"));
    FrontendError::corrupt(format!(
        "the JPEG file{size} is truncated: its {} bytes end before the end-of-image marker: {REMEDY}",
        bytes.len()
    ))
}

pub(super) fn decode(bytes: &[u8], probe: &Probe, options: &DecodeOptions) -> Result<Samples, FrontendError> {
    let sizes = DecoderOptions::default()
        .set_max_width(probe.width as usize)
        .set_max_height(probe.height as usize)
        .set_strict_mode(false);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), sizes);
    decoder.decode_headers().map_err(broken)?;
    let (out, kind) = match decoder.input_colorspace() {
        Some(ColorSpace::Luma) => (ColorSpace::Luma, SampleKind::Gray),
        Some(ColorSpace::YCbCr) if options.color => (ColorSpace::YCbCr, SampleKind::YCbCr),
        Some(ColorSpace::YCbCr) => (ColorSpace::Luma, SampleKind::Gray),
        _ => (ColorSpace::RGB, SampleKind::Rgb),
    };
    // Headers may be sloppy, entropy-coded data may not.
    decoder.set_options(sizes.set_strict_mode(true).jpeg_set_out_colorspace(out));
    let data = decoder.decode().map_err(broken)?;
    Ok(Samples { kind, data })
}

fn broken(error: zune_jpeg::errors::DecodeErrors) -> FrontendError {
    FrontendError::corrupt(format!("the JPEG file is broken ({error}): {REMEDY}"))
}
