//! The reduced camera system as a product: `S x = J_cᵀ (J_c x − J_p V⁻¹ J_pᵀ J_c x)`, without ever forming it.
//!
//! Observations lie by camera in groups of eight. Of each are kept the point in the camera's frame, the derivative of
//! the pixel by that point, and by the refined intrinsics; all other Jacobians follow from these.

use super::blocks::widest;
use super::real::{LANES, Lanes, Real, by_stride, each3, fused, minus, plus, splat, sum, times};

/// The arrays of a linearised part.
#[derive(Default)]
pub(super) struct LaneArrays<T> {
    /// First group of each camera, then their number.
    pub first_group: Vec<u32>,
    /// For each lane its point; lanes without an observation name one past the last, and weigh nothing.
    pub points: Vec<Lanes<u32>>,
    /// `9 + 2 stride` rows a group: the point in the camera's frame (3), the weighted derivative by it (x: 3, y: 3), and
    /// by the intrinsics (x: stride, y: stride).
    pub rows: Vec<Lanes<T>>,
    /// `cam_from_world` rotation of each camera, by rows.
    pub rotations: Vec<[T; 9]>,
    /// `L⁻¹` (lower triangle by rows) of the damped normal equations of each point, and one more of zeros.
    pub inverse: Vec<[T; 6]>,
}

/// Memory of a product.
#[derive(Default)]
pub(super) struct Scratch<T> {
    /// `J_c x` of each lane, x and y.
    image: Vec<[Lanes<T>; 2]>,
    /// `J_pᵀ J_c x`, then `V⁻¹` times that, of each point.
    point: Vec<[T; 4]>,
}

/// Rows of a group.
#[inline(always)]
pub(super) const fn num_rows(stride: usize) -> usize {
    9 + 2 * stride
}

impl<T: Real> Scratch<T> {
    /// `J_pᵀ J_c x` of a point.
    pub fn asked_of(&self, point: usize) -> [f64; 3] {
        let asked = &self.point[point];
        [asked[0].to_f64(), asked[1].to_f64(), asked[2].to_f64()]
    }
}

impl<T: Real> LaneArrays<T> {
    /// `y = S x` over this part; both hold `6 + stride` values for each of its cameras.
    pub fn multiply(&self, stride: usize, x: &[f64], y: &mut [f64], scratch: &mut Scratch<T>) {
        scratch.image.resize(self.points.len(), [splat(T::default()); 2]);
        scratch.point.clear();
        scratch.point.resize(self.inverse.len(), [T::default(); 4]);
        by_stride!(stride, K, WIDTH => widest(#[inline(always)] || self.run::<K>(x, y, scratch)));
    }

    /// Only the first half: `J_pᵀ J_c x` of each point, for [`Scratch::asked_of`].
    pub fn forward_only(&self, stride: usize, x: &[f64], scratch: &mut Scratch<T>) {
        scratch.image.resize(self.points.len(), [splat(T::default()); 2]);
        scratch.point.clear();
        scratch.point.resize(self.inverse.len(), [T::default(); 4]);
        by_stride!(stride, K, WIDTH => widest(#[inline(always)] || {
            for (camera, x) in x.chunks_exact(6 + K).enumerate() {
                self.forward::<K>(camera, x, scratch);
            }
        }));
    }

    #[inline(always)]
    fn run<const K: usize>(&self, x: &[f64], y: &mut [f64], scratch: &mut Scratch<T>) {
        let width = 6 + K;
        for (camera, x) in x.chunks_exact(width).enumerate() {
            self.forward::<K>(camera, x, scratch);
        }
        for (point, inverse) in scratch.point.iter_mut().zip(&self.inverse) {
            *point = solve_point(inverse, point);
        }
        for (camera, y) in y.chunks_exact_mut(width).enumerate() {
            self.backward::<K>(camera, y, scratch);
        }
    }

    /// The rotation of a camera in every lane.
    #[inline(always)]
    pub fn rotation(&self, camera: usize) -> [Lanes<T>; 9] {
        let mut rotation = [splat(T::default()); 9];
        for (lanes, value) in rotation.iter_mut().zip(&self.rotations[camera]) {
            *lanes = splat(*value);
        }
        rotation
    }

    /// `t = J_c x` of a camera's observations, and `J_pᵀ t` added to their points.
    #[inline(always)]
    fn forward<const K: usize>(&self, camera: usize, x: &[f64], scratch: &mut Scratch<T>) {
        let (mut pose, mut intrinsics) = ([splat(T::default()); 6], [splat(T::default()); K]);
        for a in 0..6 {
            pose[a] = splat(T::from_f64(x[a]));
        }
        for a in 0..K {
            intrinsics[a] = splat(T::from_f64(x[6 + a]));
        }
        let rotation = self.rotation(camera);
        for group in self.first_group[camera] as usize..self.first_group[camera + 1] as usize {
            let rows = &self.rows[num_rows(K) * group..num_rows(K) * (group + 1)];
            let moved = motion(&pose, rows);
            let mut image = [dot3(&rows[3..6], &moved), dot3(&rows[6..9], &moved)];
            for a in 0..K {
                image[0] = fused(&rows[9 + a], &intrinsics[a], &image[0]);
                image[1] = fused(&rows[9 + K + a], &intrinsics[a], &image[1]);
            }
            scratch.image[group] = image;
            let in_world = turned_back(&rotation, &force(rows, &image));
            let points = &self.points[group];
            for l in 0..LANES {
                let sum = &mut scratch.point[points[l] as usize];
                *sum = [sum[0] + in_world[0][l], sum[1] + in_world[1][l], sum[2] + in_world[2][l], sum[3]];
            }
        }
    }

    /// `y = J_cᵀ (t − J_p v)` of a camera.
    #[inline(always)]
    fn backward<const K: usize>(&self, camera: usize, y: &mut [f64], scratch: &Scratch<T>) {
        let rotation = self.rotation(camera);
        let zero = splat(T::default());
        let (mut pose, mut intrinsics) = ([zero; 6], [zero; K]);
        for group in self.first_group[camera] as usize..self.first_group[camera + 1] as usize {
            let rows = &self.rows[num_rows(K) * group..num_rows(K) * (group + 1)];
            let points = &self.points[group];
            let mut v = [zero; 3];
            for l in 0..LANES {
                let point = &scratch.point[points[l] as usize];
                (v[0][l], v[1][l], v[2][l]) = (point[0], point[1], point[2]);
            }
            let in_cam = [dot3(&rotation[0..3], &v), dot3(&rotation[3..6], &v), dot3(&rotation[6..9], &v)];
            let image = &scratch.image[group];
            let rest = [
                minus(&image[0], &dot3(&rows[3..6], &in_cam)),
                minus(&image[1], &dot3(&rows[6..9], &in_cam)),
            ];
            let force = force(rows, &rest);
            for c in 0..3 {
                let (a, b) = ((c + 1) % 3, (c + 2) % 3);
                let turn = minus(&times(&rows[a], &force[b]), &times(&rows[b], &force[a]));
                pose[c] = plus(&pose[c], &turn);
                pose[3 + c] = plus(&pose[3 + c], &force[c]);
            }
            for a in 0..K {
                intrinsics[a] = fused(&rows[9 + a], &rest[0], &intrinsics[a]);
                intrinsics[a] = fused(&rows[9 + K + a], &rest[1], &intrinsics[a]);
            }
        }
        for (y, sums) in y.iter_mut().zip(pose.iter().chain(&intrinsics)) {
            *y = sum(sums);
        }
    }
}

/// How the point moves in the camera's frame: `ω × x + v`.
#[inline(always)]
fn motion<T: Real>(pose: &[Lanes<T>; 6], rows: &[Lanes<T>]) -> [Lanes<T>; 3] {
    each3(
        #[inline(always)]
        |c| {
            let (a, b) = ((c + 1) % 3, (c + 2) % 3);
            let turn = minus(&times(&pose[a], &rows[b]), &times(&pose[b], &rows[a]));
            plus(&turn, &pose[3 + c])
        },
    )
}

/// `dᵀ t`: what an image vector asks of the point in the camera's frame.
#[inline(always)]
fn force<T: Real>(rows: &[Lanes<T>], image: &[Lanes<T>; 2]) -> [Lanes<T>; 3] {
    each3(
        #[inline(always)]
        |c| fused(&rows[6 + c], &image[1], &times(&rows[3 + c], &image[0])),
    )
}

/// `Rᵀ x`.
#[inline(always)]
pub(super) fn turned_back<T: Real>(rotation: &[Lanes<T>; 9], x: &[Lanes<T>]) -> [Lanes<T>; 3] {
    each3(
        #[inline(always)]
        |c| {
            let sum = times(&rotation[c], &x[0]);
            fused(&rotation[6 + c], &x[2], &fused(&rotation[3 + c], &x[1], &sum))
        },
    )
}

#[inline(always)]
fn dot3<T: Real>(a: &[Lanes<T>], b: &[Lanes<T>; 3]) -> Lanes<T> {
    fused(&a[2], &b[2], &fused(&a[1], &b[1], &times(&a[0], &b[0])))
}

/// `V⁻¹ w = L⁻ᵀ L⁻¹ w`.
#[inline(always)]
pub(super) fn solve_point<T: Real>(inverse: &[T; 6], w: &[T; 4]) -> [T; 4] {
    let i = inverse;
    let a = i[0] * w[0];
    let b = i[2].mul_add(w[1], i[1] * w[0]);
    let c = i[5].mul_add(w[2], i[4].mul_add(w[1], i[3] * w[0]));
    [i[3].mul_add(c, i[1].mul_add(b, i[0] * a)), i[4].mul_add(c, i[2] * b), i[5] * c, T::default()]
}
