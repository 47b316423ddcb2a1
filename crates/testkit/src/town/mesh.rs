//! The town's surfaces as triangles in east, north, up.

use nalgebra::Vector3;
use terrane_geometry::Seed;

use super::texture::{BLOCK_M, HALF_STREET_M, Material, Texture};
use crate::scene::uniform;

/// How far the town goes on beyond the flight lines, in metres.
const MARGIN_M: f64 = 75.0;
/// Size of a cell of the terrain in metres.
const CELL_M: f64 = 4.0;

/// A corner: place, and where it lies on the texture in metres.
#[derive(Clone, Copy)]
pub(super) struct Corner {
    pub x_in_enu: Vector3<f64>,
    pub uv_m: [f64; 2],
}

/// A triangle with its texture and the share of the sun's light that it sends back.
pub(super) struct Triangle {
    pub corners: [Corner; 3],
    pub texture: usize,
    pub light: f32,
}

/// All surfaces.
pub(super) struct Mesh {
    pub triangles: Vec<Triangle>,
    pub textures: Vec<Texture>,
    texels_per_m: f64,
}

/// Height of the terrain in metres.
fn terrain_height_m(x: f64, y: f64) -> f64 {
    4.0 * (x / 55.0).sin() * (y / 70.0 + 0.4).cos() + 2.0 * (x / 23.0 + y / 31.0).sin()
}

fn light(normal: &Vector3<f64>) -> f32 {
    let sun = Vector3::new(0.4, -0.5, 0.77).normalize();
    (0.5 + 0.5 * normal.dot(&sun).max(0.0)) as f32
}

impl Mesh {
    /// Terrain under the flight lines, which cover `extent_m` from the origin, with a house in most blocks' corners.
    pub fn town(extent_m: &Vector3<f64>, texels_per_m: f64, seed: Seed) -> Self {
        let mut mesh = Self { triangles: Vec::new(), textures: Vec::new(), texels_per_m };
        let low = [-MARGIN_M, -MARGIN_M];
        let size = [extent_m.x + 2.0 * MARGIN_M, extent_m.y + 2.0 * MARGIN_M];
        mesh.terrain(low, size, seed.derive("ground"));
        let rng = &mut seed.derive("houses").rng();
        // A block's streets run through multiples of its size plus a half; its middle is a multiple.
        let blocks =
            |low: f64, size: f64| (low / BLOCK_M).ceil() as i64..=((low + size) / BLOCK_M).floor() as i64;
        for row in blocks(low[1], size[1]) {
            for column in blocks(low[0], size[0]) {
                for quarter in 0..4u64 {
                    let free = BLOCK_M / 2.0 - HALF_STREET_M;
                    let sign = |bit: u64| if quarter & bit == 0 { -1.0 } else { 1.0 };
                    let offset = |rng: &mut _| free * uniform(rng, 0.42, 0.56);
                    let center = [
                        column as f64 * BLOCK_M + sign(1) * offset(rng),
                        row as f64 * BLOCK_M + sign(2) * offset(rng),
                    ];
                    let house = House {
                        center,
                        half: [uniform(rng, 3.5, 6.0), uniform(rng, 3.5, 5.5)],
                        eaves_m: uniform(rng, 3.5, 11.0),
                        ridge_m: uniform(rng, 0.0, 3.5),
                        turn_rad: uniform(rng, -0.2, 0.2),
                    };
                    let stands = uniform(rng, 0.0, 1.0) < 0.85;
                    if stands
                        && (0..2).all(|a| center[a] > low[a] + 9.0 && center[a] < low[a] + size[a] - 9.0)
                    {
                        let item = [(row + 1000) as u64, (column + 1000) as u64, quarter];
                        mesh.house(&house, seed.derive("house").item(&item));
                    }
                }
            }
        }
        mesh
    }

    fn terrain(&mut self, low: [f64; 2], size: [f64; 2], seed: Seed) {
        let texture = self.textures.len();
        self.textures.push(Texture::paint(Material::Ground, low, size, self.texels_per_m, seed));
        let cells = size.map(|length| (length / CELL_M).ceil() as usize);
        let corner = |i: usize, j: usize| {
            let uv_m = [(i as f64 * CELL_M).min(size[0]), (j as f64 * CELL_M).min(size[1])];
            let (x, y) = (low[0] + uv_m[0], low[1] + uv_m[1]);
            Corner { x_in_enu: Vector3::new(x, y, terrain_height_m(x, y)), uv_m }
        };
        for j in 0..cells[1] {
            for i in 0..cells[0] {
                let square = [corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)];
                self.quad(square, texture);
            }
        }
    }

    fn quad(&mut self, corners: [Corner; 4], texture: usize) {
        let [a, b, c, d] = corners;
        for corners in [[a, b, c], [a, c, d]] {
            let edge = |k: usize| corners[k].x_in_enu - corners[0].x_in_enu;
            let normal = edge(1).cross(&edge(2));
            if normal.norm() > 1e-9 {
                self.triangles.push(Triangle { corners, texture, light: light(&normal.normalize()) });
            }
        }
    }

    /// A wall or roof: the corners in order, the first edge along u.
    fn face(&mut self, points: [Vector3<f64>; 4], material: Material, seed: Seed) {
        let along = (points[1] - points[0]).normalize();
        let normal = along.cross(&(points[3] - points[0])).normalize();
        let across = normal.cross(&along);
        let uv: [[f64; 2]; 4] = points.map(|p| [(p - points[0]).dot(&along), (p - points[0]).dot(&across)]);
        let low = [0, 1].map(|axis| uv.iter().map(|p| p[axis]).fold(f64::INFINITY, f64::min));
        let size = [0, 1].map(|axis| uv.iter().map(|p| p[axis] - low[axis]).fold(0.2, f64::max));
        let texture = self.textures.len();
        self.textures.push(Texture::paint(material, [0.0, 0.0], size, 1.2 * self.texels_per_m, seed));
        let corner = |k: usize| Corner { x_in_enu: points[k], uv_m: [uv[k][0] - low[0], uv[k][1] - low[1]] };
        self.quad([corner(0), corner(1), corner(2), corner(3)], texture);
    }

    fn house(&mut self, house: &House, seed: Seed) {
        let [a, b, c, d] = house.footprint();
        let [ridge_a, ridge_b] = [[-1.0, 0.0], [1.0, 0.0]].map(|end| house.place(end));
        let ground = terrain_height_m(house.center[0], house.center[1]);
        let up = |p: [f64; 2], height: f64| Vector3::new(p[0], p[1], ground + height);
        let eaves = house.eaves_m;
        for (side, [from, to]) in [[a, b], [b, c], [c, d], [d, a]].into_iter().enumerate() {
            let wall = [up(from, -3.0), up(to, -3.0), up(to, eaves), up(from, eaves)];
            self.face(wall, Material::Wall, seed.item(&[side as u64]));
        }
        let ridge = eaves + house.ridge_m;
        let slopes = [
            [up(a, eaves), up(b, eaves), up(ridge_b, ridge), up(ridge_a, ridge)],
            [up(c, eaves), up(d, eaves), up(ridge_a, ridge), up(ridge_b, ridge)],
        ];
        for (side, slope) in slopes.into_iter().enumerate() {
            self.face(slope, Material::Roof, seed.item(&[10 + side as u64]));
        }
        if house.ridge_m > 0.1 {
            for (side, [from, to, top]) in [[b, c, ridge_b], [d, a, ridge_a]].into_iter().enumerate() {
                let gable = [up(from, eaves), up(to, eaves), up(top, ridge), up(top, ridge)];
                self.face(gable, Material::Wall, seed.item(&[20 + side as u64]));
            }
        }
    }
}

/// A house with a gabled roof.
struct House {
    center: [f64; 2],
    half: [f64; 2],
    eaves_m: f64,
    ridge_m: f64,
    turn_rad: f64,
}

impl House {
    /// A place of the footprint, whose corners are (±1, ±1).
    fn place(&self, at: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = self.turn_rad.sin_cos();
        let (x, y) = (at[0] * self.half[0], at[1] * self.half[1]);
        [self.center[0] + cos * x - sin * y, self.center[1] + sin * x + cos * y]
    }

    /// The corners, counter-clockwise from south-west.
    fn footprint(&self) -> [[f64; 2]; 4] {
        [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(|corner| self.place(corner))
    }
}
