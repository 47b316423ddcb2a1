//! PNG of every bit depth, palette, grey and alpha, row by row.

use std::io::Cursor;

use png::{BitDepth, ColorType, Decoder, DecodingError, Limits, Reader, Transformations};

use super::canvas::{Canvas, Model, Pixels, Sample};
use super::{DecodeOptions, DecodedImage, Format, Probe, check_plausible};
use crate::FrontendError;

/// Deflate makes a byte of at most 1,032 bytes.
const MAX_RATIO: u64 = 1040;

pub(super) fn probe(bytes: &[u8]) -> Result<(u32, u32), FrontendError> {
    let broken =
        |what: &str| FrontendError::corrupt(format!("the PNG file is {what}: copy it again from its source"));
    let word = |at: usize| {
        bytes
            .get(at..at + 4)
            .map(|b| u32::from_be_bytes([b[0], b[1], b[2], b[3]]))
            .ok_or_else(|| broken("truncated"))
    };
    if bytes.get(12..16) != Some(b"IHDR") {
        return Err(broken("broken (it has no header)"));
    }
    let size = (word(16)?, word(20)?);
    let (Some(depth), Some(color)) = (bytes.get(24), bytes.get(25)) else { return Err(broken("truncated")) };
    let mut at = 8_usize;
    loop {
        let name =
            bytes.get(at.saturating_add(4)..at.saturating_add(8)).ok_or_else(|| broken("truncated"))?;
        let is_last = name == b"IEND";
        at = at.saturating_add(12).saturating_add(word(at)? as usize);
        if is_last {
            break;
        }
    }
    if at > bytes.len() {
        return Err(broken("truncated"));
    }
    let channels = match color {
        2 => 3,
        4 => 2,
        6 => 4,
        _ => 1,
    };
    // A forged header may state any size.
    let row_bytes = 1 + (u64::from(size.0) * channels * u64::from(*depth)).div_ceil(8);
    let num_bytes = row_bytes.saturating_mul(u64::from(size.1));
    check_plausible(Format::Png, bytes.len(), num_bytes, MAX_RATIO)?;
    Ok(size)
}

/// The contents of the first chunk of a name.
pub(crate) fn chunk<'a>(bytes: &'a [u8], name: &[u8; 4]) -> Option<&'a [u8]> {
    let mut at = 8_usize;
    loop {
        let length = u32::from_be_bytes(*bytes.get(at..)?.first_chunk::<4>()?) as usize;
        let start = at.checked_add(8)?;
        if bytes.get(at + 4..start)? == name {
            return bytes.get(start..start.checked_add(length)?);
        }
        at = start.checked_add(length)?.checked_add(4)?;
    }
}

pub(super) fn decode(
    bytes: &[u8],
    probe: &Probe,
    options: &DecodeOptions,
) -> Result<DecodedImage, FrontendError> {
    // The caller has checked the number of pixels; lines and metadata need a bound of their own.
    let mut decoder = Decoder::new_with_limits(Cursor::new(bytes), Limits { bytes: 1 << 30 });
    decoder.set_transformations(Transformations::EXPAND);
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    let reader = decoder.read_info().map_err(broken)?;
    let (color, depth) = reader.output_color_type();
    let pixels = match color {
        ColorType::Grayscale => Pixels { model: Model::Gray, stride: 1 },
        ColorType::GrayscaleAlpha => Pixels { model: Model::Gray, stride: 2 },
        ColorType::Rgb => Pixels { model: Model::Rgb, stride: 3 },
        ColorType::Rgba => Pixels { model: Model::Rgb, stride: 4 },
        ColorType::Indexed => {
            return Err(FrontendError::corrupt("the PNG file's palette is missing: save it again as RGB"));
        }
    };
    match depth {
        BitDepth::Eight => draw(reader, probe, pixels, options, |row, out: &mut Vec<u8>| {
            out.extend_from_slice(row);
        }),
        BitDepth::Sixteen => draw(reader, probe, pixels, options, |row, out: &mut Vec<u16>| {
            out.extend(row.as_chunks::<2>().0.iter().map(|b| u16::from_be_bytes(*b)));
        }),
        depth => Err(FrontendError::unsupported(format!(
            "PNG of {color:?} at {depth:?} bits is not read: save it as RGB of 8 bits"
        ))),
    }
}

fn draw<S: Sample>(
    mut reader: Reader<Cursor<&[u8]>>,
    probe: &Probe,
    pixels: Pixels,
    options: &DecodeOptions,
    unpack: impl Fn(&[u8], &mut Vec<S>),
) -> Result<DecodedImage, FrontendError> {
    let mut canvas = Canvas::<S>::new(probe.width as usize, probe.height as usize, options.color);
    let mut samples = Vec::new();
    if reader.info().interlaced {
        let size = reader.output_buffer_size().ok_or_else(too_large)?;
        let mut data = vec![0; size];
        let info = reader.next_frame(&mut data).map_err(broken)?;
        for row in data.chunks_exact(info.line_size.max(1)) {
            samples.clear();
            unpack(row, &mut samples);
            canvas.push_row(pixels, &samples);
        }
        return canvas.finish();
    }
    while let Some(row) = reader.next_row().map_err(broken)? {
        samples.clear();
        unpack(row.data(), &mut samples);
        canvas.push_row(pixels, &samples);
    }
    canvas.finish()
}

fn too_large() -> FrontendError {
    FrontendError::unsupported("the PNG image does not fit into memory: scale it down")
}

fn broken(error: DecodingError) -> FrontendError {
    FrontendError::corrupt(format!("the PNG file is broken ({error}): copy it again from its source"))
}
