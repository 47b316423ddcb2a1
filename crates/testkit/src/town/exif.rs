//! The file: JPEG, with what a drone writes into EXIF.

use exif::experimental::Writer;
use exif::{Field, In, Rational, Tag, Value};
use terrane_geometry::Camera;
use terrane_geometry::geodesy::Geodetic;

use super::raster::Pixels;

const JPEG_QUALITY: u8 = 93;

/// Encodes a photograph; the position goes into its GPS tags with a resolution below a millimetre.
pub(super) fn jpeg(pixels: &Pixels, camera: &Camera, position: &Geodetic, index: usize) -> Vec<u8> {
    let mut file = Vec::new();
    let mut encoder = jpeg_encoder::Encoder::new(&mut file, JPEG_QUALITY);
    encoder.set_sampling_factor(jpeg_encoder::SamplingFactor::F_1_1);
    if let Some(tags) = tags(camera, position, index) {
        // Too long a segment is the only error, and a few tags are never that.
        let _ = encoder.add_app_segment(1, tags);
    }
    let (width, height) = (pixels.width as u16, pixels.height as u16);
    if encoder.encode(&pixels.rgb, width, height, jpeg_encoder::ColorType::Rgb).is_err() {
        return Vec::new();
    }
    file
}

fn rational(value: f64, denominator: u32) -> Rational {
    Rational { num: (value * f64::from(denominator)).round() as u32, denom: denominator }
}

/// Degrees, minutes, seconds of an angle's magnitude.
fn degrees(angle_rad: f64) -> Value {
    let degrees = angle_rad.to_degrees().abs();
    let minutes = degrees.fract() * 60.0;
    let seconds = minutes.fract() * 60.0;
    Value::Rational(vec![
        rational(degrees.floor(), 1),
        rational(minutes.floor(), 1),
        rational(seconds, 1_000_000),
    ])
}

fn text(value: &str) -> Value {
    Value::Ascii(vec![value.as_bytes().to_vec()])
}

fn tags(camera: &Camera, position: &Geodetic, index: usize) -> Option<Vec<u8>> {
    let side =
        |value: f64, positive: &str, negative: &str| text(if value < 0.0 { negative } else { positive });
    let focal_35mm = 36.0 * camera.mean_focal_px() / f64::from(camera.width_px.max(camera.height_px));
    let sensor_width_mm = 13.2;
    let focal_mm = sensor_width_mm * camera.mean_focal_px() / f64::from(camera.width_px);
    let time = format!("2026:06:01 12:{:02}:{:02}", index / 30 % 60, index % 30 * 2);
    let values = [
        (Tag::Make, text("terrane")),
        (Tag::Model, text("town demo")),
        (Tag::DateTimeOriginal, text(&time)),
        (Tag::FocalLength, Value::Rational(vec![rational(focal_mm, 1000)])),
        (Tag::FocalLengthIn35mmFilm, Value::Short(vec![focal_35mm.round() as u16])),
        (Tag::GPSLatitudeRef, side(position.latitude_rad, "N", "S")),
        (Tag::GPSLatitude, degrees(position.latitude_rad)),
        (Tag::GPSLongitudeRef, side(position.longitude_rad, "E", "W")),
        (Tag::GPSLongitude, degrees(position.longitude_rad)),
        (Tag::GPSAltitudeRef, Value::Byte(vec![u8::from(position.height_m < 0.0)])),
        (Tag::GPSAltitude, Value::Rational(vec![rational(position.height_m.abs(), 1000)])),
    ];
    let fields = values.map(|(tag, value)| Field { tag, ifd_num: In::PRIMARY, value });
    let mut writer = Writer::new();
    for field in &fields {
        writer.push_field(field);
    }
    let mut tiff = std::io::Cursor::new(Vec::new());
    writer.write(&mut tiff, false).ok()?;
    Some([b"Exif\0\0".as_slice(), tiff.get_ref()].concat())
}
