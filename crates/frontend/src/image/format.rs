//! Which format a file is in, by its first bytes: extensions are not to be trusted.

use std::fmt;

use crate::FrontendError;

/// Formats that are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// JPEG, baseline or progressive.
    Jpeg,
    /// PNG.
    Png,
    /// TIFF, classic or big.
    Tiff,
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Jpeg => "JPEG",
            Self::Png => "PNG",
            Self::Tiff => "TIFF",
        })
    }
}

/// Formats that are recognised in order to say what to do, as (offset, magic, name).
const FOREIGN: [(usize, &[u8], &str); 15] = [
    (4, b"ftyphei", "HEIC"),
    (4, b"ftyphev", "HEIC"),
    (4, b"ftypmif1", "HEIC"),
    (4, b"ftypmsf1", "HEIC"),
    (4, b"ftypavi", "AVIF"),
    (4, b"ftypcrx ", "Canon raw (CR3)"),
    (8, b"CR\x02\0", "Canon raw (CR2)"),
    (0, b"IIRO", "Olympus raw (ORF)"),
    (0, b"MMOR", "Olympus raw (ORF)"),
    (0, b"IIU\0", "Panasonic raw (RW2)"),
    (0, b"FUJIFILMCCD-RAW", "Fujifilm raw (RAF)"),
    (8, b"WEBP", "WebP"),
    (0, b"GIF8", "GIF"),
    (0, b"\0\0\0\x0cjP  ", "JPEG 2000"),
    (0, b"\xff\x0a", "JPEG XL"),
];

pub(super) fn identify(bytes: &[u8]) -> Result<Format, FrontendError> {
    if bytes.is_empty() {
        return Err(FrontendError::corrupt("the file is empty (0 bytes): copy it again from its source"));
    }
    for (offset, magic, name) in FOREIGN {
        if bytes.get(offset..).is_some_and(|tail| tail.starts_with(magic)) {
            return Err(FrontendError::unsupported(format!(
                "{name} files are not read: convert the photographs to JPEG, PNG or TIFF, keeping their EXIF"
            )));
        }
    }
    match bytes {
        [0xff, 0xd8, 0xff, ..] => Ok(Format::Jpeg),
        [0x89, b'P', b'N', b'G', 0x0d, 0x0a, 0x1a, 0x0a, ..] => Ok(Format::Png),
        [b'I', b'I', 42 | 43, 0, ..] | [b'M', b'M', 0, 42 | 43, ..] => Ok(Format::Tiff),
        [b'B', b'M', ..] if bytes.len() > 26 && bytes[6..10] == [0; 4] => Err(FrontendError::unsupported(
            "BMP files are not read: convert the photographs to JPEG, PNG or TIFF",
        )),
        _ => {
            let what = if bytes.iter().take(512).all(|b| b.is_ascii_graphic() || b.is_ascii_whitespace()) {
                "the file is text, not an image"
            } else {
                "the file is not a JPEG, PNG or TIFF image (by its first bytes)"
            };
            Err(FrontendError::unsupported(format!("{what}: remove it, or convert it to JPEG, PNG or TIFF")))
        }
    }
}
