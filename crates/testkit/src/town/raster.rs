//! A photograph from triangles: z-buffer with perspective-correct textures, then the lens, then the sensor.

use nalgebra::{Vector2, Vector3};
use terrane_geometry::{Camera, CameraModel, Rigid3, Seed};

use super::mesh::{Mesh, Triangle};
use crate::scene::normal;

/// Triangles nearer than this to the camera's plane are left out; cameras fly far above everything.
const NEAREST_M: f64 = 1.0;
/// The lens bends lines by less than this share of the image, so the ideal image is that much larger on each side.
const BORDER: f64 = 0.06;

/// Rows of red, green, blue.
pub(super) struct Pixels {
    pub width: usize,
    pub height: usize,
    pub rgb: Vec<u8>,
}

/// A quantity that is linear over the image: `a x + b y + c`.
#[derive(Clone, Copy)]
struct Plane {
    a: f64,
    b: f64,
    c: f64,
}

impl Plane {
    fn through(xy: &[Vector2<f64>; 3], values: [f64; 3], twice_area: f64) -> Self {
        let (d1, d2) = (values[1] - values[0], values[2] - values[0]);
        let (e1, e2) = (xy[1] - xy[0], xy[2] - xy[0]);
        let a = (d1 * e2.y - d2 * e1.y) / twice_area;
        let b = (d2 * e1.x - d1 * e2.x) / twice_area;
        Self { a, b, c: values[0] - a * xy[0].x - b * xy[0].y }
    }

    fn at(&self, x: f64, y: f64) -> f64 {
        self.a * x + self.b * y + self.c
    }
}

/// The ideal image: colours and inverse depths.
struct Canvas {
    width: usize,
    height: usize,
    inverse_depth: Vec<f32>,
    rgb: Vec<[f32; 3]>,
}

/// Takes a photograph through the camera's lens, with noise of the sensor.
pub(super) fn render(
    mesh: &Mesh,
    camera: &Camera,
    cam_from_enu: &Rigid3,
    noise_levels: f64,
    seed: Seed,
) -> Pixels {
    let border = |size: u32| (f64::from(size) * BORDER).ceil();
    let (border_x, border_y) = (border(camera.width_px), border(camera.height_px));
    let width = camera.width_px as usize + 2 * border_x as usize;
    let height = camera.height_px as usize + 2 * border_y as usize;
    let focal = camera.focal_px();
    let center = camera.principal_point_px() + Vector2::new(border_x, border_y);
    let params = [focal.x, focal.y, center.x, center.y];
    let ideal = Camera::new(CameraModel::Pinhole, width as u32, height as u32, &params)
        .unwrap_or_else(|| Camera::centered(CameraModel::Pinhole, width as u32, height as u32, focal.x));
    let mut canvas = Canvas {
        width,
        height,
        inverse_depth: vec![0.0; width * height],
        rgb: vec![[128.0; 3]; width * height],
    };
    for triangle in &mesh.triangles {
        draw(&mut canvas, mesh, triangle, &ideal, cam_from_enu);
    }
    through_lens(&canvas, camera, &ideal, noise_levels, seed)
}

fn draw(canvas: &mut Canvas, mesh: &Mesh, triangle: &Triangle, ideal: &Camera, cam_from_enu: &Rigid3) {
    let in_cam = triangle.corners.map(|corner| cam_from_enu.transform_point(&corner.x_in_enu));
    if in_cam.iter().any(|x: &Vector3<f64>| x.z < NEAREST_M) {
        return;
    }
    let Some(xy) = project_all(ideal, &in_cam) else { return };
    let (e1, e2) = (xy[1] - xy[0], xy[2] - xy[0]);
    let twice_area = e1.x * e2.y - e2.x * e1.y;
    if twice_area.abs() < 1e-9 {
        return;
    }
    let range = |values: [f64; 3], size: usize| {
        let low = values.iter().copied().fold(f64::INFINITY, f64::min).floor().max(0.0) as usize;
        let high =
            values.iter().copied().fold(f64::NEG_INFINITY, f64::max).ceil().clamp(0.0, size as f64) as usize;
        low..high
    };
    let columns = range(xy.map(|p| p.x), canvas.width);
    let rows = range(xy.map(|p| p.y), canvas.height);
    let weights = in_cam.map(|x| 1.0 / x.z);
    let plane = |values: [f64; 3]| Plane::through(&xy, values, twice_area);
    let barycentric = [plane([1.0, 0.0, 0.0]), plane([0.0, 1.0, 0.0]), plane([0.0, 0.0, 1.0])];
    let w_plane = plane(weights);
    let scaled = |axis: usize| plane(std::array::from_fn(|k| triangle.corners[k].uv_m[axis] * weights[k]));
    let (u_plane, v_plane) = (scaled(0), scaled(1));
    let texture = &mesh.textures[triangle.texture];
    for row in rows {
        let y = row as f64 + 0.5;
        for column in columns.clone() {
            let x = column as f64 + 0.5;
            if barycentric.iter().any(|plane| plane.at(x, y) < -1e-9) {
                continue;
            }
            let w = w_plane.at(x, y);
            let at = row * canvas.width + column;
            if w as f32 <= canvas.inverse_depth[at] {
                continue;
            }
            canvas.inverse_depth[at] = w as f32;
            let (u, v) = (u_plane.at(x, y) / w, v_plane.at(x, y) / w);
            let along_x = ((u_plane.a - u * w_plane.a) / w).hypot((v_plane.a - v * w_plane.a) / w);
            let along_y = ((u_plane.b - u * w_plane.b) / w).hypot((v_plane.b - v * w_plane.b) / w);
            canvas.rgb[at] =
                texture.sample(u, v, along_x.max(along_y)).map(|channel| channel * triangle.light);
        }
    }
}

fn project_all(ideal: &Camera, in_cam: &[Vector3<f64>; 3]) -> Option<[Vector2<f64>; 3]> {
    Some([ideal.project(&in_cam[0])?, ideal.project(&in_cam[1])?, ideal.project(&in_cam[2])?])
}

/// Looks up, for every pixel of the real camera, the ideal image where its ray goes.
fn through_lens(canvas: &Canvas, camera: &Camera, ideal: &Camera, noise_levels: f64, seed: Seed) -> Pixels {
    let (width, height) = (camera.width_px as usize, camera.height_px as usize);
    let mut rgb = Vec::with_capacity(width * height * 3);
    let rng = &mut seed.rng();
    for row in 0..height {
        for column in 0..width {
            let xy_px = Vector2::new(column as f64 + 0.5, row as f64 + 0.5);
            let normalized = camera.unproject(&xy_px).unwrap_or_default();
            let color = canvas.bilinear(&ideal.pixel_from_normalized(&normalized));
            let noise = (noise_levels * normal(rng)) as f32;
            rgb.extend(color.map(|channel| (channel + noise).round().clamp(0.0, 255.0) as u8));
        }
    }
    Pixels { width, height, rgb }
}

impl Canvas {
    fn bilinear(&self, xy_px: &Vector2<f64>) -> [f32; 3] {
        let x = (xy_px.x - 0.5).clamp(0.0, (self.width - 2) as f64);
        let y = (xy_px.y - 0.5).clamp(0.0, (self.height - 2) as f64);
        let (i, j) = (x as usize, y as usize);
        let (fx, fy) = ((x - i as f64) as f32, (y - j as f64) as f32);
        let at = j * self.width + i;
        let (a, b) = (self.rgb[at], self.rgb[at + 1]);
        let (c, d) = (self.rgb[at + self.width], self.rgb[at + self.width + 1]);
        std::array::from_fn(|k| {
            let top = a[k] + fx * (b[k] - a[k]);
            top + fy * (c[k] + fx * (d[k] - c[k]) - top)
        })
    }
}
