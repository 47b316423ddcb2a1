//! A TIFF writer for every kind of TIFF that the reader takes (TIFF 6.0, 1992; BigTIFF, 2007).

use std::io::Write;

/// How strips and tiles are packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Compression {
    /// As they are.
    None,
    /// Runs of bytes.
    PackBits,
    /// Lempel–Ziv–Welch.
    Lzw,
    /// zlib.
    Deflate,
}

/// A kind of TIFF.
#[derive(Clone, Debug)]
pub struct TiffWriter {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Samples a pixel.
    pub samples: usize,
    /// Bits a sample.
    pub bits: usize,
    /// Sample format: 1 unsigned, 2 signed, 3 floating point.
    pub format: u16,
    /// Photometric interpretation: 0 white is zero, 1 black is zero, 2 RGB, 3 palette, 5 inks, …
    pub photometric: u16,
    /// How pixels are packed.
    pub compression: Compression,
    /// 1 none, 2 horizontal differences, 3 floating point.
    pub predictor: u16,
    /// Whether each sample has a plane of its own.
    pub planar: bool,
    /// Columns and rows of a tile; `None` for strips.
    pub tile: Option<(usize, usize)>,
    /// Rows of a strip.
    pub rows_per_strip: usize,
    /// Whether the most significant byte comes first.
    pub big_endian: bool,
    /// Whether offsets have eight bytes.
    pub big: bool,
    /// Further entries of the directory: tag, type, number of values, their bytes in the file's order.
    pub extra: Vec<(u16, u16, u64, Vec<u8>)>,
}

impl TiffWriter {
    /// A plain file of unsigned samples: grey of one sample, RGB of three.
    pub fn new(width: usize, height: usize, samples: usize, bits: usize) -> Self {
        Self {
            width,
            height,
            samples,
            bits,
            format: 1,
            photometric: if samples >= 3 { 2 } else { 1 },
            compression: Compression::None,
            predictor: 1,
            planar: false,
            tile: None,
            rows_per_strip: 5,
            big_endian: false,
            big: false,
            extra: Vec::new(),
        }
    }

    /// The file. `values` are the bit patterns of the samples, interleaved, row after row.
    pub fn write(&self, values: &[u64]) -> Vec<u8> {
        let mut out = if self.big_endian { b"MM".to_vec() } else { b"II".to_vec() };
        self.push(&mut out, if self.big { 43 } else { 42 }, 2);
        if self.big {
            self.push(&mut out, 8, 2);
            self.push(&mut out, 0, 2);
        }
        let header = out.len();
        let word = if self.big { 8 } else { 4 };
        self.push(&mut out, 0, word);
        let (mut offsets, mut lengths) = (Vec::new(), Vec::new());
        for chunk in self.chunks(values) {
            offsets.push(out.len() as u64);
            lengths.push(chunk.len() as u64);
            out.extend(chunk);
        }
        out.resize(out.len().next_multiple_of(8), 0);
        let directory = out.len() as u64;
        let mut place = Vec::new();
        self.push(&mut place, directory, word);
        out[header..header + word].copy_from_slice(&place);
        self.push_directory(&mut out, &offsets, &lengths);
        out
    }

    fn push(&self, out: &mut Vec<u8>, value: u64, size: usize) {
        let bytes = value.to_le_bytes();
        if self.big_endian {
            out.extend(bytes[..size].iter().rev());
        } else {
            out.extend(&bytes[..size]);
        }
    }

    /// Packed strips or tiles, plane after plane.
    fn chunks(&self, values: &[u64]) -> Vec<Vec<u8>> {
        let (chunk_width, chunk_height) = self.tile.unwrap_or((self.width, self.rows_per_strip));
        let planes = if self.planar { self.samples } else { 1 };
        let mut chunks = Vec::new();
        for plane in 0..planes {
            for top in (0..self.height).step_by(chunk_height) {
                for left in (0..self.width).step_by(chunk_width) {
                    let bottom = if self.tile.is_some() {
                        top + chunk_height
                    } else {
                        self.height.min(top + chunk_height)
                    };
                    let mut raw = Vec::new();
                    for y in top..bottom {
                        let channels = if self.planar { plane..plane + 1 } else { 0..self.samples };
                        // Tiles are padded by repeating the edge.
                        let row: Vec<u64> = (left..left + chunk_width)
                            .flat_map(|x| {
                                let at = (y.min(self.height - 1) * self.width + x.min(self.width - 1))
                                    * self.samples;
                                channels.clone().map(move |channel| values[at + channel])
                            })
                            .collect();
                        raw.extend(self.row(&row, channels.len()));
                    }
                    chunks.push(pack(self.compression, &raw));
                }
            }
        }
        chunks
    }

    fn row(&self, values: &[u64], stride: usize) -> Vec<u8> {
        let mask = if self.bits == 64 { u64::MAX } else { (1 << self.bits) - 1 };
        let difference = |k: usize| match self.predictor {
            2 if k >= stride => values[k].wrapping_sub(values[k - stride]) & mask,
            _ => values[k] & mask,
        };
        let mut out = Vec::new();
        if self.predictor == 3 {
            let size = self.bits / 8;
            for significance in 0..size {
                out.extend(values.iter().map(|v| (v >> (8 * (size - 1 - significance))) as u8));
            }
            let whole = out.clone();
            (stride..out.len()).for_each(|k| out[k] = whole[k].wrapping_sub(whole[k - stride]));
        } else if self.bits.is_multiple_of(8) {
            (0..values.len()).for_each(|k| self.push(&mut out, difference(k), self.bits / 8));
        } else {
            let (mut held, mut count) = (0_u64, 0);
            for value in values {
                held = held << self.bits | value & mask;
                count += self.bits;
                while count >= 8 {
                    count -= 8;
                    out.push((held >> count) as u8);
                }
            }
            if count > 0 {
                out.push((held << (8 - count)) as u8);
            }
        }
        out
    }

    fn push_directory(&self, out: &mut Vec<u8>, offsets: &[u64], lengths: &[u64]) {
        let mut entries = self.extra.clone();
        let word = if self.big { 16 } else { 4 };
        let mut add = |tag: u16, kind: u16, values: &[u64]| {
            let size = [0, 1, 1, 2, 4][usize::from(kind.min(4))].max(if kind == 16 { 8 } else { 0 });
            let mut data = Vec::new();
            values.iter().for_each(|value| self.push(&mut data, *value, size));
            entries.push((tag, kind, values.len() as u64, data));
        };
        add(256, 4, &[self.width as u64]);
        add(257, 4, &[self.height as u64]);
        add(258, 3, &vec![self.bits as u64; self.samples]);
        let compression = match self.compression {
            Compression::None => 1,
            Compression::PackBits => 32_773,
            Compression::Lzw => 5,
            Compression::Deflate => 8,
        };
        add(259, 3, &[compression]);
        add(262, 3, &[u64::from(self.photometric)]);
        add(277, 3, &[self.samples as u64]);
        add(284, 3, &[if self.planar { 2 } else { 1 }]);
        add(317, 3, &[u64::from(self.predictor)]);
        add(339, 3, &vec![u64::from(self.format); self.samples]);
        match self.tile {
            Some((width, height)) => {
                add(322, 4, &[width as u64]);
                add(323, 4, &[height as u64]);
                add(324, word, offsets);
                add(325, word, lengths);
            }
            None => {
                add(273, word, offsets);
                add(278, 4, &[self.rows_per_strip as u64]);
                add(279, word, lengths);
            }
        }
        // An entry that is given takes the place of the writer's own.
        let given: Vec<u16> = self.extra.iter().map(|(tag, ..)| *tag).collect();
        let own = entries.split_off(self.extra.len()).into_iter().filter(|(tag, ..)| !given.contains(tag));
        entries.extend(own);
        entries.sort_by_key(|(tag, ..)| *tag);
        let (count, inline, size) = if self.big { (8, 8, 20) } else { (2, 4, 12) };
        self.push(out, entries.len() as u64, count);
        let mut behind = out.len() + entries.len() * size + inline;
        let mut values: Vec<u8> = Vec::new();
        for (tag, kind, number, data) in &entries {
            self.push(out, u64::from(*tag), 2);
            self.push(out, u64::from(*kind), 2);
            self.push(out, *number, inline);
            if data.len() <= inline {
                out.extend(data);
                out.resize(out.len() + inline - data.len(), 0);
            } else {
                self.push(out, behind as u64, inline);
                behind += data.len();
                values.extend(data);
            }
        }
        self.push(out, 0, inline);
        out.extend(values);
    }
}

pub(super) fn pack(compression: Compression, raw: &[u8]) -> Vec<u8> {
    match compression {
        Compression::None => raw.to_vec(),
        Compression::PackBits => pack_bits(raw),
        Compression::Lzw => weezl::encode::Encoder::with_tiff_size_switch(weezl::BitOrder::Msb, 8)
            .encode(raw)
            .unwrap_or_default(),
        Compression::Deflate => {
            let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::default());
            let written = encoder.write_all(raw);
            written.and_then(|()| encoder.finish()).unwrap_or_default()
        }
    }
}

fn pack_bits(raw: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut at = 0;
    while at < raw.len() {
        let run = raw[at..].iter().take(128).take_while(|b| **b == raw[at]).count();
        if run >= 2 {
            out.extend([(257 - run) as u8, raw[at]]);
            at += run;
        } else {
            let end = (at + 1..raw.len().min(at + 128))
                .find(|k| raw[*k] == raw[k - 1])
                .unwrap_or(raw.len().min(at + 128));
            out.push((end - at - 1) as u8);
            out.extend(&raw[at..end]);
            at = end;
        }
    }
    out
}
