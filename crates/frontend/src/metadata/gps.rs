//! Positions from EXIF, with how far they can be trusted.

use exif::{Exif, In, Tag, Value};
use terrane_scene::GpsPrior;

use super::xmp::Packet;
use super::{field, number, number_at, text};

/// Standard deviations in metres, horizontal per axis and vertical, of a consumer receiver's fix when the file gives
/// none: about what phones and drones without corrections reach under an open sky.
pub const DEFAULT_SIGMA_M: (f64, f64) = (5.0, 10.0);

/// Metres of horizontal error per unit of dilution of precision: the user-equivalent range error of a civil
/// single-frequency receiver.
const RANGE_ERROR_M: f64 = 3.0;

pub(super) fn read(exif: &Exif, packet: &Packet, notes: &mut Vec<String>) -> Option<GpsPrior> {
    let latitude = &field(exif, Tag::GPSLatitude)?.value;
    let longitude = &field(exif, Tag::GPSLongitude)?.value;
    if text(exif, Tag::GPSStatus).is_some_and(|status| status.starts_with(['V', 'v'])) {
        notes.push("exif states that the gps position is void; it was ignored".to_owned());
        return None;
    }
    let latitude = degrees(latitude).map(|v| signed(v, text(exif, Tag::GPSLatitudeRef), 'S'));
    let longitude = degrees(longitude).map(|v| signed(v, text(exif, Tag::GPSLongitudeRef), 'W'));
    let (Some(latitude_deg @ -90.0..=90.0), Some(longitude_deg @ -180.0..=180.0)) = (latitude, longitude)
    else {
        notes.push("exif's gps position is not a latitude and longitude; it was ignored".to_owned());
        return None;
    };
    if latitude_deg == 0.0 && longitude_deg == 0.0 {
        notes.push("exif's gps position is 0, 0 (no fix); it was ignored".to_owned());
        return None;
    }
    let (sigma_horizontal_m, sigma_vertical_m) = sigmas_m(exif, packet);
    let altitude_m = altitude_m(exif);
    Some(GpsPrior { latitude_deg, longitude_deg, altitude_m, sigma_horizontal_m, sigma_vertical_m })
}

/// Degrees from degrees, minutes and seconds, of which the latter two may be missing or 0/0.
fn degrees(value: &Value) -> Option<f64> {
    let part = |index| number_at(value, index).unwrap_or(0.0);
    Some(number_at(value, 0)? + part(1) / 60.0 + part(2) / 3600.0)
}

/// Without a reference the number stands as it is: north and east, or already signed.
fn signed(value: f64, reference: Option<String>, negative: char) -> f64 {
    match reference {
        Some(reference) if reference.to_ascii_uppercase().starts_with(negative) => -value.abs(),
        _ => value,
    }
}

fn altitude_m(exif: &Exif) -> Option<f64> {
    let altitude = number(exif, Tag::GPSAltitude).filter(|a| (-12_000.0..=100_000.0).contains(a))?;
    let reference = exif.get_field(Tag::GPSAltitudeRef, In::PRIMARY).map(|f| match &f.value {
        Value::Ascii(parts) => {
            parts.first().and_then(|p| p.first()).map_or(0, |b| u32::from(b.wrapping_sub(b'0')))
        }
        value => value.get_uint(0).unwrap_or(0),
    });
    // Exif 3.0: 0 and 2 above, 1 and 3 below the sea or the ellipsoid.
    Some(if matches!(reference, Some(1 | 3)) { -altitude.abs() } else { altitude })
}

/// From the receiver's own standard deviations, its stated error, its dilution of precision, or the default.
fn sigmas_m(exif: &Exif, packet: &Packet) -> (f64, f64) {
    let plausible = |sigma: &f64| (0.001..=1_000.0).contains(sigma);
    let rtk = |axis: &str| packet.number(&format!("drone-dji:RtkStd{axis}")).filter(plausible);
    if let (Some(lat), Some(lon), Some(height)) = (rtk("Lat"), rtk("Lon"), rtk("Hgt")) {
        return (lat.max(lon), height);
    }
    let accuracy = |axes: &str| packet.number(&format!("Camera:GPS{axes}Accuracy")).filter(plausible);
    if let (Some(horizontal), Some(vertical)) = (accuracy("XY"), accuracy("Z")) {
        return (horizontal, vertical);
    }
    if let Some(error) = number(exif, Tag::GPSHPositioningError).filter(plausible) {
        return (error, 2.0 * error);
    }
    if let Some(dilution) = number(exif, Tag::GPSDOP).filter(|d| (0.3..=50.0).contains(d)) {
        return (RANGE_ERROR_M * dilution, 2.0 * RANGE_ERROR_M * dilution);
    }
    DEFAULT_SIGMA_M
}
