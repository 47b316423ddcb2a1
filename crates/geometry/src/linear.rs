//! Small dense linear algebra of fixed size, for hot loops: no allocation, no iteration without a bound.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

/// Sweeps of Jacobi's method; convergence is quadratic and takes about six.
const MAX_SWEEPS: usize = 30;

/// Solves `a x = b` for a symmetric positive definite `a`, of which the lower triangle is read, by Cholesky's method.
///
/// `None` when `a` is not positive definite to working precision, or not finite.
pub(crate) fn solve_positive_definite<const N: usize>(
    a: &SMatrix<f64, N, N>,
    b: &SVector<f64, N>,
) -> Option<SVector<f64, N>> {
    let mut lower = *a;
    for j in 0..N {
        let mut pivot = lower[(j, j)];
        for k in 0..j {
            pivot -= lower[(j, k)] * lower[(j, k)];
        }
        if !(pivot > f64::EPSILON * a[(j, j)].abs()) {
            return None;
        }
        let diagonal = pivot.sqrt();
        lower[(j, j)] = diagonal;
        for i in j + 1..N {
            let mut sum = lower[(i, j)];
            for k in 0..j {
                sum -= lower[(i, k)] * lower[(j, k)];
            }
            lower[(i, j)] = sum / diagonal;
        }
    }
    let mut x = *b;
    for i in 0..N {
        for k in 0..i {
            x[i] -= lower[(i, k)] * x[k];
        }
        x[i] /= lower[(i, i)];
    }
    for i in (0..N).rev() {
        for k in i + 1..N {
            x[i] -= lower[(k, i)] * x[k];
        }
        x[i] /= lower[(i, i)];
    }
    x.iter().all(|value| value.is_finite()).then_some(x)
}

/// Eigenvalues in ascending order and the matching eigenvectors as columns, by cyclic Jacobi rotations.
///
/// Not finite in, not finite out.
pub(crate) fn symmetric_eigen<const N: usize>(
    mut a: SMatrix<f64, N, N>,
) -> (SVector<f64, N>, SMatrix<f64, N, N>) {
    let mut vectors = SMatrix::<f64, N, N>::identity();
    let tiny = f64::EPSILON * f64::EPSILON * a.norm_squared();
    for _ in 0..MAX_SWEEPS {
        let mut off_diagonal = 0.0;
        for p in 0..N {
            for q in p + 1..N {
                off_diagonal += a[(p, q)] * a[(p, q)];
            }
        }
        if !(off_diagonal > tiny) {
            break;
        }
        for p in 0..N {
            for q in p + 1..N {
                rotate(&mut a, &mut vectors, p, q);
            }
        }
    }
    sort_eigen(&a, &vectors)
}

/// One Jacobi rotation that makes `a[(p, q)]` zero.
fn rotate<const N: usize>(a: &mut SMatrix<f64, N, N>, vectors: &mut SMatrix<f64, N, N>, p: usize, q: usize) {
    let apq = a[(p, q)];
    if apq == 0.0 {
        return;
    }
    let theta = (a[(q, q)] - a[(p, p)]) / (2.0 * apq);
    let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
    let c = 1.0 / (t * t + 1.0).sqrt();
    let s = t * c;
    for k in 0..N {
        let (akp, akq) = (a[(k, p)], a[(k, q)]);
        a[(k, p)] = c * akp - s * akq;
        a[(k, q)] = s * akp + c * akq;
    }
    for k in 0..N {
        let (apk, aqk) = (a[(p, k)], a[(q, k)]);
        a[(p, k)] = c * apk - s * aqk;
        a[(q, k)] = s * apk + c * aqk;
    }
    for k in 0..N {
        let (vkp, vkq) = (vectors[(k, p)], vectors[(k, q)]);
        vectors[(k, p)] = c * vkp - s * vkq;
        vectors[(k, q)] = s * vkp + c * vkq;
    }
}

fn sort_eigen<const N: usize>(
    a: &SMatrix<f64, N, N>,
    vectors: &SMatrix<f64, N, N>,
) -> (SVector<f64, N>, SMatrix<f64, N, N>) {
    let mut order: [usize; N] = std::array::from_fn(|i| i);
    order.sort_by(|&i, &j| a[(i, i)].total_cmp(&a[(j, j)]));
    let values = SVector::from_fn(|i, _| a[(order[i], order[i])]);
    let sorted = SMatrix::from_fn(|row, column| vectors[(row, order[column])]);
    (values, sorted)
}

/// An orthonormal basis, `K = C - R` columns, of the null space of `R` rows of length `C`, by Householder reflections.
///
/// `None` when the rows are linearly dependent to working precision, or not finite.
pub(crate) fn null_space<const R: usize, const C: usize, const K: usize>(
    rows: &SMatrix<f64, R, C>,
) -> Option<SMatrix<f64, C, K>> {
    const { assert!(R + K == C) };
    // Columns side by side, so that their sums advance together.
    let mut a: [[f64; R]; C] = std::array::from_fn(|i| std::array::from_fn(|j| rows[(j, i)]));
    let scale = rows.transpose().norm();
    let mut reflectors = [[0.0; C]; R];
    for j in 0..R {
        let norm = (j..C).map(|i| a[i][j] * a[i][j]).sum::<f64>().sqrt();
        if !(norm > 1e-11 * scale) {
            return None;
        }
        let alpha = if a[j][j] > 0.0 { -norm } else { norm };
        let v = &mut reflectors[j];
        for i in j..C {
            v[i] = a[i][j];
        }
        v[j] -= alpha;
        let length = v[j..].iter().map(|value| value * value).sum::<f64>().sqrt();
        for value in &mut v[j..] {
            *value /= length;
        }
        // What becomes of columns up to the `j`-th is of no use any more.
        reflect(v, &mut a, j);
    }
    let mut basis = [[0.0; K]; C];
    for k in 0..K {
        basis[R + k][k] = 1.0;
    }
    for j in (0..R).rev() {
        reflect(&reflectors[j], &mut basis, j);
    }
    Some(SMatrix::from_fn(|i, k| basis[i][k]))
}

/// Reflects columns, of which the rows from `start` on are not fixed, at the plane with this normal.
#[inline(always)]
fn reflect<const C: usize, const N: usize>(normal: &[f64; C], columns: &mut [[f64; N]; C], start: usize) {
    let mut twice = [0.0; N];
    for i in start..C {
        for k in 0..N {
            twice[k] += normal[i] * columns[i][k];
        }
    }
    twice.iter_mut().for_each(|dot| *dot *= 2.0);
    for i in start..C {
        for k in 0..N {
            columns[i][k] -= twice[k] * normal[i];
        }
    }
}

/// `a = u diag(s) vᵀ` of a 3×3 matrix with `s` falling, `u` and `v` rotations, and `s[2]` of the sign of `det a`.
///
/// From the eigenvectors of `aᵀa`, one side re-orthogonalised, so that a singular `a` is handled: what must be exact here
/// are the two larger singular values. `None` when `a` has rank below two or is not finite.
pub(crate) fn proper_svd3(a: &Matrix3<f64>) -> Option<(Matrix3<f64>, Vector3<f64>, Matrix3<f64>)> {
    let (_, vectors) = symmetric_eigen(a.transpose() * a);
    let (v0, v1): (Vector3<f64>, Vector3<f64>) =
        (vectors.column(2).into_owned(), vectors.column(1).into_owned());
    let v2 = v0.cross(&v1);
    let (a0, a1) = (a * v0, a * v1);
    let (s0, s1) = (a0.norm(), a1.norm());
    if !(s1 > 1e-12 * s0) {
        return None;
    }
    let u0 = a0 / s0;
    let u1 = (a1 - u0 * u0.dot(&a1)).normalize();
    let u2 = u0.cross(&u1);
    let s2 = u2.dot(&(a * v2));
    let finite = s0.is_finite() && s2.is_finite();
    finite.then(|| {
        (Matrix3::from_columns(&[u0, u1, u2]), Vector3::new(s0, s1, s2), Matrix3::from_columns(&[v0, v1, v2]))
    })
}

/// Column-major index of the entry largest in size; the first of equals.
pub(crate) fn largest_entry(m: &Matrix3<f64>) -> usize {
    (1..9).fold(0, |best, i| if m[i].abs() > m[best].abs() { i } else { best })
}

/// Two unit vectors that complete `direction` to an orthogonal frame.
pub(crate) fn tangent_basis(direction: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let helper = if direction.x.abs() < 0.6 * direction.norm() { Vector3::x() } else { Vector3::y() };
    let first = direction.cross(&helper).normalize();
    (first, direction.cross(&first).normalize())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::Random;

    #[test]
    fn eigenvectors_rebuild_the_matrix() {
        let mut random = Random::new("eigen");
        for _ in 0..200 {
            let half = SMatrix::<f64, 6, 6>::from_fn(|_, _| random.gaussian());
            let a = half * half.transpose();
            let (values, vectors) = symmetric_eigen(a);
            let again = vectors * SMatrix::from_diagonal(&values) * vectors.transpose();
            assert!((again - a).norm() < 1e-12 * a.norm());
            assert!((0..5).all(|i| values[i] <= values[i + 1]));
        }
    }

    #[test]
    fn null_space_is_orthonormal_and_null() {
        let mut random = Random::new("null");
        for _ in 0..200 {
            let rows = SMatrix::<f64, 5, 9>::from_fn(|_, _| random.gaussian());
            let basis: SMatrix<f64, 9, 4> = null_space(&rows).unwrap();
            assert!((rows * basis).norm() < 1e-13 * rows.norm());
            assert!((basis.transpose() * basis - SMatrix::identity()).norm() < 1e-13);
        }
        let dependent = SMatrix::<f64, 3, 9>::from_fn(|i, j| (i as f64 + 1.0) * (j as f64 - 2.5));
        assert!(null_space::<3, 9, 6>(&dependent).is_none());
        assert!(null_space::<3, 9, 6>(&SMatrix::repeat(f64::NAN)).is_none());
    }

    #[test]
    fn svd_rebuilds_singular_and_reflecting_matrices() {
        let mut random = Random::new("svd");
        for case in 0..300 {
            let mut a = Matrix3::from_fn(|_, _| random.gaussian());
            if case % 3 == 0 {
                let first = a.column(0) + a.column(1);
                a.set_column(2, &first);
            }
            let (u, s, v) = proper_svd3(&a).unwrap();
            assert!((u * Matrix3::from_diagonal(&s) * v.transpose() - a).norm() < 1e-10);
            assert!((u.determinant() - 1.0).abs() < 1e-12 && (v.determinant() - 1.0).abs() < 1e-12);
        }
        assert!(proper_svd3(&Matrix3::repeat(1.0)).is_none());
        assert!(proper_svd3(&Matrix3::repeat(f64::NAN)).is_none());
    }

    #[test]
    fn positive_definite_systems_are_solved_and_others_refused() {
        let mut random = Random::new("cholesky");
        for _ in 0..200 {
            let half = SMatrix::<f64, 5, 5>::from_fn(|_, _| random.gaussian());
            let a = half * half.transpose() + SMatrix::identity() * 0.1;
            let x = SVector::<f64, 5>::from_fn(|_, _| random.gaussian());
            assert!((solve_positive_definite(&a, &(a * x)).unwrap() - x).norm() < 1e-9);
        }
        assert!(solve_positive_definite(&-Matrix3::identity(), &Vector3::x()).is_none());
        assert!(solve_positive_definite(&Matrix3::repeat(f64::NAN), &Vector3::x()).is_none());
    }
}
