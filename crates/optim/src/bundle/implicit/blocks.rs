//! Block sums over the observations of each camera: normal equations, and what elimination takes from them.

use super::product::{LaneArrays, num_rows, turned_back};
use super::real::{Lanes, Real, by_stride, fused, minus, splat, sum, times};
use super::state::packed;

/// The most unknowns of a camera.
pub(super) const MAX_WIDTH: usize = 6 + terrane_geometry::camera::MAX_PARAMS;

/// Jacobian of a group in the camera: x and y row of each unknown.
type CameraRows<T, const W: usize> = [[Lanes<T>; 2]; W];

/// `Z = J_cᵀ J_p L⁻ᵀ` of a group: three columns of each unknown.
pub(super) type GroupZ<T, const W: usize> = [[Lanes<T>; 3]; W];

/// Sums of a block by lanes; only the lower triangle is used.
type BlockLanes<T, const W: usize> = [[Lanes<T>; W]; W];

// Everywhere below `W` is `6 + K`, which constants can't say yet.
impl<T: Real> LaneArrays<T> {
    /// `J_cᵀ J_c` of each camera.
    pub fn normal_blocks(&self, stride: usize) -> Vec<f64> {
        let mut blocks = vec![0.0; packed(6 + stride) * self.rotations.len()];
        for (camera, block) in blocks.chunks_exact_mut(packed(6 + stride)).enumerate() {
            by_stride!(stride, K, WIDTH => widest(#[inline(always)] || self.add_normal::<K, WIDTH>(camera, block)));
        }
        blocks
    }

    #[inline(always)]
    fn add_normal<const K: usize, const W: usize>(&self, camera: usize, block: &mut [f64]) {
        let mut sums: BlockLanes<T, W> = [[splat(T::default()); W]; W];
        for group in self.first_group[camera] as usize..self.first_group[camera + 1] as usize {
            let rows = self.camera_rows::<K, W>(group);
            for a in 0..W {
                for b in 0..=a {
                    let first = fused(&rows[a][0], &rows[b][0], &sums[a][b]);
                    sums[a][b] = fused(&rows[a][1], &rows[b][1], &first);
                }
            }
        }
        for (a, row) in sums.iter().enumerate() {
            (0..=a).for_each(|b| block[packed(a) + b] = sum(&row[b]));
        }
    }

    /// Takes `Σ Z Zᵀ` from the blocks and `Σ Z L⁻¹ g` from the gradients; `reduced` is `L⁻¹ g` of each point.
    pub fn eliminate(&self, stride: usize, reduced: &[[f64; 3]], blocks: &mut [f64], gradients: &mut [f64]) {
        let width = 6 + stride;
        let cameras = blocks.chunks_exact_mut(packed(width)).zip(gradients.chunks_exact_mut(width));
        for (camera, (block, gradient)) in cameras.enumerate() {
            by_stride!(stride, K, WIDTH => widest(
                #[inline(always)]
                || self.eliminate_camera::<K, WIDTH>(camera, reduced, block, gradient)
            ));
        }
    }

    #[inline(always)]
    fn eliminate_camera<const K: usize, const W: usize>(
        &self,
        camera: usize,
        reduced: &[[f64; 3]],
        block: &mut [f64],
        gradient: &mut [f64],
    ) {
        let mut sums: BlockLanes<T, W> = [[splat(T::default()); W]; W];
        let mut slopes = [splat(T::default()); W];
        for group in self.first_group[camera] as usize..self.first_group[camera + 1] as usize {
            let z = self.group_z::<K, W>(camera, group);
            let mut right = [splat(T::default()); 3];
            for (l, point) in self.points[group].iter().enumerate() {
                if let Some(reduced) = reduced.get(*point as usize) {
                    for c in 0..3 {
                        right[c][l] = T::from_f64(reduced[c]);
                    }
                }
            }
            for a in 0..W {
                for c in 0..3 {
                    slopes[a] = fused(&z[a][c], &right[c], &slopes[a]);
                }
                for b in 0..=a {
                    let first = fused(&z[a][0], &z[b][0], &sums[a][b]);
                    let second = fused(&z[a][1], &z[b][1], &first);
                    sums[a][b] = fused(&z[a][2], &z[b][2], &second);
                }
            }
        }
        for (a, row) in sums.iter().enumerate() {
            (0..=a).for_each(|b| block[packed(a) + b] -= sum(&row[b]));
            gradient[a] -= sum(&slopes[a]);
        }
    }

    /// Jacobian of a group in the camera's unknowns.
    #[inline(always)]
    fn camera_rows<const K: usize, const W: usize>(&self, group: usize) -> CameraRows<T, W> {
        let rows = &self.rows[num_rows(K) * group..num_rows(K) * (group + 1)];
        let mut jacobian = [[splat(T::default()); 2]; W];
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
    pub fn group_z<const K: usize, const W: usize>(&self, camera: usize, group: usize) -> GroupZ<T, W> {
        let rows = &self.rows[num_rows(K) * group..num_rows(K) * (group + 1)];
        let rotation = self.rotation(camera);
        let mut inverse = [splat(T::default()); 6];
        for (l, point) in self.points[group].iter().enumerate() {
            let of_point = &self.inverse[*point as usize];
            for i in 0..6 {
                inverse[i][l] = of_point[i];
            }
        }
        // J_p = d R, then J_p L⁻ᵀ.
        let mut scaled = [[splat(T::default()); 3]; 2];
        for (row, scaled) in scaled.iter_mut().enumerate() {
            let j = turned_back(&rotation, &rows[3 + 3 * row..6 + 3 * row]);
            let second = fused(&j[1], &inverse[2], &times(&j[0], &inverse[1]));
            let third = fused(&j[2], &inverse[5], &fused(&j[1], &inverse[4], &times(&j[0], &inverse[3])));
            *scaled = [times(&j[0], &inverse[0]), second, third];
        }
        let jacobian = self.camera_rows::<K, W>(group);
        let mut z = [[splat(T::default()); 3]; W];
        for a in 0..W {
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
