//! PNG of every bit depth, palette, grey and alpha.

use std::io::Cursor;

use png::{BitDepth, ColorType, Decoder, DecodingError, Limits, Transformations};

use super::{SampleKind, Samples};
use crate::FrontendError;

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
    Ok(size)
}

pub(super) fn decode(bytes: &[u8]) -> Result<Samples, FrontendError> {
    // The caller has checked the number of pixels; lines and metadata need a bound of their own.
    let mut decoder = Decoder::new_with_limits(Cursor::new(bytes), Limits { bytes: 1 << 30 });
    decoder.set_transformations(Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().map_err(broken)?;
    let size = reader
        .output_buffer_size()
        .ok_or_else(|| FrontendError::unsupported("the PNG image does not fit into memory: scale it down"))?;
    let mut data = vec![0; size];
    let info = reader.next_frame(&mut data).map_err(broken)?;
    data.truncate(info.buffer_size());
    let kind = match (info.color_type, info.bit_depth) {
        (ColorType::Grayscale, BitDepth::Eight) => SampleKind::Gray,
        (ColorType::GrayscaleAlpha, BitDepth::Eight) => SampleKind::GrayAlpha,
        (ColorType::Rgb, BitDepth::Eight) => SampleKind::Rgb,
        (ColorType::Rgba, BitDepth::Eight) => SampleKind::RgbAlpha,
        (color, depth) => {
            return Err(FrontendError::unsupported(format!(
                "PNG of {color:?} at {depth:?} bits is not read: save it as RGB of 8 bits"
            )));
        }
    };
    Ok(Samples { kind, data })
}

fn broken(error: DecodingError) -> FrontendError {
    FrontendError::corrupt(format!("the PNG file is broken ({error}): copy it again from its source"))
}
