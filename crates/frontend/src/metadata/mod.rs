//! What a file says of its photograph: size, camera, lens, focal length, position, attitude, time.
//!
//! EXIF is a hint, never a condition: a file with broken metadata is used without them, and a note says so.

mod container;
mod gps;
#[cfg(test)]
mod tests;
mod xmp;
#[cfg(test)]
mod xmp_tests;

use exif::{Error, Exif, Field, In, Reader, Tag, Value};
use serde::{Deserialize, Serialize};
use terrane_scene::{FlightPrior, GpsPrior, Orientation};

use crate::{FrontendError, image};

/// What is known of a photograph before its pixels are decoded.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ImageMetadata {
    /// Columns of the file's pixel grid.
    pub width_px: u32,
    /// Rows of the file's pixel grid.
    pub height_px: u32,
    /// How the camera was held.
    pub orientation: Orientation,
    /// Maker of the camera.
    pub make: Option<String>,
    /// Model of the camera.
    pub model: Option<String>,
    /// Model of the lens.
    pub lens: Option<String>,
    /// Serial number of the camera's body.
    pub serial: Option<String>,
    /// Focal length of the lens in millimetres.
    pub focal_mm: Option<f64>,
    /// Focal length of a 35 mm film camera with the same angle of view across the diagonal, in millimetres.
    pub focal_35mm: Option<f64>,
    /// Pixels of this file per millimetre of the sensor, in x.
    pub focal_plane_px_per_mm: Option<f64>,
    /// Position from a satellite receiver.
    pub gps: Option<GpsPrior>,
    /// Height above ground and attitude, from XMP.
    pub flight: Option<FlightPrior>,
    /// Time of exposure in seconds since 1970 of the camera's own clock and zone: for order only.
    pub captured_s: Option<f64>,
    /// What of the metadata was broken or implausible and was left out.
    pub notes: Vec<String>,
}

/// Reads the metadata of a photograph.
///
/// # Errors
/// When the bytes are no image that can be read, or a truncated one (as [`image::probe`]). Broken metadata are no error.
pub fn read(bytes: &[u8]) -> Result<ImageMetadata, FrontendError> {
    let probe = image::probe(bytes)?;
    let mut metadata =
        ImageMetadata { width_px: probe.width, height_px: probe.height, ..ImageMetadata::default() };
    let packet = xmp::Packet::find(bytes);
    metadata.flight = packet.flight();
    if let Some(exif) = read_exif(bytes, probe.format, &mut metadata.notes) {
        fill_camera(&exif, &mut metadata);
        fill_focal_plane(&exif, &mut metadata);
        metadata.captured_s = captured_s(&exif);
        metadata.gps = gps::read(&exif, &packet, &mut metadata.notes);
    }
    Ok(metadata)
}

fn read_exif(bytes: &[u8], format: image::Format, notes: &mut Vec<String>) -> Option<Exif> {
    let block = container::exif_block(bytes, format)?;
    // A third party's reader on bytes from outside: a panic in it is a broken file.
    let result = std::panic::catch_unwind(|| Reader::new().continue_on_error(true).read_raw(block));
    let Ok(result) = result else {
        notes.push("exif can't be parsed and was ignored".to_owned());
        return None;
    };
    let result = result.or_else(|error| {
        error.distill_partial_result(|errors| {
            notes.extend(errors.first().map(|first| format!("exif is broken in part ({first})")));
        })
    });
    match result {
        Ok(exif) => Some(exif),
        Err(Error::NotFound(_)) => None,
        Err(error) => {
            notes.push(format!("exif is broken and was ignored ({error})"));
            None
        }
    }
}

fn fill_camera(exif: &Exif, metadata: &mut ImageMetadata) {
    if let Some(value @ 1..=8) = field(exif, Tag::Orientation).and_then(|f| f.value.get_uint(0)) {
        metadata.orientation = Orientation(value as u8);
    }
    metadata.make = text(exif, Tag::Make);
    metadata.model = text(exif, Tag::Model);
    metadata.lens = text(exif, Tag::LensModel);
    metadata.serial = text(exif, Tag::BodySerialNumber);
    metadata.focal_mm = number(exif, Tag::FocalLength).filter(|f| (0.1..=10_000.0).contains(f));
    metadata.focal_35mm = number(exif, Tag::FocalLengthIn35mmFilm).filter(|f| (1.0..=10_000.0).contains(f));
}

/// Focal-plane resolution refers to the picture as the camera stored it: a file that was scaled afterwards without
/// correcting its tags is recognised by the pixel size that EXIF states.
fn fill_focal_plane(exif: &Exif, metadata: &mut ImageMetadata) {
    let Some(resolution) = number(exif, Tag::FocalPlaneXResolution).filter(|r| *r > 0.0) else { return };
    let unit = field(exif, Tag::FocalPlaneResolutionUnit).and_then(|f| f.value.get_uint(0)).unwrap_or(2);
    let Some(mm_per_unit) = mm_per_resolution_unit(unit) else {
        metadata
            .notes
            .push(format!("exif states the focal-plane resolution in unit {unit}, which does not exist"));
        return;
    };
    let stated_width = field(exif, Tag::PixelXDimension).and_then(|f| f.value.get_uint(0)).filter(|&w| w > 0);
    let scale = stated_width.map_or(1.0, |stated| f64::from(metadata.width_px) / f64::from(stated));
    let px_per_mm = resolution / mm_per_unit * scale;
    let sensor_width_mm = f64::from(metadata.width_px) / px_per_mm;
    if (1.0..=120.0).contains(&sensor_width_mm) {
        metadata.focal_plane_px_per_mm = Some(px_per_mm);
    } else {
        let note = format!(
            "exif's focal-plane resolution means a sensor {sensor_width_mm:.2} mm wide and was ignored"
        );
        metadata.notes.push(note);
    }
}

/// Exif 2.32, FocalPlaneResolutionUnit: inch and centimetre; millimetre and micrometre are in use beyond it.
fn mm_per_resolution_unit(unit: u32) -> Option<f64> {
    match unit {
        1 | 2 => Some(25.4),
        3 => Some(10.0),
        4 => Some(1.0),
        5 => Some(0.001),
        _ => None,
    }
}

/// Seconds since 1970 as if the camera's clock ran in UTC.
fn captured_s(exif: &Exif) -> Option<f64> {
    let (date, fraction) = match text(exif, Tag::DateTimeOriginal) {
        Some(date) => (date, text(exif, Tag::SubSecTimeOriginal)),
        None => (text(exif, Tag::DateTime)?, text(exif, Tag::SubSecTime)),
    };
    let parts: Vec<i64> =
        date.split([':', ' ', '-', 'T']).take(6).filter_map(|p| p.trim().parse().ok()).collect();
    let &[year, month @ 1..=12, day @ 1..=31, hour @ 0..=24, minute @ 0..=60, second @ 0..=61] =
        parts.as_slice()
    else {
        return None;
    };
    if !(1900..=2200).contains(&year) {
        return None;
    }
    let digits: String =
        fraction.unwrap_or_default().chars().take_while(char::is_ascii_digit).take(9).collect();
    let fraction = format!("0.{digits}0").parse::<f64>().unwrap_or(0.0);
    let days = days_since_1970(year, month, day);
    Some((((days * 24 + hour) * 60 + minute) * 60 + second) as f64 + fraction)
}

/// Days of the proleptic Gregorian calendar, counted in years that start in March (Hinnant 2013).
fn days_since_1970(year: i64, month: i64, day: i64) -> i64 {
    let year = if month <= 2 { year - 1 } else { year };
    let day_of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    year * 365 + year.div_euclid(4) - year.div_euclid(100) + year.div_euclid(400) + day_of_year - 719_468
}

fn field(exif: &Exif, tag: Tag) -> Option<&Field> {
    exif.get_field(tag, In::PRIMARY)
}

fn text(exif: &Exif, tag: Tag) -> Option<String> {
    let Value::Ascii(parts) = &field(exif, tag)?.value else { return None };
    let text = String::from_utf8_lossy(parts.first()?);
    let text = text.trim_matches(|c: char| c.is_whitespace() || c == '\0');
    (!text.is_empty()).then(|| text.to_owned())
}

/// The first value of a tag as a finite number; x/0 is none.
fn number(exif: &Exif, tag: Tag) -> Option<f64> {
    number_at(&field(exif, tag)?.value, 0)
}

fn number_at(value: &Value, index: usize) -> Option<f64> {
    let number = match value {
        Value::Rational(v) => v.get(index)?.to_f64(),
        Value::SRational(v) => v.get(index)?.to_f64(),
        Value::Float(v) => f64::from(*v.get(index)?),
        Value::Double(v) => *v.get(index)?,
        other => f64::from(other.get_uint(index)?),
    };
    number.is_finite().then_some(number)
}
