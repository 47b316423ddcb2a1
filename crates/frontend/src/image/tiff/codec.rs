//! The streams that strips and tiles are packed in: plain, PackBits, LZW, Deflate. Each is read as it is needed, so that
//! one strip that holds the whole image costs no more memory than its rows.

use std::io::{self, Read};

use flate2::bufread::ZlibDecoder;
use weezl::{BitOrder, LzwStatus};

/// How pixels are packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Codec {
    Plain,
    PackBits,
    Lzw,
    Deflate,
    Jpeg,
}

impl Codec {
    /// By the number of the tag; otherwise the name of what is not read.
    pub fn of(compression: u64) -> Result<Self, &'static str> {
        match compression {
            1 => Ok(Self::Plain),
            5 => Ok(Self::Lzw),
            7 => Ok(Self::Jpeg),
            8 | 32_946 => Ok(Self::Deflate),
            32_773 => Ok(Self::PackBits),
            2..=4 | 32_771 => Err("fax (CCITT) compression"),
            6 => Err("JPEG compression of the old style"),
            33_003 | 33_004 | 33_005 | 34_712 => Err("JPEG 2000 compression"),
            34_887 => Err("LERC compression"),
            34_892 => Err("lossy DNG compression"),
            34_925 => Err("LZMA compression"),
            50_000 => Err("Zstandard compression"),
            50_001 => Err("WebP compression"),
            50_002 => Err("JPEG XL compression"),
            _ => Err("an unknown compression"),
        }
    }

    /// Bytes that one byte can become at most.
    pub fn max_ratio(self) -> u64 {
        match self {
            Self::Plain => 1,
            Self::PackBits => 64,
            Self::Deflate => 1040,
            // Codes of 12 bits stand for up to 3,838 bytes.
            Self::Lzw => 2560,
            Self::Jpeg => 4096,
        }
    }
}

/// The unpacked bytes of a strip or tile; for JPEG, `data` are unpacked already.
pub(super) fn open<'a>(codec: Codec, data: &'a [u8]) -> Box<dyn Read + 'a> {
    match codec {
        Codec::Plain | Codec::Jpeg => Box::new(data),
        Codec::PackBits => Box::new(PackBits { data, run: Run::Header }),
        Codec::Lzw => {
            let decoder = weezl::decode::Decoder::with_tiff_size_switch(BitOrder::Msb, 8);
            Box::new(Lzw { decoder, data })
        }
        Codec::Deflate => Box::new(ZlibDecoder::new(data)),
    }
}

/// TIFF 6.0, section 9.
struct PackBits<'a> {
    data: &'a [u8],
    run: Run,
}

enum Run {
    Header,
    Literal(usize),
    Repeat(u8, usize),
}

impl Read for PackBits<'_> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let mut written = 0;
        while written < out.len() {
            match self.run {
                Run::Header => {
                    let [header, tail @ ..] = self.data else { break };
                    self.data = tail;
                    self.run = match (*header as i8, tail) {
                        (-128, _) => Run::Header,
                        (literal @ 0.., _) => Run::Literal(literal as usize + 1),
                        (repeat, [value, tail @ ..]) => {
                            self.data = tail;
                            Run::Repeat(*value, 1 + usize::from(repeat.unsigned_abs()))
                        }
                        (_, []) => break,
                    };
                }
                Run::Literal(left) => {
                    let count = left.min(out.len() - written).min(self.data.len());
                    if count == 0 {
                        break;
                    }
                    let (now, tail) = self.data.split_at(count);
                    out[written..written + count].copy_from_slice(now);
                    self.data = tail;
                    written += count;
                    self.run = if left == count { Run::Header } else { Run::Literal(left - count) };
                }
                Run::Repeat(value, left) => {
                    let count = left.min(out.len() - written);
                    out[written..written + count].fill(value);
                    written += count;
                    self.run = if left == count { Run::Header } else { Run::Repeat(value, left - count) };
                }
            }
        }
        Ok(written)
    }
}

/// TIFF 6.0, section 13.
struct Lzw<'a> {
    decoder: weezl::decode::Decoder,
    data: &'a [u8],
}

impl Read for Lzw<'_> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        loop {
            let result = self.decoder.decode_bytes(self.data, out);
            self.data = &self.data[result.consumed_in..];
            if result.consumed_out > 0 || out.is_empty() {
                return Ok(result.consumed_out);
            }
            match result.status {
                Ok(LzwStatus::Ok) if result.consumed_in > 0 => {}
                Ok(_) => return Ok(0),
                Err(error) => return Err(io::Error::new(io::ErrorKind::InvalidData, error)),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unpack(data: &[u8]) -> Vec<u8> {
        let mut out = Vec::new();
        open(Codec::PackBits, data).read_to_end(&mut out).unwrap();
        out
    }

    #[test]
    fn packbits_follow_the_example_of_the_standard() {
        let packed = b"\xfe\xaa\x02\x80\x00\x2a\xfd\xaa\x03\x80\x00\x2a\x22\xf7\xaa";
        let mut wanted = vec![0xaa; 3];
        wanted.extend(b"\x80\x00\x2a");
        wanted.extend([0xaa; 4]);
        wanted.extend(b"\x80\x00\x2a\x22");
        wanted.extend([0xaa; 10]);
        assert_eq!(unpack(packed), wanted);
        assert_eq!(unpack(b"\x80\x80\x00\x07"), [7]);
        for broken in [&b"\x05ab"[..], b"\xfe", b""] {
            assert!(unpack(broken).len() <= 2);
        }
    }
}
