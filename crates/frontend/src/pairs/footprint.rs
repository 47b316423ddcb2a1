//! What a photograph sees of flat ground, as a convex polygon, and how much of it two photographs share.

use nalgebra::{Matrix3, Vector3};
use terrane_geometry::Camera;
use terrane_geometry::geodesy::{EnuFrame, Geodetic};
use terrane_scene::{AttitudeOf, AttitudePrior};

/// Rays that fall less than this many metres per metre of depth are cut off: what they reach, some seven flying heights
/// away and beyond, is too small in the image to be matched.
const LEAST_FALL: f64 = 0.15;

/// Without a heading the footprint is a circle, which is only right when the camera looks down: the greatest tilt.
const MAX_TILT_WITHOUT_YAW_RAD: f64 = 0.35;

/// Corners of the polygon that stands for a circle.
const CIRCLE_CORNERS: usize = 8;

/// How a camera was held above the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct View {
    /// Height above the ground, positive.
    pub(super) height_m: f64,
    /// Attitude.
    pub(super) attitude: AttitudePrior,
    /// Whether the pixel grid lies on its side in the upright image (EXIF orientations 5 to 8).
    pub(super) on_its_side: bool,
}

/// Ground that a photograph sees. Points are earth-centred, in metres, on the ellipsoid: heights of the ground itself
/// play no part.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Footprint {
    /// Corners in order around the polygon.
    corners: Vec<Vector3<f64>>,
    /// Mean of the corners.
    pub(super) center: Vector3<f64>,
    /// Direction of the optical axis, of length one.
    pub(super) axis: Vector3<f64>,
}

/// `enu_from_cam`: columns are the camera's axes as east, north, up.
pub(super) fn enu_from_cam(attitude: &AttitudePrior) -> Matrix3<f64> {
    let (yaw_sin, yaw_cos) = attitude.yaw_deg.unwrap_or(0.0).to_radians().sin_cos();
    let (pitch_sin, pitch_cos) = attitude.pitch_deg.to_radians().sin_cos();
    let (roll_sin, roll_cos) = attitude.roll_deg.to_radians().sin_cos();
    let yaw = Matrix3::new(yaw_cos, -yaw_sin, 0.0, yaw_sin, yaw_cos, 0.0, 0.0, 0.0, 1.0);
    let pitch = Matrix3::new(pitch_cos, 0.0, pitch_sin, 0.0, 1.0, 0.0, -pitch_sin, 0.0, pitch_cos);
    let roll = Matrix3::new(1.0, 0.0, 0.0, 0.0, roll_cos, -roll_sin, 0.0, roll_sin, roll_cos);
    // Body axes: ahead, right, down; the frame that they stand in: north, east, down.
    let body_from_cam = match attitude.of {
        AttitudeOf::Gimbal => Matrix3::new(0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0),
        AttitudeOf::Craft => Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0),
    };
    let enu_from_ned = Matrix3::new(0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0);
    enu_from_ned * yaw * pitch * roll * body_from_cam
}

/// Angle between the optical axis and straight down.
pub(super) fn tilt_rad(attitude: &AttitudePrior) -> f64 {
    (-enu_from_cam(attitude)[(2, 2)]).clamp(-1.0, 1.0).acos()
}

impl Footprint {
    /// The footprint of a camera above a place. `None` when it sees no ground near enough, or when its heading is unknown
    /// and it doesn't look down. Lens distortion is left out: it moves corners by a few hundredths.
    pub(super) fn new(latitude_deg: f64, longitude_deg: f64, camera: &Camera, view: &View) -> Option<Self> {
        let frame = EnuFrame::new(Geodetic::from_degrees(latitude_deg, longitude_deg, 0.0));
        let enu_from_cam = enu_from_cam(&view.attitude);
        let falls = match view.attitude.yaw_deg {
            Some(_) => rays(camera, view).map(|ray| enu_from_cam * ray).to_vec(),
            None if tilt_rad(&view.attitude) <= MAX_TILT_WITHOUT_YAW_RAD => circle(camera),
            None => return None,
        };
        let falls = clip(&falls, |ray| -ray.z - LEAST_FALL);
        let corners: Vec<Vector3<f64>> = falls
            .iter()
            .map(|ray| ray * (view.height_m / -ray.z))
            .map(|on_ground| frame.ecef_from_enu(&Vector3::new(on_ground.x, on_ground.y, 0.0)))
            .collect();
        if corners.len() < 3 || !corners.iter().all(|corner| corner.iter().all(|value| value.is_finite())) {
            return None;
        }
        let center = corners.iter().sum::<Vector3<f64>>() / corners.len() as f64;
        let origin = frame.ecef_from_enu(&Vector3::zeros());
        let axis = match view.attitude.yaw_deg {
            Some(_) => frame.ecef_from_enu(&enu_from_cam.column(2).into_owned()) - origin,
            None => frame.ecef_from_enu(&-Vector3::z()) - origin,
        };
        Some(Self { corners, center, axis })
    }

    /// Area in square metres shared with another footprint, and that of both together.
    pub(super) fn overlap_m2(&self, other: &Self) -> (f64, f64) {
        let plane = Plane::at(&self.center);
        let (a, b) = (plane.project(&self.corners), plane.project(&other.corners));
        let shared = area_m2(&intersection(&a, &b));
        (shared, area_m2(&a) + area_m2(&b) - shared)
    }
}

/// Rays through the corners of the image, in the camera's frame, at depth one.
fn rays(camera: &Camera, view: &View) -> [Vector3<f64>; 4] {
    let (focal, principal) = (camera.focal_px(), camera.principal_point_px());
    let (width, height) = (f64::from(camera.width_px), f64::from(camera.height_px));
    [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)].map(|(x, y)| {
        let (x, y) = ((x - principal.x) / focal.x, (y - principal.y) / focal.y);
        if view.on_its_side { Vector3::new(-y, x, 1.0) } else { Vector3::new(x, y, 1.0) }
    })
}

/// Rays around straight down that enclose as much ground as the image does.
fn circle(camera: &Camera) -> Vec<Vector3<f64>> {
    let focal = camera.focal_px();
    let area = f64::from(camera.width_px) / focal.x * f64::from(camera.height_px) / focal.y;
    let step = std::f64::consts::TAU / CIRCLE_CORNERS as f64;
    let radius = (2.0 * area / (CIRCLE_CORNERS as f64 * step.sin())).sqrt();
    let corner = |k: usize| {
        let (sin, cos) = (k as f64 * step).sin_cos();
        Vector3::new(radius * cos, radius * sin, -1.0)
    };
    (0..CIRCLE_CORNERS).map(corner).collect()
}

/// The part of a convex polygon where `inside` is not negative (Sutherland & Hodgman 1974); `inside` must be affine.
fn clip<P>(polygon: &[P], inside: impl Fn(&P) -> f64) -> Vec<P>
where
    P: Copy + std::ops::Sub<Output = P> + std::ops::Add<Output = P> + std::ops::Mul<f64, Output = P>,
{
    let mut kept = Vec::with_capacity(polygon.len() + 1);
    for (at, &corner) in polygon.iter().enumerate() {
        let next = polygon[(at + 1) % polygon.len()];
        let (here, there) = (inside(&corner), inside(&next));
        if here >= 0.0 {
            kept.push(corner);
        }
        if (here >= 0.0) != (there >= 0.0) {
            kept.push(corner + (next - corner) * (here / (here - there)));
        }
    }
    kept
}

type Point = nalgebra::Vector2<f64>;

/// The plane that touches the earth at a point.
struct Plane {
    origin: Vector3<f64>,
    axes: [Vector3<f64>; 2],
}

impl Plane {
    fn at(origin: &Vector3<f64>) -> Self {
        let up = origin.normalize();
        // Any two axes do: areas don't hang on them. The pole and the equator are each far from one choice.
        let helper = if up.z.abs() < 0.7 { Vector3::z() } else { Vector3::x() };
        let east = helper.cross(&up).normalize();
        Self { origin: *origin, axes: [east, up.cross(&east)] }
    }

    fn project(&self, corners: &[Vector3<f64>]) -> Vec<Point> {
        let mut points: Vec<Point> = corners
            .iter()
            .map(|corner| corner - self.origin)
            .map(|x| Point::new(self.axes[0].dot(&x), self.axes[1].dot(&x)))
            .collect();
        if signed_area(&points) < 0.0 {
            points.reverse();
        }
        points
    }
}

/// The common part of two convex polygons that run counter-clockwise.
fn intersection(a: &[Point], b: &[Point]) -> Vec<Point> {
    let mut shared = a.to_vec();
    for (at, &from) in b.iter().enumerate() {
        let edge = b[(at + 1) % b.len()] - from;
        shared = clip(&shared, |p| edge.perp(&(p - from)));
        if shared.len() < 3 {
            return Vec::new();
        }
    }
    shared
}

fn signed_area(points: &[Point]) -> f64 {
    let Some(&first) = points.first() else { return 0.0 };
    // Relative to a corner, so that no digits are lost far from the origin.
    points.windows(2).map(|pair| (pair[0] - first).perp(&(pair[1] - first))).sum::<f64>() / 2.0
}

fn area_m2(points: &[Point]) -> f64 {
    signed_area(points).abs()
}
