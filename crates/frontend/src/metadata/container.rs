//! The EXIF block of a file, bounded: a JPEG's segment, a PNG's chunk, or a TIFF's directories without its pixels.
//!
//! A TIFF is one EXIF block with the pixels in it. Its directories are written anew without what no camera states of
//! itself, so that reading them neither copies the file nor believes a value of its size. That also makes a BigTIFF
//! readable for a reader of classic ones.

use crate::image::tiff::{Directory, Entry, File, Order};
use crate::image::{Format, png_chunk};

/// A JPEG's segment holds no more; nor does any camera write more.
const MAX_BLOCK: usize = 65_536;
/// Values of a TIFF that are longer are no metadata of use here.
const MAX_VALUE: usize = 4096;
const EXIF_POINTER: u16 = 34_665;
const GPS_POINTER: u16 = 34_853;

/// The bytes of EXIF, from its TIFF header on; `None` when the file has none.
pub(super) fn exif_block(bytes: &[u8], format: Format) -> Option<Vec<u8>> {
    match format {
        Format::Jpeg => jpeg_segment(bytes, b"Exif\0\0").map(<[u8]>::to_vec),
        Format::Png => {
            let chunk = png_chunk(bytes, b"eXIf")?;
            let block = chunk.strip_prefix(b"Exif\0\0").unwrap_or(chunk);
            Some(block[..block.len().min(MAX_BLOCK)].to_vec())
        }
        Format::Tiff => tiff_directories(bytes),
    }
}

/// What follows a signature in the first of a JPEG's APP1 segments that begins with it.
fn jpeg_segment<'a>(bytes: &'a [u8], signature: &[u8]) -> Option<&'a [u8]> {
    let mut at = 2;
    loop {
        match bytes.get(at..at + 2)? {
            // Fill bytes may stand before a marker.
            [0xff, 0xff] => at += 1,
            [0xff, 0xda | 0xd9] => return None,
            [0xff, 0x01 | 0xd0..=0xd8] => at += 2,
            [0xff, marker] => {
                let length = usize::from(u16::from_be_bytes(*bytes.get(at + 2..)?.first_chunk()?)).max(2);
                let segment = bytes.get(at + 4..at + 2 + length)?;
                if let (0xe1, Some(rest)) = (*marker, segment.strip_prefix(signature)) {
                    return Some(rest);
                }
                at += 2 + length;
            }
            _ => at += 1,
        }
    }
}

fn tiff_directories(bytes: &[u8]) -> Option<Vec<u8>> {
    let (file, first) = File::open(bytes)?;
    let main = file.directory(first)?;
    let mut block = match file.order {
        Order::Little => b"II\x2a\0\0\0\0\0".to_vec(),
        Order::Big => b"MM\0\x2a\0\0\0\0".to_vec(),
    };
    let child = |pointer: u16| file.directory(main.unsigned(pointer)?);
    let pointers: Vec<(u16, u32)> = [EXIF_POINTER, GPS_POINTER]
        .into_iter()
        .filter_map(|pointer| Some((pointer, append(&mut block, file.order, &child(pointer)?, &[]))))
        .collect();
    let start = append(&mut block, file.order, &main, &pointers);
    block[4..8].copy_from_slice(&word(file.order, start));
    Some(block)
}

/// Writes a directory at the end of a block and returns its offset. Pointers replace the entries of their tags.
fn append(block: &mut Vec<u8>, order: Order, directory: &Directory<'_>, pointers: &[(u16, u32)]) -> u32 {
    let is_kept = |entry: &&Entry<'_>| {
        entry.data.len() <= MAX_VALUE && entry.kind <= 13 && ![EXIF_POINTER, GPS_POINTER].contains(&entry.tag)
    };
    let room = MAX_BLOCK.saturating_sub(block.len());
    let mut kept: Vec<&Entry<'_>> = Vec::new();
    let mut used = 0;
    for entry in directory.entries.iter().filter(is_kept) {
        used += 12 + entry.data.len();
        if used > room {
            break;
        }
        kept.push(entry);
    }
    let start = block.len();
    block.extend(half(order, (kept.len() + pointers.len()) as u16));
    let mut table = block.len();
    block.resize(table + 12 * (kept.len() + pointers.len()) + 4, 0);
    let mut put = |block: &mut Vec<u8>, tag: u16, kind: u16, count: u32, data: &[u8]| {
        block[table..table + 2].copy_from_slice(&half(order, tag));
        block[table + 2..table + 4].copy_from_slice(&half(order, kind));
        block[table + 4..table + 8].copy_from_slice(&word(order, count));
        if data.len() <= 4 {
            block[table + 8..table + 8 + data.len()].copy_from_slice(data);
        } else {
            let offset = block.len() as u32;
            block[table + 8..table + 12].copy_from_slice(&word(order, offset));
            block.extend_from_slice(data);
        }
        table += 12;
    };
    for entry in kept {
        put(block, entry.tag, entry.kind, entry.count as u32, entry.data);
    }
    for (tag, offset) in pointers {
        put(block, *tag, 4, 1, &word(order, *offset));
    }
    start as u32
}

fn half(order: Order, value: u16) -> [u8; 2] {
    match order {
        Order::Little => value.to_le_bytes(),
        Order::Big => value.to_be_bytes(),
    }
}

fn word(order: Order, value: u32) -> [u8; 4] {
    match order {
        Order::Little => value.to_le_bytes(),
        Order::Big => value.to_be_bytes(),
    }
}
