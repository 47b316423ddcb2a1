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

/// What a file of a format that is not read can become.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Remedy {
    /// A picture in another container.
    Convert,
    /// Sensor data: needs a raw converter.
    Develop,
    /// Moving pictures.
    ExtractFrames,
    /// No picture at all.
    Remove,
}

impl Remedy {
    fn sentence(self) -> &'static str {
        match self {
            Self::Convert => "convert the photographs to JPEG, PNG or TIFF, keeping their EXIF",
            Self::Develop => {
                "develop the photographs with a raw converter to JPEG or TIFF without cropping or lens corrections, \
                 keeping their EXIF"
            }
            Self::ExtractFrames => {
                "extract its frames as JPEG or PNG (for example `ffmpeg -i VIDEO -vf fps=2 -qscale:v 2 %06d.jpg`)"
            }
            Self::Remove => "remove it, or export the photographs in it as JPEG, PNG or TIFF",
        }
    }
}

/// Formats that are recognised in order to say what to do, as (offset, magic, name, remedy).
#[rustfmt::skip]
pub(super) const FOREIGN: &[(usize, &[u8], &str, Remedy)] = &[
    (8, b"CR\x02\0", "Canon raw (CR2)", Remedy::Develop),
    (6, b"HEAPCCDR", "Canon raw (CRW)", Remedy::Develop),
    (0, b"IIRO", "Olympus raw (ORF)", Remedy::Develop),
    (0, b"IIRS", "Olympus raw (ORF)", Remedy::Develop),
    (0, b"MMOR", "Olympus raw (ORF)", Remedy::Develop),
    (0, b"IIU\0", "Panasonic raw (RW2)", Remedy::Develop),
    (0, b"FUJIFILMCCD-RAW", "Fujifilm raw (RAF)", Remedy::Develop),
    (0, b"FOVb", "Sigma raw (X3F)", Remedy::Develop),
    (0, b"\0MRM", "Minolta raw (MRW)", Remedy::Develop),
    (8, b"IIII", "Phase One raw (IIQ)", Remedy::Develop),
    (8, b"WEBP", "WebP", Remedy::Convert),
    (8, b"AVI ", "AVI video", Remedy::ExtractFrames),
    (0, b"GIF8", "GIF", Remedy::Convert),
    (0, b"\0\0\0\x0cjP  ", "JPEG 2000", Remedy::Convert),
    (0, b"\xff\x4f\xff\x51", "JPEG 2000", Remedy::Convert),
    (0, b"\xff\x0a", "JPEG XL", Remedy::Convert),
    (0, b"\0\0\0\x0cJXL ", "JPEG XL", Remedy::Convert),
    (0, b"II\xbc", "JPEG XR", Remedy::Convert),
    (0, b"8BPS", "Photoshop", Remedy::Convert),
    (0, b"\x76\x2f\x31\x01", "OpenEXR", Remedy::Convert),
    (0, b"#?RADIANCE", "Radiance HDR", Remedy::Convert),
    (0, b"\0\0\x01\0", "icon", Remedy::Convert),
    (0, b"\x1a\x45\xdf\xa3", "Matroska or WebM video", Remedy::ExtractFrames),
    (0, b"\0\0\x01\xba", "MPEG video", Remedy::ExtractFrames),
    (0, b"%PDF", "PDF", Remedy::Remove),
    (0, b"PK\x03\x04", "ZIP", Remedy::Remove),
    (0, b"\x1f\x8b", "gzip", Remedy::Remove),
    (0, b"7z\xbc\xaf", "7-Zip", Remedy::Remove),
    (0, b"Rar!", "RAR", Remedy::Remove),
    (128, b"DICM", "DICOM", Remedy::Convert),
];

/// Formats of the ISO base media family, by the brands in their first box. The order matters: a HEIC file may also
/// name the brands of the container that it shares with video.
#[rustfmt::skip]
const BRANDS: &[(&[u8], &str, Remedy)] = &[
    (b"crx ", "Canon raw (CR3)", Remedy::Develop),
    (b"avif", "AVIF", Remedy::Convert),
    (b"avis", "AVIF", Remedy::Convert),
    (b"heic", "HEIC", Remedy::Convert),
    (b"heix", "HEIC", Remedy::Convert),
    (b"heim", "HEIC", Remedy::Convert),
    (b"heis", "HEIC", Remedy::Convert),
    (b"hevc", "HEIC", Remedy::Convert),
    (b"hevx", "HEIC", Remedy::Convert),
    (b"mif1", "HEIF", Remedy::Convert),
    (b"msf1", "HEIF", Remedy::Convert),
    (b"qt  ", "QuickTime video", Remedy::ExtractFrames),
];

pub(super) fn identify(bytes: &[u8]) -> Result<Format, FrontendError> {
    if bytes.is_empty() {
        return Err(FrontendError::corrupt("the file is empty (0 bytes): copy it again from its source"));
    }
    match bytes {
        [0xff, 0xd8, 0xff, ..] => return Ok(Format::Jpeg),
        [0x89, b'P', b'N', b'G', 0x0d, 0x0a, 0x1a, 0x0a, ..] => return Ok(Format::Png),
        _ => {}
    }
    if let Some((name, remedy)) = foreign(bytes) {
        return Err(FrontendError::unsupported(format!("{name} files are not read: {}", remedy.sentence())));
    }
    if let [b'I', b'I', 42 | 43, 0, ..] | [b'M', b'M', 0, 42 | 43, ..] = bytes {
        return Ok(Format::Tiff);
    }
    let what = if bytes.iter().all(|b| *b == 0) {
        "the file holds nothing but zeros: copy it again from its source"
    } else if is_text(bytes) {
        "the file is text, not an image: remove it, or convert it to JPEG, PNG or TIFF"
    } else {
        "the file is not a JPEG, PNG or TIFF image (by its first bytes): remove it, or convert it to JPEG, PNG or TIFF"
    };
    Err(FrontendError::unsupported(what))
}

fn foreign(bytes: &[u8]) -> Option<(&'static str, Remedy)> {
    let at = |offset: usize, magic: &[u8]| bytes.get(offset..).is_some_and(|tail| tail.starts_with(magic));
    if at(4, b"ftyp") {
        return Some(base_media(bytes));
    }
    if let [b'B', b'M', ..] = bytes
        && at(6, &[0; 4])
        && bytes.len() > 26
    {
        return Some(("BMP", Remedy::Convert));
    }
    if let [b'P', b'1'..=b'7', b' ' | b'\n' | b'\r' | b'\t', ..] = bytes {
        return Some(("portable anymap (PNM)", Remedy::Convert));
    }
    FOREIGN.iter().find(|(offset, magic, ..)| at(*offset, magic)).map(|(_, _, name, remedy)| (*name, *remedy))
}

/// The major brand stands at byte 8, the compatible ones from byte 16 to the end of the box.
fn base_media(bytes: &[u8]) -> (&'static str, Remedy) {
    let length = bytes.first_chunk::<4>().map_or(0, |b| u32::from_be_bytes(*b) as usize);
    let end = length.clamp(12, 256).min(bytes.len());
    let major = bytes.get(8..12).unwrap_or_default();
    let compatible = bytes.get(16..end).unwrap_or_default();
    let named = |brand: &[u8]| major == brand || compatible.chunks_exact(4).any(|b| b == brand);
    BRANDS
        .iter()
        .find(|(brand, ..)| major == *brand)
        .or_else(|| BRANDS.iter().find(|(b, ..)| named(b)))
        .map_or(("video (MP4 and its relatives)", Remedy::ExtractFrames), |(_, name, remedy)| {
            (*name, *remedy)
        })
}

fn is_text(bytes: &[u8]) -> bool {
    bytes.iter().take(512).all(|b| b.is_ascii_graphic() || b.is_ascii_whitespace())
}
