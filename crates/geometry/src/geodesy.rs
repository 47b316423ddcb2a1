//! WGS84 geodetic, earth-centred (ECEF) and local east-north-up (ENU) coordinates.
//!
//! Heights are above the ellipsoid. Forward formulae are exact; the inverse iterates Bowring's (1976) relation of the
//! reduced latitude to convergence, which within 10,000 km of the surface is below a nanometre. Valid everywhere but within
//! about 50 km of the earth's centre.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

/// Semi-major axis of WGS84 in metres.
pub const WGS84_SEMI_MAJOR_M: f64 = 6_378_137.0;
/// Flattening of WGS84.
pub const WGS84_FLATTENING: f64 = 1.0 / 298.257_223_563;
const ECCENTRICITY_SQUARED: f64 = WGS84_FLATTENING * (2.0 - WGS84_FLATTENING);

/// A position on WGS84.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Geodetic {
    /// Latitude in radians, north positive, within ±π/2.
    pub latitude_rad: f64,
    /// Longitude in radians, east positive, within ±π.
    pub longitude_rad: f64,
    /// Height above the ellipsoid in metres.
    pub height_m: f64,
}

impl Geodetic {
    /// From degrees and metres, as EXIF and people have them.
    pub fn from_degrees(latitude_deg: f64, longitude_deg: f64, height_m: f64) -> Self {
        Self { latitude_rad: latitude_deg.to_radians(), longitude_rad: longitude_deg.to_radians(), height_m }
    }

    /// Latitude in degrees.
    pub fn latitude_deg(&self) -> f64 {
        self.latitude_rad.to_degrees()
    }

    /// Longitude in degrees.
    pub fn longitude_deg(&self) -> f64 {
        self.longitude_rad.to_degrees()
    }
}

/// Earth-centred, earth-fixed coordinates in metres.
pub fn ecef_from_geodetic(position: &Geodetic) -> Vector3<f64> {
    let (sin_lat, cos_lat) = position.latitude_rad.sin_cos();
    let (sin_lon, cos_lon) = position.longitude_rad.sin_cos();
    let prime_vertical_m = WGS84_SEMI_MAJOR_M / (1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat).sqrt();
    let from_axis_m = (prime_vertical_m + position.height_m) * cos_lat;
    let z = (prime_vertical_m * (1.0 - ECCENTRICITY_SQUARED) + position.height_m) * sin_lat;
    Vector3::new(from_axis_m * cos_lon, from_axis_m * sin_lon, z)
}

/// The geodetic position of earth-centred coordinates in metres; on the axis the longitude is zero.
pub fn geodetic_from_ecef(x_in_ecef: &Vector3<f64>) -> Geodetic {
    const MAX_ITERATIONS: usize = 20;
    let semi_minor_m = WGS84_SEMI_MAJOR_M * (1.0 - WGS84_FLATTENING);
    let second_eccentricity_squared = ECCENTRICITY_SQUARED / (1.0 - ECCENTRICITY_SQUARED);
    let from_axis_m = x_in_ecef.x.hypot(x_in_ecef.y);
    let z = x_in_ecef.z;
    // Angles as (sine, cosine) directions throughout: exact at the poles, where tangents are not.
    let mut reduced = (z * WGS84_SEMI_MAJOR_M).atan2(from_axis_m * semi_minor_m);
    let mut latitude_rad = reduced;
    for _ in 0..MAX_ITERATIONS {
        let (sin, cos) = reduced.sin_cos();
        let next = (z + second_eccentricity_squared * semi_minor_m * sin.powi(3))
            .atan2(from_axis_m - ECCENTRICITY_SQUARED * WGS84_SEMI_MAJOR_M * cos.powi(3));
        let change = (next - latitude_rad).abs();
        latitude_rad = next;
        reduced = ((1.0 - WGS84_FLATTENING) * next.sin()).atan2(next.cos());
        if change < 1e-16 {
            break;
        }
    }
    let (sin_lat, cos_lat) = latitude_rad.sin_cos();
    let surface_m = WGS84_SEMI_MAJOR_M * (1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat).sqrt();
    let height_m = from_axis_m * cos_lat + z * sin_lat - surface_m;
    Geodetic { latitude_rad, longitude_rad: x_in_ecef.y.atan2(x_in_ecef.x), height_m }
}

/// A local frame, east-north-up in metres, tangent to the ellipsoid's parallel surface at its origin.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "Geodetic", into = "Geodetic")]
pub struct EnuFrame {
    origin: Geodetic,
    origin_in_ecef: Vector3<f64>,
    enu_from_ecef_rotation: Matrix3<f64>,
}

impl From<Geodetic> for EnuFrame {
    fn from(origin: Geodetic) -> Self {
        Self::new(origin)
    }
}

impl From<EnuFrame> for Geodetic {
    fn from(frame: EnuFrame) -> Self {
        frame.origin
    }
}

impl EnuFrame {
    /// The frame at an origin.
    pub fn new(origin: Geodetic) -> Self {
        let (sin_lat, cos_lat) = origin.latitude_rad.sin_cos();
        let (sin_lon, cos_lon) = origin.longitude_rad.sin_cos();
        let enu_from_ecef_rotation = Matrix3::new(
            -sin_lon,
            cos_lon,
            0.0,
            -sin_lat * cos_lon,
            -sin_lat * sin_lon,
            cos_lat,
            cos_lat * cos_lon,
            cos_lat * sin_lon,
            sin_lat,
        );
        Self { origin, origin_in_ecef: ecef_from_geodetic(&origin), enu_from_ecef_rotation }
    }

    /// Where (0, 0, 0) is.
    pub fn origin(&self) -> Geodetic {
        self.origin
    }

    /// ENU in metres of earth-centred coordinates.
    pub fn enu_from_ecef(&self, x_in_ecef: &Vector3<f64>) -> Vector3<f64> {
        self.enu_from_ecef_rotation * (x_in_ecef - self.origin_in_ecef)
    }

    /// Earth-centred coordinates of ENU in metres.
    pub fn ecef_from_enu(&self, x_in_enu: &Vector3<f64>) -> Vector3<f64> {
        self.enu_from_ecef_rotation.transpose() * x_in_enu + self.origin_in_ecef
    }

    /// ENU in metres of a geodetic position.
    pub fn enu_from_geodetic(&self, position: &Geodetic) -> Vector3<f64> {
        self.enu_from_ecef(&ecef_from_geodetic(position))
    }

    /// The geodetic position of ENU in metres.
    pub fn geodetic_from_enu(&self, x_in_enu: &Vector3<f64>) -> Geodetic {
        geodetic_from_ecef(&self.ecef_from_enu(x_in_enu))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::Random;

    #[test]
    fn known_positions_agree_to_below_a_millimetre() {
        // Closed cases of the ellipsoid, and the numerical example of NGA's and PROJ's documentation.
        let polar_m = 6_356_752.314_245_179;
        let cases = [
            (Geodetic::from_degrees(0.0, 0.0, 0.0), Vector3::new(6_378_137.0, 0.0, 0.0)),
            (Geodetic::from_degrees(0.0, 90.0, 100.0), Vector3::new(0.0, 6_378_237.0, 0.0)),
            (Geodetic::from_degrees(90.0, 0.0, 0.0), Vector3::new(0.0, 0.0, polar_m)),
            (Geodetic::from_degrees(-90.0, 0.0, 50.0), Vector3::new(0.0, 0.0, -polar_m - 50.0)),
            (Geodetic::from_degrees(0.0, 180.0, 0.0), Vector3::new(-6_378_137.0, 0.0, 0.0)),
        ];
        for (geodetic, x_in_ecef) in cases {
            assert!((ecef_from_geodetic(&geodetic) - x_in_ecef).norm() < 1e-6, "{geodetic:?}");
            let back = ecef_from_geodetic(&geodetic_from_ecef(&x_in_ecef));
            assert!((back - x_in_ecef).norm() < 1e-6, "{geodetic:?}");
        }
    }

    #[test]
    fn latitude_45_matches_the_formula_by_hand() {
        // N = a / sqrt(1 - e²/2), x = N cos 45°, z = N (1 - e²) sin 45°.
        let x = ecef_from_geodetic(&Geodetic::from_degrees(45.0, 0.0, 0.0));
        assert!((x - Vector3::new(4_517_590.878_849, 0.0, 4_487_348.408_866)).norm() < 1e-3, "{x}");
    }

    #[test]
    fn round_trips_are_exact_to_nanometres() {
        let mut random = Random::new("geodesy");
        for _ in 0..2000 {
            let position = Geodetic {
                latitude_rad: random.uniform(-1.0, 1.0) * std::f64::consts::FRAC_PI_2,
                longitude_rad: random.uniform(-1.0, 1.0) * std::f64::consts::PI,
                height_m: random.uniform(-10_000.0, 100_000.0),
            };
            let again = geodetic_from_ecef(&ecef_from_geodetic(&position));
            assert!((again.height_m - position.height_m).abs() < 1e-8);
            assert!((again.latitude_rad - position.latitude_rad).abs() < 1e-15 * 4.0);
            let frame = EnuFrame::new(position);
            let x_in_enu = random.gaussian3(5_000.0);
            let round = frame.enu_from_geodetic(&frame.geodetic_from_enu(&x_in_enu));
            assert!((round - x_in_enu).norm() < 1e-7, "{}", (round - x_in_enu).norm());
        }
    }

    #[test]
    fn enu_axes_point_east_north_and_up() {
        let origin = Geodetic::from_degrees(52.0, 13.0, 30.0);
        let frame = EnuFrame::new(origin);
        assert!(frame.enu_from_geodetic(&origin).norm() < 1e-9);
        let up = frame.enu_from_geodetic(&Geodetic { height_m: 31.0, ..origin });
        assert!((up - Vector3::z()).norm() < 1e-8);
        let north = frame.enu_from_geodetic(&Geodetic { latitude_rad: origin.latitude_rad + 1e-6, ..origin });
        assert!(north.y > 6.3 && north.y < 6.4 && north.x.abs() < 1e-8 && north.z.abs() < 1e-4);
        let east =
            frame.enu_from_geodetic(&Geodetic { longitude_rad: origin.longitude_rad + 1e-6, ..origin });
        assert!(east.x > 3.9 && east.x < 4.0 && east.y.abs() < 1e-4);
    }

    #[test]
    fn the_frame_is_stored_as_its_origin() {
        let frame = EnuFrame::new(Geodetic::from_degrees(-33.9, 18.4, 12.0));
        assert_eq!(EnuFrame::from(Geodetic::from(frame)), frame);
    }

    #[test]
    fn nothing_panics_on_absurd_input() {
        for x in [f64::NAN, f64::INFINITY, 0.0, -1e300] {
            geodetic_from_ecef(&Vector3::new(x, 0.0, x));
            ecef_from_geodetic(&Geodetic { latitude_rad: x, longitude_rad: x, height_m: x });
        }
    }
}
