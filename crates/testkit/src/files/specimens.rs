//! Small valid files of every kind, for fuzzing to start from. A reader takes microseconds for each.

use exif::experimental::Writer;
use exif::{Field, In, Rational, Tag, Value};
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};

use super::tiff::pack;
use super::{Compression, TiffWriter};
use crate::mutate::Specimen;

const WIDTH: usize = 19;
const HEIGHT: usize = 13;

/// Byte strings that mean something in the formats that are read, for mutations.
pub fn words() -> &'static [&'static [u8]] {
    &[
        b"\xff\xd8",
        b"\xff\xd9",
        b"\xff\xc0",
        b"\xff\xc2",
        b"\xff\xc4",
        b"\xff\xda",
        b"\xff\xdd\0\x04\0\x01",
        b"\xff\xd0",
        b"\xff\xe1",
        b"\xff\xee\0\x0eAdobe\0\x64\0\0\0\0\0",
        b"\xff\xff",
        b"\xff\0",
        b"Exif\0\0",
        b"IHDR",
        b"IDAT",
        b"IEND",
        b"PLTE",
        b"tRNS",
        b"eXIf",
        b"acTL",
        b"fdAT",
        b"II\x2a\0",
        b"MM\0\x2a",
        b"II\x2b\0",
        b"\0\x01",
        b"\x01\0",
        b"http://ns.adobe.com/xap/1.0/\0",
        b"drone-dji:",
        b"RtkStdLat=\"",
        b"\"",
        b"<",
        b"/>",
        b"</",
        b"&amp;",
        b"1e400",
        b"-",
        b"+",
        b".",
        b"NaN",
        b"\xef\xbb\xbf",
        b"\x87\x69\0\x04",
        b"\x69\x87\x04\0",
        b"\x88\x25\0\x04",
        b"\x25\x88\x04\0",
    ]
}

/// Pictures: JPEG, PNG and TIFF of every kind.
pub fn image_specimens() -> Vec<Specimen> {
    let mut all = jpegs();
    all.extend(pngs());
    all.extend(tiffs());
    all
}

fn picture(channels: usize) -> Vec<u8> {
    (0..WIDTH * HEIGHT * channels).map(|k| (k * 7 + k / WIDTH * 13) as u8).collect()
}

fn jpeg(name: &str, color: ColorType, set: impl FnOnce(&mut Encoder<&mut Vec<u8>>)) -> Specimen {
    let channels = match color {
        ColorType::Luma => 1,
        ColorType::Cmyk | ColorType::CmykAsYcck => 4,
        _ => 3,
    };
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, 60);
    set(&mut encoder);
    // A size of zero would be the only error.
    let _ = encoder.encode(&picture(channels), WIDTH as u16, HEIGHT as u16, color);
    let scan = bytes.windows(2).position(|pair| pair == [0xff, 0xda]).unwrap_or(0);
    Specimen::new(format!("jpeg {name}"), bytes, scan + 14)
}

fn jpegs() -> Vec<Specimen> {
    let sampled = |name: &str, factor| jpeg(name, ColorType::Rgb, |e| e.set_sampling_factor(factor));
    vec![
        jpeg("grey", ColorType::Luma, |_| {}),
        sampled("4:4:4", SamplingFactor::F_1_1),
        sampled("4:2:2", SamplingFactor::F_2_1),
        sampled("4:2:0", SamplingFactor::F_2_2),
        sampled("4:4:0", SamplingFactor::F_1_2),
        jpeg("restarts", ColorType::Rgb, |e| e.set_restart_interval(1)),
        jpeg("progressive", ColorType::Rgb, |e| {
            e.set_progressive(true);
            e.set_sampling_factor(SamplingFactor::F_2_2);
        }),
        jpeg("progressive grey", ColorType::Luma, |e| e.set_progressive(true)),
        jpeg("inks", ColorType::Cmyk, |e| e.set_sampling_factor(SamplingFactor::F_1_1)),
        jpeg("inks as YCCK", ColorType::CmykAsYcck, |e| e.set_sampling_factor(SamplingFactor::F_1_1)),
    ]
}

fn pngs() -> Vec<Specimen> {
    use png::{BitDepth, ColorType};
    let mut all = Vec::new();
    for (name, color, depth, channels) in [
        ("1 bit", ColorType::Grayscale, BitDepth::One, 1),
        ("grey", ColorType::Grayscale, BitDepth::Eight, 1),
        ("16 bits", ColorType::Grayscale, BitDepth::Sixteen, 2),
        ("palette", ColorType::Indexed, BitDepth::Four, 1),
        ("RGB", ColorType::Rgb, BitDepth::Eight, 3),
        ("RGBA of 16 bits", ColorType::Rgba, BitDepth::Sixteen, 8),
    ] {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, WIDTH as u32, HEIGHT as u32);
        encoder.set_color(color);
        encoder.set_depth(depth);
        if color == ColorType::Indexed {
            encoder.set_palette((0..48).collect::<Vec<u8>>());
        }
        let row = match depth {
            BitDepth::One => WIDTH.div_ceil(8),
            BitDepth::Four => WIDTH.div_ceil(2),
            _ => WIDTH * channels,
        };
        // The header and the length of the data are right by construction.
        if let Ok(mut writer) = encoder.write_header() {
            let _ = writer.write_image_data(&picture(8)[..row * HEIGHT]);
        }
        all.push(Specimen::new(format!("png {name}"), bytes, 60));
    }
    all.push(Specimen::new("png interlaced", interlaced_png(WIDTH, HEIGHT, &picture(1)), 60));
    all
}

/// A grey PNG of eight bits in the seven passes of Adam7, which the library does not write (PNG 1.2, section 8.2).
pub fn interlaced_png(width: usize, height: usize, grays: &[u8]) -> Vec<u8> {
    const PASSES: [(usize, usize, usize, usize); 7] =
        [(0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)];
    let mut raw = Vec::new();
    for (left, top, across, down) in PASSES {
        for y in (top..height).step_by(down).filter(|_| left < width) {
            raw.push(0);
            raw.extend((left..width).step_by(across).map(|x| grays[y * width + x]));
        }
    }
    let mut bytes = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR".to_vec();
    bytes.extend((width as u32).to_be_bytes());
    bytes.extend((height as u32).to_be_bytes());
    bytes.extend([8, 0, 0, 0, 1, 0, 0, 0, 0]);
    let packed = pack(Compression::Deflate, &raw);
    bytes.extend((packed.len() as u32).to_be_bytes());
    bytes.extend(b"IDAT");
    bytes.extend(packed);
    bytes.extend(b"\0\0\0\0\0\0\0\0IEND\0\0\0\0");
    mend_png(&mut bytes);
    bytes
}

/// Makes the checksums of a PNG's chunks right again, so that mutations get past them.
pub fn mend_png(bytes: &mut [u8]) {
    let mut at = 8;
    while let Some(head) = bytes.get(at..at + 8) {
        let length = u32::from_be_bytes([head[0], head[1], head[2], head[3]]) as usize;
        let end = at.saturating_add(8).saturating_add(length);
        let Some(covered) = bytes.get(at + 4..end) else { return };
        let mut sum = flate2::Crc::new();
        sum.update(covered);
        let sum = sum.sum().to_be_bytes();
        let Some(place) = bytes.get_mut(end..end + 4) else { return };
        place.copy_from_slice(&sum);
        at = end + 4;
    }
}

fn tiffs() -> Vec<Specimen> {
    let base = |samples, bits| TiffWriter::new(WIDTH, HEIGHT, samples, bits);
    let palette: Vec<u8> = (0..96).collect();
    let kinds = [
        ("1 bit", base(1, 1)),
        ("RGB", base(3, 8)),
        ("packed", TiffWriter { compression: Compression::PackBits, ..base(1, 8) }),
        ("LZW", TiffWriter { compression: Compression::Lzw, predictor: 2, ..base(3, 8) }),
        (
            "Deflate",
            TiffWriter { compression: Compression::Deflate, predictor: 2, big_endian: true, ..base(1, 16) },
        ),
        ("tiles", TiffWriter { tile: Some((16, 16)), compression: Compression::Deflate, ..base(3, 8) }),
        ("planes", TiffWriter { planar: true, big: true, ..base(3, 16) }),
        ("planes in tiles", TiffWriter { planar: true, tile: Some((16, 16)), ..base(3, 8) }),
        ("float", TiffWriter { format: 3, predictor: 3, compression: Compression::Deflate, ..base(1, 32) }),
        ("palette", TiffWriter { photometric: 3, extra: vec![(320, 3, 48, palette)], ..base(1, 4) }),
        ("inks", TiffWriter { photometric: 5, ..base(4, 8) }),
        ("12 bits", TiffWriter { big_endian: true, ..base(1, 12) }),
    ];
    kinds
        .into_iter()
        .map(|(name, writer)| {
            let values: Vec<u64> = picture(writer.samples).iter().map(|v| u64::from(*v) * 0x0101).collect();
            let bytes = writer.write(&values);
            let len = bytes.len();
            // The directory stands behind the pixels.
            let tail = len.saturating_sub(260);
            Specimen { name: format!("tiff {name}"), bytes, hot: vec![(0, 16), (tail, len)] }
        })
        .collect()
}

/// Files whose EXIF holds what is read of it: in a JPEG, a PNG, and TIFFs of either byte order and size of offset.
pub fn exif_specimens() -> Vec<Specimen> {
    let mut all = Vec::new();
    for little_endian in [true, false] {
        let block = exif_block(little_endian);
        let name = if little_endian { "little-endian" } else { "big-endian" };
        let mut segment = b"Exif\0\0".to_vec();
        segment.extend(&block);
        let mut specimen = jpeg(&format!("exif {name}"), ColorType::Luma, |encoder| {
            let _ = encoder.add_app_segment(1, segment);
        });
        specimen.hot = vec![(20, 20 + block.len() + 10)];
        all.push(specimen);
        all.push(png_with_exif(&block, name));
    }
    for big in [false, true] {
        let extra = vec![
            (271, 2, 4, b"DJI\0".to_vec()),
            (272, 2, 7, b"FC6310\0".to_vec()),
            (274, 3, 1, vec![6, 0]),
            (34_665, 4, 1, vec![8, 0, 0, 0]),
            (34_853, 4, 1, vec![16, 0, 0, 0]),
        ];
        let bytes =
            TiffWriter { big, extra, ..TiffWriter::new(WIDTH, HEIGHT, 1, 8) }.write(&vec![7; WIDTH * HEIGHT]);
        let len = bytes.len();
        all.push(Specimen {
            name: format!("tiff with exif, big {big}"),
            bytes,
            hot: vec![(len.saturating_sub(300), len)],
        });
    }
    all
}

fn png_with_exif(block: &[u8], name: &str) -> Specimen {
    let plain =
        pngs().into_iter().find(|specimen| specimen.name == "png grey").map(|s| s.bytes).unwrap_or_default();
    let mut bytes = plain.get(..33).unwrap_or_default().to_vec();
    bytes.extend((block.len() as u32).to_be_bytes());
    bytes.extend(b"eXIf");
    bytes.extend(block);
    bytes.extend([0; 4]);
    bytes.extend(plain.get(33..).unwrap_or_default());
    mend_png(&mut bytes);
    Specimen { name: format!("png exif {name}"), bytes, hot: vec![(33, 41 + block.len())] }
}

fn exif_block(little_endian: bool) -> Vec<u8> {
    let text = |value: &str| Value::Ascii(vec![value.as_bytes().to_vec()]);
    let ratio = |num: u32, denom: u32| Rational { num, denom };
    let one = |num: u32, denom: u32| Value::Rational(vec![ratio(num, denom)]);
    let angle = |degrees: u32| Value::Rational(vec![ratio(degrees, 1), ratio(30, 1), ratio(3600, 100)]);
    let values = [
        (Tag::Make, text("DJI")),
        (Tag::Model, text("FC6310")),
        (Tag::LensModel, text("fixed")),
        (Tag::BodySerialNumber, text("0042")),
        (Tag::Orientation, Value::Short(vec![6])),
        (Tag::FocalLength, one(88, 10)),
        (Tag::FocalLengthIn35mmFilm, Value::Short(vec![24])),
        (Tag::FocalPlaneXResolution, one(4000, 1)),
        (Tag::FocalPlaneResolutionUnit, Value::Short(vec![3])),
        (Tag::PixelXDimension, Value::Long(vec![WIDTH as u32])),
        (Tag::DateTimeOriginal, text("2026:02:03 04:05:06")),
        (Tag::SubSecTimeOriginal, text("25")),
        (Tag::GPSLatitude, angle(46)),
        (Tag::GPSLatitudeRef, text("N")),
        (Tag::GPSLongitude, angle(7)),
        (Tag::GPSLongitudeRef, text("E")),
        (Tag::GPSAltitude, one(5555, 10)),
        (Tag::GPSAltitudeRef, Value::Byte(vec![0])),
        (Tag::GPSStatus, text("A")),
        (Tag::GPSDOP, one(12, 10)),
        (Tag::GPSHPositioningError, one(15, 10)),
    ];
    let fields: Vec<Field> =
        values.into_iter().map(|(tag, value)| Field { tag, ifd_num: In::PRIMARY, value }).collect();
    let mut writer = Writer::new();
    fields.iter().for_each(|field| writer.push_field(field));
    let mut block = std::io::Cursor::new(Vec::new());
    // Writing to memory does not fail.
    let _ = writer.write(&mut block, little_endian);
    block.into_inner()
}

/// Photographs with XMP as drones write it: attributes, elements, and a position in EXIF beside it.
pub fn xmp_specimens() -> Vec<Specimen> {
    let names = [
        ("RtkStdLon", "0.012"),
        ("RtkStdLat", "0.015"),
        ("RtkStdHgt", "0.031"),
        ("RtkFlag", "50"),
        ("GpsLatitude", "+46.51"),
        ("GpsLongitude", "+7.255"),
        ("AbsoluteAltitude", "+512.30"),
        ("RelativeAltitude", "+80.10"),
        ("GimbalRollDegree", "+0.00"),
        ("GimbalYawDegree", "-12.50"),
        ("GimbalPitchDegree", "-89.90"),
        ("FlightYawDegree", "+3.10"),
        ("CalibratedFocalLength", "3666.666504"),
    ];
    let attributes: String = names.iter().map(|(n, v)| format!(" drone-dji:{n}=\"{v}\"")).collect();
    let elements: String = names.iter().map(|(n, v)| format!("<drone-dji:{n}>{v}</drone-dji:{n}>")).collect();
    let space = "xmlns:drone-dji=\"http://www.dji.com/drone-dji/1.0/\"";
    let packets = [
        (
            "attributes",
            format!("<x:xmpmeta><rdf:RDF><rdf:Description {space}{attributes}/></rdf:RDF></x:xmpmeta>"),
        ),
        (
            "elements",
            format!(
                "<x:xmpmeta><rdf:RDF><rdf:Description {space}>{elements}</rdf:Description></rdf:RDF></x:xmpmeta>"
            ),
        ),
    ];
    let mut exif = b"Exif\0\0".to_vec();
    exif.extend(exif_block(true));
    packets
        .iter()
        .map(|(name, packet)| {
            let mut segment = b"http://ns.adobe.com/xap/1.0/\0".to_vec();
            segment.extend(packet.as_bytes());
            let len = segment.len();
            let mut specimen = jpeg(&format!("xmp {name}"), ColorType::Luma, |encoder| {
                let _ = encoder.add_app_segment(1, segment);
                let _ = encoder.add_app_segment(1, exif.clone());
            });
            specimen.hot = vec![(20, 20 + len + 10)];
            specimen
        })
        .collect()
}
