//! JPEG through zune-jpeg, with a walk over the file's segments that tells a whole file from a truncated one, and says
//! what is not read.
//!
//! The decoder fills what is missing with grey and reports success, so completeness is judged here.

use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

use super::canvas::{Canvas, Model, Pixels, split_ycbcr};
use super::{DecodeOptions, DecodedImage, Format, GrayImage, Probe, check_plausible};
use crate::FrontendError;

const REMEDY: &str = "copy it again from its source";
const END_OF_IMAGE: u8 = 0xd9;
const START_OF_SCAN: u8 = 0xda;
/// Pixels a byte at most: the first scan of a progressive file spends a bit on a block of 64 at least.
pub(super) const MAX_RATIO: u64 = 1024;

/// What a frame header states.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Frame {
    pub width: u32,
    pub height: u32,
    pub num_components: usize,
    is_progressive: bool,
    /// Horizontal and vertical sampling factors of the components.
    sampling: [(u8, u8); 4],
}

impl Frame {
    fn read(marker: u8, header: &[u8]) -> Result<Self, FrontendError> {
        check_process(marker)?;
        let [precision, h0, h1, w0, w1, count, components @ ..] = header else {
            return Err(FrontendError::corrupt(format!("the JPEG file has half a frame header: {REMEDY}")));
        };
        if *precision != 8 {
            return Err(unsupported(&format!("JPEG of {precision} bits a sample")));
        }
        let num_components = usize::from(*count);
        if !matches!(num_components, 1 | 3 | 4) {
            return Err(unsupported(&format!("JPEG of {num_components} components")));
        }
        let mut frame = Self {
            width: u32::from(u16::from_be_bytes([*w0, *w1])),
            height: u32::from(u16::from_be_bytes([*h0, *h1])),
            num_components,
            is_progressive: marker == 0xc2,
            sampling: [(1, 1); 4],
        };
        let components = components.as_chunks::<3>().0;
        if components.len() != num_components {
            return Err(FrontendError::corrupt(format!("the JPEG file has half a frame header: {REMEDY}")));
        }
        for (factors, [_, sampling, _]) in frame.sampling.iter_mut().zip(components) {
            *factors = (sampling >> 4, sampling & 15);
            if !matches!(*factors, (1 | 2 | 4, 1 | 2 | 4)) {
                return Err(unsupported(&format!(
                    "JPEG with sampling factors {} x {}",
                    factors.0, factors.1
                )));
            }
        }
        // No camera does this, and the decoder gets it wrong.
        let (across, down) = frame.sampling[0];
        if frame.sampling[..num_components].iter().any(|(h, v)| *h > across || *v > down) {
            return Err(unsupported("JPEG with its first component sampled more coarsely than another"));
        }
        Ok(frame)
    }

    /// The decoder mixes up the components of a sequential file that come one after the other; cameras interleave them.
    fn check_scan(&self, segment: &[u8]) -> Result<(), FrontendError> {
        let num_components = segment.first().map_or(0, |count| usize::from(*count));
        if !self.is_progressive && num_components != self.num_components {
            return Err(unsupported("sequential JPEG with components in separate scans"));
        }
        Ok(())
    }

    /// The decoder's path to luma alone is right where no component is sampled more coarsely down than across.
    fn has_plain_luma(&self) -> bool {
        let luma = self.sampling[0];
        matches!(luma, (1, 1) | (2, 1) | (2, 2)) && self.sampling[1..].iter().all(|chroma| *chroma == (1, 1))
    }
}

/// ITU-T T.81, table B.1: which coding processes are read.
fn check_process(marker: u8) -> Result<(), FrontendError> {
    match marker {
        0xc0..=0xc2 => Ok(()),
        0xc3 => Err(unsupported("lossless JPEG")),
        0xc9..=0xcb | 0xcd..=0xcf => Err(unsupported("arithmetic-coded JPEG")),
        0xf7 => Err(unsupported("JPEG-LS")),
        _ => Err(unsupported("hierarchical JPEG")),
    }
}

fn unsupported(what: &str) -> FrontendError {
    FrontendError::unsupported(format!(
        "{what} is not read: save the photographs as baseline or progressive JPEG of 8 bits, or as PNG or TIFF, keeping \
         their EXIF"
    ))
}

pub(super) fn probe(bytes: &[u8]) -> Result<(u32, u32), FrontendError> {
    let frame = walk(bytes, Until::End)?;
    check_plausible(Format::Jpeg, bytes.len(), u64::from(frame.width) * u64::from(frame.height), MAX_RATIO)?;
    Ok((frame.width, frame.height))
}

/// How far a walk goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Until {
    /// To the first scan: all headers.
    Scan,
    /// To the end of the image.
    End,
}

/// Walks the segments of a file.
pub(super) fn walk(bytes: &[u8], until: Until) -> Result<Frame, FrontendError> {
    let mut frame = None;
    let mut has_scan = false;
    let mut at = 2;
    loop {
        let (marker, payload) = next_marker(bytes, at).ok_or_else(|| truncated(bytes, frame))?;
        match marker {
            END_OF_IMAGE => {
                return frame
                    .filter(|_| has_scan)
                    .ok_or_else(|| FrontendError::corrupt(format!("the JPEG file has no image: {REMEDY}")));
            }
            0xd0..=0xd8 | 0x01 => {
                at = payload;
                continue;
            }
            _ => {}
        }
        let length = bytes.get(payload..payload + 2).ok_or_else(|| truncated(bytes, frame))?;
        let length = usize::from(u16::from_be_bytes([length[0], length[1]])).max(2);
        let segment = bytes.get(payload + 2..payload + length).ok_or_else(|| truncated(bytes, frame))?;
        if is_frame_header(marker) {
            if frame.is_some() {
                return Err(FrontendError::corrupt(format!("the JPEG file has two frame headers: {REMEDY}")));
            }
            frame = Some(Frame::read(marker, segment)?);
        }
        if let (START_OF_SCAN, Some(frame)) = (marker, frame) {
            frame.check_scan(segment)?;
            if until == Until::Scan {
                return Ok(frame);
            }
            has_scan = true;
        }
        at = payload + length;
    }
}

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
    matches!(marker, 0xc0..=0xcf | 0xf7) && !matches!(marker, 0xc4 | 0xc8 | 0xcc)
}

fn truncated(bytes: &[u8], frame: Option<Frame>) -> FrontendError {
    let size =
        frame.map_or_else(String::new, |frame| format!(" of {} x {} pixels", frame.width, frame.height));
    FrontendError::corrupt(format!(
        "the JPEG file{size} is truncated: its {} bytes end before the end-of-image marker: {REMEDY}",
        bytes.len()
    ))
}

pub(super) fn decode(
    bytes: &[u8],
    probe: &Probe,
    options: &DecodeOptions,
) -> Result<DecodedImage, FrontendError> {
    let (width, height) = (probe.width as usize, probe.height as usize);
    let frame = walk(bytes, Until::Scan)?;
    let sizes = DecoderOptions::default().set_max_width(width).set_max_height(height).set_strict_mode(false);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), sizes);
    decoder.decode_headers().map_err(broken)?;
    let out = match decoder.input_colorspace() {
        Some(ColorSpace::Luma) => ColorSpace::Luma,
        Some(ColorSpace::YCbCr) if !options.color && frame.has_plain_luma() => ColorSpace::Luma,
        Some(ColorSpace::YCbCr) => ColorSpace::YCbCr,
        _ => ColorSpace::RGB,
    };
    // Headers may be sloppy, entropy-coded data may not.
    decoder.set_options(sizes.set_strict_mode(true).jpeg_set_out_colorspace(out));
    let data = decoder.decode().map_err(broken)?;
    drop(decoder);
    if data.len() != width * height * out.num_components() {
        return Err(FrontendError::corrupt(format!(
            "the JPEG file holds another number of pixels: {REMEDY}"
        )));
    }
    match out {
        ColorSpace::Luma => Ok(DecodedImage { luma: GrayImage { width, height, data }, rgb: None }),
        ColorSpace::YCbCr => {
            let image = split_ycbcr(data, width, height);
            Ok(DecodedImage { rgb: image.rgb.filter(|_| options.color), ..image })
        }
        _ => {
            let mut canvas = Canvas::<u8>::new(width, height, options.color);
            let pixels = Pixels { model: Model::Rgb, stride: 3 };
            data.chunks_exact(3 * width).for_each(|row| canvas.push_row(pixels, row));
            canvas.finish()
        }
    }
}

/// The samples of a JPEG that stands in another file, interleaved as they are stored, without a change of colours.
pub(super) fn decode_samples(bytes: Vec<u8>, frame: &Frame) -> Result<Vec<u8>, FrontendError> {
    let options = DecoderOptions::default()
        .set_max_width(frame.width as usize)
        .set_max_height(frame.height as usize)
        .set_strict_mode(false);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(broken)?;
    let stored = decoder.input_colorspace().unwrap_or(ColorSpace::YCbCr);
    decoder.set_options(options.set_strict_mode(true).jpeg_set_out_colorspace(stored));
    decoder.decode().map_err(broken)
}

fn broken(error: zune_jpeg::errors::DecodeErrors) -> FrontendError {
    FrontendError::corrupt(format!("the JPEG file is broken ({error}): {REMEDY}"))
}
