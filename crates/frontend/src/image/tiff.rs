//! TIFF of 8 and 16 bits: grey, RGB, palette, with or without alpha.

use std::io::Cursor;

use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::Tag;
use tiff::{ColorType, TiffError};

use super::{DecodeOptions, SampleKind, Samples};
use crate::FrontendError;

/// Raw formats are TIFF files whose first image is a small preview, or that carry this tag.
const DNG_VERSION: u16 = 50_706;

pub(super) fn probe(bytes: &[u8]) -> Result<(u32, u32), FrontendError> {
    let mut decoder = Decoder::new(Cursor::new(bytes)).map_err(broken)?;
    let size = decoder.dimensions().map_err(broken)?;
    let reduced =
        decoder.find_tag_unsigned::<u32>(Tag::NewSubfileType).map_err(broken)?.unwrap_or(0) & 1 == 1;
    if reduced || decoder.find_tag(Tag::Unknown(DNG_VERSION)).map_err(broken)?.is_some() {
        return Err(FrontendError::unsupported(
            "camera raw files (DNG, NEF, ARW) are not read: convert the photographs to JPEG, PNG or TIFF, keeping their EXIF",
        ));
    }
    Ok(size)
}

pub(super) fn decode(bytes: &[u8], options: &DecodeOptions) -> Result<Samples, FrontendError> {
    let mut limits = Limits::default();
    limits.decoding_buffer_size = usize::try_from(options.max_pixels.saturating_mul(8)).unwrap_or(usize::MAX);
    limits.intermediate_buffer_size = limits.decoding_buffer_size;
    let mut decoder = Decoder::new(Cursor::new(bytes)).map_err(broken)?.with_limits(limits);
    let planar = decoder.find_tag_unsigned::<u16>(Tag::PlanarConfiguration).map_err(broken)?;
    let color = decoder.colortype().map_err(broken)?;
    let kind = kind_of(color)?;
    if planar == Some(2) && kind != SampleKind::Gray {
        return Err(FrontendError::unsupported(
            "TIFF with separate colour planes is not read: save it with interleaved pixels, or as JPEG or PNG",
        ));
    }
    let palette = match color {
        ColorType::Palette(_) => Some(decoder.get_tag_u16_vec(Tag::ColorMap).map_err(broken)?),
        _ => None,
    };
    let data = match decoder.read_image().map_err(broken)? {
        DecodingResult::U8(samples) => samples,
        DecodingResult::U16(samples) => samples.into_iter().map(|v| (v >> 8) as u8).collect(),
        _ => return Err(unsupported("samples that are neither 8 nor 16 bits, unsigned")),
    };
    if let Some(palette) = palette {
        return look_up(&data, &palette);
    }
    Ok(Samples { kind, data })
}

fn kind_of(color: ColorType) -> Result<SampleKind, FrontendError> {
    match color {
        ColorType::Gray(8 | 16) | ColorType::Palette(8) => Ok(SampleKind::Gray),
        ColorType::GrayA(8 | 16) => Ok(SampleKind::GrayAlpha),
        ColorType::RGB(8 | 16) => Ok(SampleKind::Rgb),
        ColorType::RGBA(8 | 16) => Ok(SampleKind::RgbAlpha),
        ColorType::YCbCr(8) => Ok(SampleKind::YCbCr),
        other => Err(unsupported(&format!("{other:?} pixels"))),
    }
}

/// A TIFF colour map holds all reds, then all greens, then all blues, of 16 bits.
fn look_up(indices: &[u8], palette: &[u16]) -> Result<Samples, FrontendError> {
    let entries = palette.len() / 3;
    let mut data = Vec::with_capacity(indices.len() * 3);
    for &index in indices {
        let index = usize::from(index);
        if index >= entries {
            return Err(FrontendError::corrupt("the TIFF file's palette is too short: save it again as RGB"));
        }
        data.extend([0, 1, 2].map(|channel| (palette[channel * entries + index] >> 8) as u8));
    }
    Ok(Samples { kind: SampleKind::Rgb, data })
}

fn unsupported(what: &str) -> FrontendError {
    FrontendError::unsupported(format!(
        "TIFF with {what} is not read: save it as RGB or grey of 8 or 16 bits"
    ))
}

fn broken(error: TiffError) -> FrontendError {
    match error {
        TiffError::UnsupportedError(what) => unsupported(&format!("this content ({what})")),
        TiffError::LimitsExceeded => FrontendError::unsupported("the TIFF image is too large: scale it down"),
        other => FrontendError::corrupt(format!(
            "the TIFF file is broken ({other}): copy it again from its source"
        )),
    }
}
