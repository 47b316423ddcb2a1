//! TIFF, classic and big, in either byte order: grey, RGB, palette, inks; strips and tiles, interleaved and in planes; of
//! 1 to 16 bits, 32 bits and floating point; plain, PackBits, LZW, Deflate and JPEG (TIFF 6.0, 1992, and its notes).
//!
//! Strips are unpacked row by row, tiles a row of tiles at a time.

mod codec;
mod directory;
mod layout;
mod samples;

use std::io::Read;

pub(crate) use directory::{Directory, Entry, File, Order};

use self::codec::Codec;
use self::layout::{Chunks, Layout};
use self::samples::{Kind, Unpack, row_bytes, undo_predictor};
use super::canvas::{Canvas, Model, Pixels};
use super::{DecodeOptions, DecodedImage, jpeg};
use crate::FrontendError;

pub(super) fn probe(bytes: &[u8]) -> Result<(u32, u32), FrontendError> {
    let layout = Layout::read(bytes)?;
    layout.check_whole(bytes.len())?;
    Ok((layout.width as u32, layout.height as u32))
}

pub(super) fn decode(bytes: &[u8], options: &DecodeOptions) -> Result<DecodedImage, FrontendError> {
    let layout = Layout::read(bytes)?;
    match (layout.encoding.bits, layout.encoding.kind) {
        (1..=8, _) => draw::<u8>(bytes, &layout, options),
        (9..=16, Kind::Unsigned | Kind::Signed) => draw::<u16>(bytes, &layout, options),
        _ => draw::<f32>(bytes, &layout, options),
    }
}

fn draw<S: Unpack>(
    bytes: &[u8],
    layout: &Layout<'_>,
    options: &DecodeOptions,
) -> Result<DecodedImage, FrontendError> {
    let mut target = Target {
        canvas: Canvas::<S>::new(layout.width, layout.height, options.color),
        pixels: layout.pixels,
        palette: layout.palette.as_deref(),
        looked_up: Vec::new(),
    };
    match layout.chunks {
        Chunks::Strips { rows } => draw_strips(bytes, layout, rows, &mut target)?,
        Chunks::Tiles { width, height } => draw_tiles(bytes, layout, (width, height), &mut target)?,
    }
    target.canvas.finish()
}

/// A canvas behind a palette, if there is one.
struct Target<'a, S> {
    canvas: Canvas<S>,
    pixels: Pixels,
    palette: Option<&'a [[u8; 3]]>,
    looked_up: Vec<S>,
}

impl<S: Unpack> Target<'_, S> {
    fn push_row(&mut self, row: &[S]) -> Result<(), FrontendError> {
        let Some(palette) = self.palette else {
            self.canvas.push_row(self.pixels, row);
            return Ok(());
        };
        self.looked_up.clear();
        for pixel in row.chunks_exact(self.pixels.stride) {
            let index: f32 = pixel[0].into();
            let color = palette.get(index as usize).ok_or_else(|| {
                FrontendError::corrupt("the TIFF file's palette is too short: save it again as RGB")
            })?;
            self.looked_up.extend(color.map(|value| S::from_mean(f32::from(value))));
        }
        self.canvas.push_row(Pixels { model: Model::Rgb, stride: 3 }, &self.looked_up);
        Ok(())
    }
}

/// The rows of one strip or tile, of one plane or of all.
struct Rows<'a> {
    stream: Box<dyn Read + 'a>,
    raw: Vec<u8>,
    scratch: Vec<u8>,
}

impl Rows<'_> {
    /// Appends the first `wanted` samples of the next row.
    fn read<S: Unpack>(
        &mut self,
        layout: &Layout<'_>,
        wanted: usize,
        out: &mut Vec<S>,
    ) -> Result<(), FrontendError> {
        self.stream.read_exact(&mut self.raw).map_err(|error| {
            FrontendError::corrupt(format!(
                "the TIFF file's pixels are broken or end early ({error}): copy it again from its source"
            ))
        })?;
        let mut encoding = layout.encoding;
        undo_predictor(&mut self.raw, layout.samples_per_chunk_pixel(), &mut encoding, &mut self.scratch);
        S::unpack(&self.raw, wanted, &encoding, out);
        Ok(())
    }
}

/// The unpacked bytes of JPEG strips or tiles lie in `unpacked`.
fn open<'a>(
    bytes: &'a [u8],
    layout: &Layout<'_>,
    chunk: usize,
    (width, height): (usize, usize),
    unpacked: &'a mut Vec<u8>,
) -> Result<Rows<'a>, FrontendError> {
    let (offset, length) = layout.chunk(chunk)?;
    let packed = bytes.get(offset..).map_or(&[][..], |tail| &tail[..length.min(tail.len())]);
    let data: &[u8] = if layout.codec == Codec::Jpeg {
        *unpacked = unpack_jpeg(layout, packed, (width, height))?;
        unpacked
    } else {
        packed
    };
    let raw = vec![0; row_bytes(width * layout.samples_per_chunk_pixel(), layout.encoding.bits)];
    Ok(Rows { stream: codec::open(layout.codec, data), raw, scratch: Vec::new() })
}

/// A strip's or tile's JPEG leaves its tables to the directory (TIFF technical note 2, 1995).
fn unpack_jpeg(
    layout: &Layout<'_>,
    packed: &[u8],
    (width, height): (usize, usize),
) -> Result<Vec<u8>, FrontendError> {
    let mut whole = vec![0xff, 0xd8];
    if let Some(tables) = layout.jpeg_tables {
        whole.extend_from_slice(tables.get(2..tables.len().saturating_sub(2)).unwrap_or_default());
    }
    whole.extend_from_slice(packed.strip_prefix(&[0xff, 0xd8]).unwrap_or(packed));
    let frame = jpeg::walk(&whole, jpeg::Until::End)?;
    let samples = layout.samples_per_chunk_pixel();
    if frame.width as usize != width
        || (frame.height as usize) > height
        || frame.num_components != samples
        || layout.encoding.bits != 8
    {
        return Err(FrontendError::corrupt(
            "the TIFF file holds JPEG data of another size than it states: save it again with another program",
        ));
    }
    super::check_plausible(
        super::Format::Jpeg,
        whole.len(),
        u64::from(frame.width) * u64::from(frame.height),
        jpeg::MAX_RATIO,
    )?;
    jpeg::decode_samples(whole, &frame)
}

fn draw_strips<S: Unpack>(
    bytes: &[u8],
    layout: &Layout<'_>,
    rows_per_strip: usize,
    target: &mut Target<'_, S>,
) -> Result<(), FrontendError> {
    let num_strips = layout.height.div_ceil(rows_per_strip);
    let stride = layout.samples_per_chunk_pixel();
    let (mut row, mut plane_row) = (Vec::new(), Vec::new());
    for strip in 0..num_strips {
        let num_rows = rows_per_strip.min(layout.height - strip * rows_per_strip);
        let mut unpacked = vec![Vec::new(); layout.num_planes];
        let mut planes = Vec::with_capacity(layout.num_planes);
        for (plane, unpacked) in unpacked.iter_mut().enumerate() {
            let chunk = plane * num_strips + strip;
            planes.push(open(bytes, layout, chunk, (layout.width, rows_per_strip), unpacked)?);
        }
        for _ in 0..num_rows {
            if let [only] = planes.as_mut_slice() {
                row.clear();
                only.read(layout, layout.width * stride, &mut row)?;
            } else {
                row.resize(layout.width * layout.num_planes, S::default());
                for (plane, rows) in planes.iter_mut().enumerate() {
                    plane_row.clear();
                    rows.read(layout, layout.width, &mut plane_row)?;
                    let places = row.iter_mut().skip(plane).step_by(layout.num_planes);
                    places.zip(&plane_row).for_each(|(place, sample)| *place = *sample);
                }
            }
            target.push_row(&row)?;
        }
    }
    Ok(())
}

fn draw_tiles<S: Unpack>(
    bytes: &[u8],
    layout: &Layout<'_>,
    (tile_width, tile_height): (usize, usize),
    target: &mut Target<'_, S>,
) -> Result<(), FrontendError> {
    let (across, down) = (layout.width.div_ceil(tile_width), layout.height.div_ceil(tile_height));
    let samples = layout.pixels.stride;
    let within = layout.samples_per_chunk_pixel();
    let row_len = layout.width * samples;
    let (mut band, mut piece) = (Vec::new(), Vec::new());
    for tile_row in 0..down {
        let num_rows = tile_height.min(layout.height - tile_row * tile_height);
        band.resize(row_len * num_rows, S::default());
        for plane in 0..layout.num_planes {
            for column in 0..across {
                let chunk = (plane * down + tile_row) * across + column;
                let mut unpacked = Vec::new();
                let mut rows = open(bytes, layout, chunk, (tile_width, tile_height), &mut unpacked)?;
                let left = column * tile_width;
                let width = tile_width.min(layout.width - left);
                for row in band.chunks_exact_mut(row_len) {
                    piece.clear();
                    rows.read(layout, width * within, &mut piece)?;
                    let place = &mut row[left * samples..(left + width) * samples];
                    if layout.num_planes == 1 {
                        place.copy_from_slice(&piece);
                    } else {
                        let places = place.iter_mut().skip(plane).step_by(samples);
                        places.zip(&piece).for_each(|(place, sample)| *place = *sample);
                    }
                }
            }
        }
        band.chunks_exact(row_len).try_for_each(|row| target.push_row(row))?;
    }
    Ok(())
}
