//! What the first directory of a TIFF says of its image, checked.

use super::codec::Codec;
use super::directory::{Directory, File};
use super::samples::{Encoding, Kind, Predictor, row_bytes};
use crate::FrontendError;
use crate::image::canvas::{Model, Pixels};
use crate::image::{Format, check_plausible};

mod tag {
    pub const NEW_SUBFILE_TYPE: u16 = 254;
    pub const IMAGE_WIDTH: u16 = 256;
    pub const IMAGE_LENGTH: u16 = 257;
    pub const BITS_PER_SAMPLE: u16 = 258;
    pub const COMPRESSION: u16 = 259;
    pub const PHOTOMETRIC: u16 = 262;
    pub const FILL_ORDER: u16 = 266;
    pub const STRIP_OFFSETS: u16 = 273;
    pub const SAMPLES_PER_PIXEL: u16 = 277;
    pub const ROWS_PER_STRIP: u16 = 278;
    pub const STRIP_BYTE_COUNTS: u16 = 279;
    pub const PLANAR_CONFIGURATION: u16 = 284;
    pub const PREDICTOR: u16 = 317;
    pub const COLOR_MAP: u16 = 320;
    pub const TILE_WIDTH: u16 = 322;
    pub const TILE_LENGTH: u16 = 323;
    pub const TILE_OFFSETS: u16 = 324;
    pub const TILE_BYTE_COUNTS: u16 = 325;
    pub const SUB_IFDS: u16 = 330;
    pub const SAMPLE_FORMAT: u16 = 339;
    pub const JPEG_TABLES: u16 = 347;
    pub const YCBCR_SUBSAMPLING: u16 = 530;
    pub const DNG_VERSION: u16 = 50_706;
}

/// Colour filter array, and DNG's linear raw.
const RAW_PHOTOMETRIC: [u64; 2] = [32_803, 34_892];
const MAX_SAMPLES: usize = 32;
/// Tiles are squares of some hundred pixels; the limit bounds what one row of a tile takes.
const MAX_TILE: u64 = 65_536;
const REMEDY: &str = "copy it again from its source";

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Chunks {
    Strips { rows: usize },
    Tiles { width: usize, height: usize },
}

pub(super) struct Layout<'a> {
    pub width: usize,
    pub height: usize,
    pub encoding: Encoding,
    pub codec: Codec,
    pub pixels: Pixels,
    /// 1 when the samples of a pixel lie together.
    pub num_planes: usize,
    pub chunks: Chunks,
    pub palette: Option<Vec<[u8; 3]>>,
    pub jpeg_tables: Option<&'a [u8]>,
    offsets: Vec<u64>,
    lengths: Vec<u64>,
}

impl<'a> Layout<'a> {
    pub fn read(bytes: &'a [u8]) -> Result<Self, FrontendError> {
        let (file, first) = File::open(bytes).ok_or_else(|| corrupt("has half a header"))?;
        let directory = file
            .directory(first)
            .ok_or_else(|| corrupt("is truncated: its directory lies beyond its end"))?;
        refuse_raw(&file, &directory)?;
        let size = |tag| directory.unsigned(tag).filter(|v| (1..=u64::from(u32::MAX)).contains(v));
        let (Some(width), Some(height)) = (size(tag::IMAGE_WIDTH), size(tag::IMAGE_LENGTH)) else {
            return Err(corrupt("states no size"));
        };
        let codec = Codec::of(directory.unsigned(tag::COMPRESSION).unwrap_or(1)).map_err(unsupported)?;
        if directory.unsigned(tag::FILL_ORDER) == Some(2) {
            return Err(unsupported("bits in reversed order"));
        }
        let photometric = directory
            .unsigned(tag::PHOTOMETRIC)
            .ok_or_else(|| corrupt("does not say what its samples mean"))?;
        let samples = directory.unsigned(tag::SAMPLES_PER_PIXEL).unwrap_or(1) as usize;
        if !(1..=MAX_SAMPLES).contains(&samples) {
            return Err(unsupported(&format!("{samples} samples a pixel")));
        }
        let pixels = Pixels { model: model(photometric, samples, codec, &directory)?, stride: samples };
        let encoding = encoding(&file, &directory, photometric, samples)?;
        let num_planes = if directory.unsigned(tag::PLANAR_CONFIGURATION) == Some(2) { samples } else { 1 };
        let palette = (photometric == 3).then(|| palette(&directory, encoding)).transpose()?;
        let chunks = chunks(&directory, height)?;
        let (offsets, lengths) = places(&directory, bytes.len(), chunks, codec)?;
        let layout = Self {
            width: width as usize,
            height: height as usize,
            encoding,
            codec,
            pixels,
            num_planes,
            chunks,
            palette,
            jpeg_tables: directory.entry(tag::JPEG_TABLES).map(|entry| entry.data),
            offsets,
            lengths,
        };
        let row = row_bytes(layout.width.saturating_mul(samples), encoding.bits) as u64;
        check_plausible(Format::Tiff, bytes.len(), row.saturating_mul(height), codec.max_ratio())?;
        if layout.offsets.len() < layout.num_chunks() {
            return Err(corrupt("names fewer strips or tiles than its size needs"));
        }
        Ok(layout)
    }

    fn num_chunks(&self) -> usize {
        let in_a_plane = match self.chunks {
            Chunks::Strips { rows } => self.height.div_ceil(rows),
            Chunks::Tiles { width, height } => {
                self.width.div_ceil(width).saturating_mul(self.height.div_ceil(height))
            }
        };
        in_a_plane.saturating_mul(self.num_planes)
    }

    /// Samples of a pixel that lie together in a strip or tile.
    pub fn samples_per_chunk_pixel(&self) -> usize {
        self.pixels.stride / self.num_planes
    }

    /// Where a strip or tile begins, and its length.
    pub fn chunk(&self, index: usize) -> Result<(usize, usize), FrontendError> {
        let place = |list: &[u64]| list.get(index).and_then(|v| usize::try_from(*v).ok());
        place(&self.offsets)
            .zip(place(&self.lengths))
            .ok_or_else(|| corrupt("names fewer strips or tiles than its size needs"))
    }

    /// Checks that all strips or tiles lie within so many bytes.
    pub fn check_whole(&self, num_bytes: usize) -> Result<(), FrontendError> {
        let used = self.offsets.iter().zip(&self.lengths).take(self.num_chunks());
        match used.clone().find(|(offset, length)| offset.saturating_add(**length) > num_bytes as u64) {
            Some(_) => Err(corrupt(&format!("is truncated: its pixels end beyond its {num_bytes} bytes"))),
            None if used.clone().any(|(_, length)| *length == 0) => Err(corrupt("has empty strips or tiles")),
            None => Ok(()),
        }
    }
}

/// Raw formats are TIFF files whose first image is a small preview, or that say so by a tag of their own.
fn refuse_raw(file: &File<'_>, directory: &Directory<'_>) -> Result<(), FrontendError> {
    let is_raw = |directory: &Directory<'_>| {
        directory.unsigned(tag::PHOTOMETRIC).is_some_and(|value| RAW_PHOTOMETRIC.contains(&value))
    };
    let is_reduced = directory.unsigned(tag::NEW_SUBFILE_TYPE).is_some_and(|kind| kind & 1 == 1);
    let children = directory.entry(tag::SUB_IFDS).into_iter().flat_map(|entry| {
        (0..8).map_while(|k| entry.unsigned_at(k)).filter_map(|offset| file.directory(offset))
    });
    if is_reduced
        || directory.entry(tag::DNG_VERSION).is_some()
        || is_raw(directory)
        || children.into_iter().any(|child| is_raw(&child))
    {
        return Err(FrontendError::unsupported(
            "camera raw files (DNG, NEF, ARW, PEF) are not read: develop the photographs with a raw converter to JPEG \
             or TIFF without cropping or lens corrections, keeping their EXIF",
        ));
    }
    Ok(())
}

fn model(
    photometric: u64,
    samples: usize,
    codec: Codec,
    directory: &Directory<'_>,
) -> Result<Model, FrontendError> {
    let subsampling = || {
        let entry = directory.entry(tag::YCBCR_SUBSAMPLING);
        entry.map_or((2, 2), |e| (e.unsigned_at(0).unwrap_or(2), e.unsigned_at(1).unwrap_or(2)))
    };
    match photometric {
        // The lightness of CIE L*a*b* stands first, and is brightness enough.
        0 | 1 | 8 | 9 | 10 => Ok(Model::Gray),
        2 if samples >= 3 => Ok(Model::Rgb),
        3 => Ok(Model::Gray),
        5 if samples >= 4 => Ok(Model::Cmyk),
        6 if samples >= 3 && (codec == Codec::Jpeg || subsampling() == (1, 1)) => Ok(Model::YCbCr),
        6 => Err(unsupported("subsampled colours outside of JPEG")),
        2 | 5 => Err(corrupt("has too few samples a pixel for its colours")),
        4 => Err(unsupported("a transparency mask as its first image")),
        _ => Err(unsupported("unknown colours")),
    }
}

fn encoding(
    file: &File<'_>,
    directory: &Directory<'_>,
    photometric: u64,
    samples: usize,
) -> Result<Encoding, FrontendError> {
    let all_equal = |tag: u16, default: u64| match directory.entry(tag) {
        None => Ok(default),
        Some(entry) => {
            let first = entry.unsigned_at(0).ok_or_else(|| corrupt("has a broken directory"))?;
            match (1..samples).all(|k| entry.unsigned_at(k).is_none_or(|value| value == first)) {
                true => Ok(first),
                false => Err(unsupported("samples of different sizes or kinds")),
            }
        }
    };
    let bits = all_equal(tag::BITS_PER_SAMPLE, 1)?;
    let kind = match all_equal(tag::SAMPLE_FORMAT, 1)? {
        2 => Kind::Signed,
        3 => Kind::Float,
        1 | 4 => Kind::Unsigned,
        _ => return Err(unsupported("complex samples")),
    };
    let predictor = match directory.unsigned(tag::PREDICTOR).unwrap_or(1) {
        2 if !matches!(bits, 8 | 16 | 32) => return Err(unsupported("a predictor for samples of this size")),
        2 => Predictor::Horizontal,
        3 if kind == Kind::Float => Predictor::Float,
        3 => return Err(unsupported("a floating-point predictor for integers")),
        _ => Predictor::None,
    };
    let is_known = match kind {
        Kind::Unsigned => matches!(bits, 1 | 2 | 4 | 8..=16 | 32),
        Kind::Signed => matches!(bits, 8 | 16 | 32),
        Kind::Float => matches!(bits, 16 | 32 | 64),
    };
    let is_palette = photometric == 3;
    if !is_known || is_palette && (bits > 8 || kind != Kind::Unsigned) || photometric == 6 && bits != 8 {
        return Err(unsupported(&format!("{kind:?} samples of {bits} bits").to_lowercase()));
    }
    let is_inverted = photometric == 0;
    Ok(Encoding { bits: bits as usize, kind, order: file.order, predictor, is_inverted, is_palette })
}

/// A TIFF colour map holds all reds, then all greens, then all blues, of 16 bits; some programs write 8.
fn palette(directory: &Directory<'_>, encoding: Encoding) -> Result<Vec<[u8; 3]>, FrontendError> {
    let num_colors = 1_usize << encoding.bits;
    let entry = directory.entry(tag::COLOR_MAP).filter(|entry| entry.count >= 3 * num_colors as u64);
    let values = entry.map(|entry| (0..3 * num_colors).map(|k| entry.unsigned_at(k).unwrap_or(0)));
    let values: Vec<u64> =
        values.ok_or_else(|| corrupt("has a palette that is too short: save it again as RGB"))?.collect();
    let shift = if values.iter().all(|value| *value < 256) { 0 } else { 8 };
    let color = |k: usize| [0, 1, 2].map(|channel| (values[channel * num_colors + k] >> shift) as u8);
    Ok((0..num_colors).map(color).collect())
}

fn chunks(directory: &Directory<'_>, height: u64) -> Result<Chunks, FrontendError> {
    match (directory.unsigned(tag::TILE_WIDTH), directory.unsigned(tag::TILE_LENGTH)) {
        (Some(width @ 1..=MAX_TILE), Some(tile_height @ 1..=MAX_TILE)) => {
            Ok(Chunks::Tiles { width: width as usize, height: tile_height as usize })
        }
        (None, None) => {
            let rows = directory.unsigned(tag::ROWS_PER_STRIP).unwrap_or(height).min(height);
            if rows == 0 {
                return Err(corrupt("has strips without rows"));
            }
            Ok(Chunks::Strips { rows: rows as usize })
        }
        _ => Err(corrupt("has tiles of a size that makes no sense")),
    }
}

/// Offsets and lengths of the strips or tiles. One plain strip may leave out its length.
fn places(
    directory: &Directory<'_>,
    num_bytes: usize,
    chunks: Chunks,
    codec: Codec,
) -> Result<(Vec<u64>, Vec<u64>), FrontendError> {
    let (offset_tag, length_tag) = match chunks {
        Chunks::Strips { .. } => (tag::STRIP_OFFSETS, tag::STRIP_BYTE_COUNTS),
        Chunks::Tiles { .. } => (tag::TILE_OFFSETS, tag::TILE_BYTE_COUNTS),
    };
    if directory.lost.iter().any(|lost| [offset_tag, length_tag].contains(lost)) {
        return Err(corrupt("is truncated: the list of its strips or tiles lies beyond its end"));
    }
    let list = |tag| directory.entry(tag).and_then(|entry| entry.unsigned());
    let offsets = list(offset_tag).ok_or_else(|| corrupt("does not say where its pixels are"))?;
    let lengths = match (list(length_tag), offsets.as_slice()) {
        (Some(lengths), _) => lengths,
        (None, [offset]) if codec == Codec::Plain => vec![(num_bytes as u64).saturating_sub(*offset)],
        _ => return Err(corrupt("does not say how long its strips or tiles are")),
    };
    if lengths.len() < offsets.len() {
        return Err(corrupt("does not say how long its strips or tiles are"));
    }
    Ok((offsets, lengths))
}

fn corrupt(what: &str) -> FrontendError {
    FrontendError::corrupt(format!("the TIFF file {what}: {REMEDY}"))
}

fn unsupported(what: &str) -> FrontendError {
    FrontendError::unsupported(format!(
        "TIFF with {what} is not read: save it as RGB or grey of 8 or 16 bits, without compression or with LZW or \
         Deflate, keeping its EXIF"
    ))
}
