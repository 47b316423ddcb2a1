//! Block sums over the observations of each camera: normal equations, and what elimination takes from them.

use super::product::{LaneArrays, num_rows, turned_back};
use super::real::{Lanes, Real, by_stride, fused, minus, splat, sum, times};
use super::state::packed;

/// The most unknowns of a camera.
pub(super) const MAX_WIDTH: usize = 6 + terrane_geometry::camera::MAX_PARAMS;

/// Jacobian of a group in the camera: x and y row of each unknown.
pub(super) type CameraRows<T> = [[Lanes<T>; 2]; MAX_WIDTH];

/// `Z = J_cᵀ J_p L⁻ᵀ` of a group: three columns of each unknown.
pub(super) type GroupZ<T> = [[Lanes<T>; 3]; MAX_WIDTH];

impl<T: Real> LaneArrays<T> {
    /// `J_cᵀ J_c` of each camera.
    pub fn normal_blocks(&self, stride: usize) -> Vec<f64> {
        let width = 6 + stride;
        let mut blocks = vec![0.0; packed(width) * self.rotations.len()];
        for (camera, block) in blocks.chunks_exact_mut(packed(width)).enumerate() {
            by_stride!(stride, K => widest(#[inline(always)] || self.add_normal::<K>(camera, block)));
        }
        blocks
    }

    #[inline(always)]
    fn add_normal<const K: usize>(&self, camera: usize, block: &mut [f64]) {
        let width = 6 + K;
        let mut sums = [splat(T::default()); packed(MAX_WIDTH)];
        for group in self.first_group[camera] as usize..self.first_group[camera + 1] as usize {
            let rows = self.camera_rows::<K>(group);
            let mut at = 0;
            for a in 0..width {
                for b in 0..=a {
                    sums[at] = fused(&rows[a][0], &rows[b][0], &sums[at]);
                    sums[at] = fused(&rows[a][1], &rows[b][1], &sums[at]);
                    at += 1;
                }
            }
        }
        block.iter_mut().zip(&sums).for_each(|(value, lanes)| *value = sum(lanes));
    }

    /// Takes `Σ Z Zᵀ` from the blocks and `Σ Z L⁻¹ g` from the gradients; `reduced` is `L⁻¹ g` of each point.
    pub fn eliminate(&self, stride: usize, reduced: &[[f64; 3]], blocks: &mut [f64], gradients: &mut [f64]) {
        let width = 6 + stride;
        let cameras = blocks.chunks_exact_mut(packed(width)).zip(gradients.chunks_exact_mut(width));
        for (camera, (block, gradient)) in cameras.enumerate() {
            by_stride!(stride, K => widest(#[inline(always)] || self.eliminate_camera::<K>(camera, reduced, block, gradient)));
        }
    }

    #[inline(always)]
    fn eliminate_camera<const K: usize>(
        &self,
        camera: usize,
        reduced: &[[f64; 3]],
        block: &mut [f64],
        gradient: &mut [f64],
    ) {
        let width = 6 + K;
        let mut sums = [splat(T::default()); packed(MAX_WIDTH)];
        let mut slopes = [splat(T::default()); MAX_WIDTH];
        for group in self.first_group[camera] as usize..self.first_group[camera + 1] as usize {
            let z = self.group_z::<K>(camera, group);
            let mut right = [splat(T::default()); 3];
            for (l, point) in self.points[group].iter().enumerate() {
                if let Some(reduced) = reduced.get(*point as usize) {
                    (0..3).for_each(|c| right[c][l] = T::from_f64(reduced[c]));
                }
            }
            let mut at = 0;
            for a in 0..width {
                for c in 0..3 {
                    slopes[a] = fused(&z[a][c], &right[c], &slopes[a]);
                }
                for b in 0..=a {
                    for c in 0..3 {
                        sums[at] = fused(&z[a][c], &z[b][c], &sums[at]);
                    }
                    at += 1;
                }
            }
        }
        block.iter_mut().zip(&sums).for_each(|(value, lanes)| *value -= sum(lanes));
        gradient.iter_mut().zip(&slopes).for_each(|(value, lanes)| *value -= sum(lanes));
    }

    /// Jacobian of a group in the camera's unknowns.
    #[inline(always)]
    pub fn camera_rows<const K: usize>(&self, group: usize) -> CameraRows<T> {
        let rows = &self.rows[num_rows(K) * group..num_rows(K) * (group + 1)];
        let mut jacobian = [[splat(T::default()); 2]; MAX_WIDTH];
        for row in 0..2 {
            let d = &rows[3 + 3 * row..6 + 3 * row];
            for a in 0..3 {
                let (b, c) = ((a + 1) % 3, (a + 2) % 3);
                jacobian[a][row] = minus(&times(&rows[b], &d[c]), &times(&rows[c], &d[b]));
                jacobian[3 + a][row] = d[a];
            }
            for a in 0..K {
                jacobian[6 + a][row] = rows[9 + K * row + a];
            }
        }
        jacobian
    }

    /// `Z` of a group.
    #[inline(always)]
    pub fn group_z<const K: usize>(&self, camera: usize, group: usize) -> GroupZ<T> {
        let rows = &self.rows[num_rows(K) * group..num_rows(K) * (group + 1)];
        let rotation = self.rotation(camera);
        let mut inverse = [splat(T::default()); 6];
        for (l, point) in self.points[group].iter().enumerate() {
            let of_point = &self.inverse[*point as usize];
            (0..6).for_each(|i| inverse[i][l] = of_point[i]);
        }
        // J_p = d R, then J_p L⁻ᵀ.
        let mut scaled = [[splat(T::default()); 3]; 2];
        for (row, scaled) in scaled.iter_mut().enumerate() {
            let j = turned_back(&rotation, &rows[3 + 3 * row..6 + 3 * row]);
            let second = fused(&j[1], &inverse[2], &times(&j[0], &inverse[1]));
            let third = fused(&j[2], &inverse[5], &fused(&j[1], &inverse[4], &times(&j[0], &inverse[3])));
            *scaled = [times(&j[0], &inverse[0]), second, third];
        }
        let jacobian = self.camera_rows::<K>(group);
        let mut z = [[splat(T::default()); 3]; MAX_WIDTH];
        for a in 0..6 + K {
            for c in 0..3 {
                z[a][c] = fused(&jacobian[a][1], &scaled[1][c], &times(&jacobian[a][0], &scaled[0][c]));
            }
        }
        z
    }
}

/// Runs a closure compiled for 256-bit vectors where there are any: the same operations in the same order.
#[inline(always)]
pub(super) fn widest<R>(work: impl FnOnce() -> R) -> R {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
        // SAFETY: this processor has AVX2 and FMA.
        return unsafe { wide(work) };
    }
    work()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn wide<R>(work: impl FnOnce() -> R) -> R {
    work()
}
