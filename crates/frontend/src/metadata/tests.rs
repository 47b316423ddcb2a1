//! Metadata of whole and of broken files.

use exif::experimental::Writer;
use exif::{Rational, SRational};
use jpeg_encoder::{ColorType, Encoder};

use super::*;

fn rational(num: u32, denom: u32) -> Rational {
    Rational { num, denom }
}

fn field_of(tag: Tag, value: Value) -> Field {
    Field { tag, ifd_num: In::PRIMARY, value }
}

fn ascii(text: &str) -> Value {
    Value::Ascii(vec![text.as_bytes().to_vec()])
}

fn exif_bytes(fields: &[Field]) -> Vec<u8> {
    let mut writer = Writer::new();
    fields.iter().for_each(|field| writer.push_field(field));
    let mut bytes = std::io::Cursor::new(Vec::new());
    writer.write(&mut bytes, true).unwrap();
    bytes.into_inner()
}

fn photo_with(segment: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, 90);
    encoder.add_app_segment(1, segment.to_vec()).unwrap();
    encoder.encode(&[90; 40 * 30], 40, 30, ColorType::Luma).unwrap();
    bytes
}

fn read_fields(fields: &[Field]) -> ImageMetadata {
    let mut segment = b"Exif\0\0".to_vec();
    segment.extend(exif_bytes(fields));
    read(&photo_with(&segment)).unwrap()
}

fn position(latitude: Vec<Rational>, longitude: Vec<Rational>) -> Vec<Field> {
    vec![
        field_of(Tag::GPSLatitude, Value::Rational(latitude)),
        field_of(Tag::GPSLongitude, Value::Rational(longitude)),
    ]
}

fn somewhere() -> Vec<Field> {
    let part = |d, m, s| vec![rational(d, 1), rational(m, 1), rational(s, 100)];
    position(part(46, 30, 3600), part(7, 15, 1800))
}

#[test]
fn camera_lens_time_and_focal_lengths_are_read() {
    let metadata = read_fields(&[
        field_of(Tag::Make, ascii("DJI")),
        field_of(Tag::Model, ascii("FC6310 ")),
        field_of(Tag::LensModel, ascii("fixed")),
        field_of(Tag::BodySerialNumber, ascii("0042")),
        field_of(Tag::Orientation, Value::Short(vec![6])),
        field_of(Tag::FocalLength, Value::Rational(vec![rational(88, 10)])),
        field_of(Tag::FocalLengthIn35mmFilm, Value::Short(vec![24])),
        field_of(Tag::DateTimeOriginal, ascii("2026:02:03 04:05:06")),
        field_of(Tag::SubSecTimeOriginal, ascii("25")),
    ]);
    assert_eq!((metadata.width_px, metadata.height_px), (40, 30));
    assert_eq!(metadata.model.as_deref(), Some("FC6310"));
    assert_eq!(metadata.serial.as_deref(), Some("0042"));
    assert_eq!(metadata.lens.as_deref(), Some("fixed"));
    assert_eq!(metadata.orientation, Orientation(6));
    assert_eq!((metadata.focal_mm, metadata.focal_35mm), (Some(8.8), Some(24.0)));
    assert_eq!(metadata.captured_s, Some(1_770_091_506.25));
    assert_eq!(metadata.notes, Vec::<String>::new());
}

#[test]
fn focal_plane_resolution_follows_its_unit_and_a_later_change_of_size() {
    let resolution = |unit: u16, value: u32, stated: u32| {
        read_fields(&[
            field_of(Tag::FocalPlaneXResolution, Value::Rational(vec![rational(value, 10)])),
            field_of(Tag::FocalPlaneResolutionUnit, Value::Short(vec![unit])),
            field_of(Tag::PixelXDimension, Value::Long(vec![stated])),
        ])
    };
    assert_eq!(resolution(3, 1000, 40).focal_plane_px_per_mm, Some(10.0));
    assert_eq!(resolution(2, 2540, 40).focal_plane_px_per_mm, Some(10.0));
    assert_eq!(resolution(4, 100, 40).focal_plane_px_per_mm, Some(10.0));
    assert_eq!(resolution(3, 1000, 80).focal_plane_px_per_mm, Some(5.0));
    // A sensor 40 cm wide, and a unit that does not exist.
    for metadata in [resolution(3, 10, 40), resolution(9, 1000, 40)] {
        assert_eq!((metadata.focal_plane_px_per_mm, metadata.notes.len()), (None, 1));
    }
}

#[test]
fn positions_follow_their_references_and_defaults() {
    let plain = read_fields(&somewhere()).gps.unwrap();
    assert!((plain.latitude_deg - 46.51).abs() < 1e-12);
    assert!((plain.longitude_deg - 7.255).abs() < 1e-12);
    assert_eq!((plain.altitude_m, plain.sigma_horizontal_m, plain.sigma_vertical_m), (None, 5.0, 10.0));
    let mut fields = somewhere();
    fields.extend([
        field_of(Tag::GPSLatitudeRef, ascii("S")),
        field_of(Tag::GPSLongitudeRef, ascii("W")),
        field_of(Tag::GPSAltitude, Value::Rational(vec![rational(125, 10)])),
        field_of(Tag::GPSAltitudeRef, Value::Byte(vec![1])),
        field_of(Tag::GPSHPositioningError, Value::Rational(vec![rational(15, 10)])),
    ]);
    let south = read_fields(&fields).gps.unwrap();
    assert!((south.latitude_deg + 46.51).abs() < 1e-12 && (south.longitude_deg + 7.255).abs() < 1e-12);
    assert_eq!((south.altitude_m, south.sigma_horizontal_m, south.sigma_vertical_m), (Some(-12.5), 1.5, 3.0));
    let mut fields = somewhere();
    fields.push(field_of(Tag::GPSAltitude, Value::SRational(vec![SRational { num: -7, denom: 2 }])));
    fields.push(field_of(Tag::GPSDOP, Value::Rational(vec![rational(2, 1)])));
    let signed = read_fields(&fields).gps.unwrap();
    assert_eq!((signed.altitude_m, signed.sigma_horizontal_m), (Some(-3.5), 6.0));
}

#[test]
fn positions_that_are_none_are_left_out_with_a_note() {
    let zero = || vec![rational(0, 1); 3];
    let mut void = somewhere();
    void.push(field_of(Tag::GPSStatus, ascii("V")));
    for fields in [
        position(zero(), zero()),
        position(vec![rational(0, 0); 3], vec![rational(7, 1)]),
        position(vec![rational(95, 1)], vec![rational(7, 1)]),
        void,
    ] {
        let metadata = read_fields(&fields);
        assert_eq!((metadata.gps, metadata.notes.len()), (None, 1));
    }
    // Minutes of 0/0 are none; the degrees stand.
    let metadata = read_fields(&position(vec![rational(46, 1), rational(0, 0)], vec![rational(7, 1)]));
    assert_eq!(metadata.gps.unwrap().latitude_deg, 46.0);
}

#[test]
fn receivers_own_deviations_are_taken_from_xmp() {
    let xmp =
        br#"<rdf drone-dji:RtkStdLon="0.012" drone-dji:RtkStdLat="0.015" drone-dji:RtkStdHgt="0.031"/>"#;
    let mut segment = b"Exif\0\0".to_vec();
    segment.extend(exif_bytes(&somewhere()));
    let mut photo = photo_with(&segment);
    let mut app1 = vec![0xff, 0xe1, 0, (xmp.len() + 2) as u8];
    app1.extend(xmp);
    photo.splice(2..2, app1);
    let gps = read(&photo).unwrap().gps.unwrap();
    assert_eq!((gps.sigma_horizontal_m, gps.sigma_vertical_m), (0.015, 0.031));
}

#[test]
fn files_without_or_with_broken_exif_are_used() {
    let none = photo_with(b"something else");
    let metadata = read(&none).unwrap();
    assert_eq!((metadata.width_px, metadata.notes.len()), (40, 0));
    let metadata = read(&photo_with(b"Exif\0\0this is no tiff header")).unwrap();
    assert_eq!((metadata.width_px, metadata.notes.len()), (40, 1));
    assert!(read(b"").is_err());
    let whole = photo_with(b"something else");
    assert!(read(&whole[..whole.len() - 30]).unwrap_err().is_corrupt());
}

#[test]
fn damaged_exif_never_panics() {
    let mut fields = somewhere();
    fields.push(field_of(Tag::Model, ascii("camera")));
    fields.push(field_of(Tag::DateTimeOriginal, ascii("2026:02:03 04:05:06")));
    let whole = exif_bytes(&fields);
    let mut state = 7_u32;
    for _ in 0..3000 {
        let mut segment = b"Exif\0\0".to_vec();
        segment.extend(&whole);
        for _ in 0..2 {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let at = 6 + (state >> 8) as usize % whole.len();
            segment[at] ^= (state >> 3) as u8 | 1;
        }
        assert_eq!(read(&photo_with(&segment)).unwrap().width_px, 40);
    }
}

#[test]
fn days_are_counted_over_leap_years() {
    assert_eq!(days_since_1970(1970, 1, 1), 0);
    assert_eq!(days_since_1970(2000, 3, 1), 11_017);
    assert_eq!(days_since_1970(2024, 2, 29), 19_782);
    assert_eq!(days_since_1970(1969, 12, 31), -1);
}
