//! Essential matrices from five correspondences (Nistér 2004), and linearly from eight or more.
//!
//! The matrices that satisfy five epipolar constraints form a space of four; in it the ten cubic constraints of an essential
//! matrix are eliminated to a polynomial of degree ten in one unknown, whose real roots are isolated by Sturm's theorem.

use nalgebra::{Matrix3, Matrix4, SMatrix, Vector2, Vector3, Vector4};
use smallvec::SmallVec;

use crate::fundamental::fundamental_from_eight;
use crate::linear::{null_space, proper_svd3, solve_positive_definite};
use crate::polynomial::degree_ten_roots;

/// Exponents of (x, y, z) of the monomials of degree at most two and three. The cubic ones are in Nistér's order: the first
/// ten are eliminated, the others are polynomials in z times x, y and 1.
const QUADRATIC: [[usize; 3]; 10] = [
    [2, 0, 0],
    [1, 1, 0],
    [1, 0, 1],
    [1, 0, 0],
    [0, 2, 0],
    [0, 1, 1],
    [0, 1, 0],
    [0, 0, 2],
    [0, 0, 1],
    [0, 0, 0],
];
const CUBIC: [[usize; 3]; 20] = [
    [3, 0, 0],
    [0, 3, 0],
    [2, 1, 0],
    [1, 2, 0],
    [2, 0, 1],
    [2, 0, 0],
    [0, 2, 1],
    [0, 2, 0],
    [1, 1, 1],
    [1, 1, 0],
    [1, 0, 2],
    [1, 0, 1],
    [1, 0, 0],
    [0, 1, 2],
    [0, 1, 1],
    [0, 1, 0],
    [0, 0, 3],
    [0, 0, 2],
    [0, 0, 1],
    [0, 0, 0],
];
/// Of the linear polynomials' terms x, y, z, 1.
const LINEAR: [[usize; 3]; 4] = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]];
/// Where the product of two linear terms, and of a quadratic and a linear term, goes.
const LINEAR_TIMES_LINEAR: [[usize; 4]; 4] = products(&LINEAR, &QUADRATIC);
const QUADRATIC_TIMES_LINEAR: [[usize; 4]; 10] = products(&QUADRATIC, &CUBIC);

const fn products<const N: usize, const M: usize>(
    factors: &[[usize; 3]; N],
    monomials: &[[usize; 3]; M],
) -> [[usize; 4]; N] {
    let mut table = [[0; 4]; N];
    let mut i = 0;
    while i < N {
        let mut j = 0;
        while j < 4 {
            let mut k = 0;
            while !(monomials[k][0] == factors[i][0] + LINEAR[j][0]
                && monomials[k][1] == factors[i][1] + LINEAR[j][1]
                && monomials[k][2] == factors[i][2] + LINEAR[j][2])
            {
                k += 1;
            }
            table[i][j] = k;
            j += 1;
        }
        i += 1;
    }
    table
}

type Linear = [f64; 4];
type Quadratic = [f64; 10];
type Cubic = [f64; 20];

/// Every essential matrix (at most ten, Frobenius norm one) with `second ᵀ E first = 0` for five correspondences on the
/// plane z = 1. None when the correspondences are dependent or not finite.
pub fn essential_from_five(
    first: &[Vector2<f64>; 5],
    second: &[Vector2<f64>; 5],
) -> SmallVec<[Matrix3<f64>; 10]> {
    let mut found = SmallVec::new();
    let mut rows = SMatrix::<f64, 5, 9>::zeros();
    for i in 0..5 {
        rows.set_row(i, &epipolar_row(&first[i], &second[i]).transpose());
    }
    let Some(basis) = null_space::<5, 9, 4>(&rows) else { return found };
    let Some(reduced) = reduce(constraints(&basis)) else { return found };
    let in_z = in_last_unknown(&reduced);
    for z in degree_ten_roots(&determinant(&in_z)) {
        let Some((x, y)) = other_unknowns(&in_z, z) else { continue };
        let Some(coordinates) = Vector4::new(x, y, z, 1.0).try_normalize(0.0) else { continue };
        let essential = polished(&basis, coordinates);
        if essential.iter().all(|value| value.is_finite()) {
            found.push(essential);
        }
    }
    found
}

/// The essential matrix (Frobenius norm one) nearest to the matrix that fits eight or more correspondences on the plane z = 1
/// linearly (Longuet-Higgins 1981; normalised as Hartley 1997).
///
/// `None` for what [`fundamental_from_eight`] refuses: fewer than eight, points on one plane or otherwise dependent, lengths
/// that differ, non-finite values.
pub fn essential_from_eight(first: &[Vector2<f64>], second: &[Vector2<f64>]) -> Option<Matrix3<f64>> {
    let (u, _, v) = proper_svd3(&fundamental_from_eight(first, second)?)?;
    let equal = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, 0.0));
    Some((u * equal * v.transpose()).normalize())
}

/// The coefficients of `second ᵀ M first` in the entries of M, row by row.
pub(crate) fn epipolar_row(first: &Vector2<f64>, second: &Vector2<f64>) -> SMatrix<f64, 9, 1> {
    let (a, b) = (first, second);
    SMatrix::from([[b.x * a.x, b.x * a.y, b.x, b.y * a.x, b.y * a.y, b.y, a.x, a.y, 1.0]])
}

fn add_linear_product(into: &mut Quadratic, a: &Linear, b: &Linear, factor: f64) {
    for i in 0..4 {
        for j in 0..4 {
            into[LINEAR_TIMES_LINEAR[i][j]] += factor * a[i] * b[j];
        }
    }
}

fn add_product(into: &mut Cubic, a: &Quadratic, b: &Linear) {
    for i in 0..10 {
        for j in 0..4 {
            into[QUADRATIC_TIMES_LINEAR[i][j]] += a[i] * b[j];
        }
    }
}

/// The ten cubics `det E = 0` and `(E Eᵀ - ½ tr(E Eᵀ) I) E = 0` for `E = x X + y Y + z Z + W`.
fn constraints(basis: &SMatrix<f64, 9, 4>) -> [Cubic; 10] {
    let e = |row: usize, column: usize| -> Linear { std::array::from_fn(|k| basis[(3 * row + column, k)]) };
    let entries: [[Linear; 3]; 3] = std::array::from_fn(|row| std::array::from_fn(|column| e(row, column)));
    let mut squares = [[[0.0; 10]; 3]; 3];
    for i in 0..3 {
        for j in 0..=i {
            for k in 0..3 {
                add_linear_product(&mut squares[i][j], &entries[i][k], &entries[j][k], 1.0);
            }
            squares[j][i] = squares[i][j];
        }
    }
    let half_trace: Quadratic =
        std::array::from_fn(|k| 0.5 * (squares[0][0][k] + squares[1][1][k] + squares[2][2][k]));
    for i in 0..3 {
        for k in 0..10 {
            squares[i][i][k] -= half_trace[k];
        }
    }
    let mut cubics = [[0.0; 20]; 10];
    for i in 0..3 {
        for j in 0..3 {
            for k in 0..3 {
                add_product(&mut cubics[3 * i + j], &squares[i][k], &entries[k][j]);
            }
        }
    }
    for column in 0..3 {
        let (next, last) = ((column + 1) % 3, (column + 2) % 3);
        let mut minor = [0.0; 10];
        add_linear_product(&mut minor, &entries[1][next], &entries[2][last], 1.0);
        add_linear_product(&mut minor, &entries[1][last], &entries[2][next], -1.0);
        add_product(&mut cubics[9], &minor, &entries[0][column]);
    }
    cubics
}

/// Gauss–Jordan elimination of the first ten monomials; row `i` then says what monomial `i` is in the other ten, negated.
fn reduce(mut rows: [Cubic; 10]) -> Option<[Cubic; 10]> {
    for column in 0..10 {
        let pivot_row = (column..10)
            .max_by(|&a, &b| rows[a][column].abs().total_cmp(&rows[b][column].abs()))
            .filter(|&row| rows[row][column].abs() > 1e-14)?;
        rows.swap(column, pivot_row);
        let inverse = 1.0 / rows[column][column];
        rows[column].iter_mut().for_each(|value| *value *= inverse);
        let pivot = rows[column];
        // Rows 0 to 3 of the result are not needed: they are only eliminated below the diagonal.
        for i in (0..10).filter(|&i| i != column && (i > column || i >= 4)) {
            let factor = rows[i][column];
            // Nobody asks for what is left of the column: whole rows are quicker than their ends.
            for k in 0..20 {
                rows[i][k] -= factor * pivot[k];
            }
        }
    }
    Some(rows)
}

/// Three equations `p(z) x + q(z) y + r(z) = 0`, coefficients from the constant up.
type InZ = [[[f64; 5]; 3]; 3];

/// Rows (x²z, x²), (y²z, y²), (xyz, xy): the first less z times the second has no eliminated monomial left.
fn in_last_unknown(rows: &[Cubic; 10]) -> InZ {
    let mut equations = [[[0.0; 5]; 3]; 3];
    for (equation, pair) in equations.iter_mut().zip([4, 6, 8]) {
        let (high, low) = (&rows[pair], &rows[pair + 1]);
        for (polynomial, (start, count)) in equation.iter_mut().zip([(10, 3), (13, 3), (16, 4)]) {
            for k in 0..count {
                let power = count - 1 - k;
                polynomial[power] += high[start + k];
                polynomial[power + 1] -= low[start + k];
            }
        }
    }
    equations
}

fn determinant(b: &InZ) -> [f64; 11] {
    let mut total = [0.0; 11];
    for (i, j, k, sign) in
        [(0, 1, 2, 1.0), (1, 2, 0, 1.0), (2, 0, 1, 1.0), (0, 2, 1, -1.0), (1, 0, 2, -1.0), (2, 1, 0, -1.0)]
    {
        // Columns x and y have degree three, the last four.
        let mut product = [0.0; 7];
        for p in 0..4 {
            for q in 0..4 {
                product[p + q] += sign * b[i][0][p] * b[j][1][q];
            }
        }
        for p in 0..7 {
            for q in 0..5 {
                total[p + q] += product[p] * b[k][2][q];
            }
        }
    }
    total
}

/// x and y of a root z: the null vector of the three equations.
fn other_unknowns(b: &InZ, z: f64) -> Option<(f64, f64)> {
    let at = |polynomial: &[f64; 5]| polynomial.iter().rev().fold(0.0, |sum, value| sum * z + value);
    let rows = [0, 1, 2].map(|i| Vector3::new(at(&b[i][0]), at(&b[i][1]), at(&b[i][2])));
    let crosses = [rows[0].cross(&rows[1]), rows[1].cross(&rows[2]), rows[2].cross(&rows[0])];
    let best = crosses.into_iter().max_by(|p, q| p.norm_squared().total_cmp(&q.norm_squared()))?;
    let (x, y) = (best.x / best.z, best.y / best.z);
    (x.is_finite() && y.is_finite()).then_some((x, y))
}

/// The matrix at these coordinates of the null space, after Gauss–Newton steps on the cubic constraints: roots of the
/// polynomial lose digits where two of them are close, as on planes.
fn polished(basis: &SMatrix<f64, 9, 4>, mut coordinates: Vector4<f64>) -> Matrix3<f64> {
    const MAX_STEPS: usize = 3;
    /// Of a matrix of norm one; far below what noise leaves of five points.
    const EXACT: f64 = 1e-10;
    let directions: [Matrix3<f64>; 4] =
        std::array::from_fn(|k| Matrix3::from_row_iterator(basis.column(k).iter().copied()));
    let combine = |c: &Vector4<f64>| {
        directions[0] * c[0] + directions[1] * c[1] + directions[2] * c[2] + directions[3] * c[3]
    };
    let mut essential = combine(&coordinates);
    let mut residual = constraint(&essential);
    for _ in 0..MAX_STEPS {
        if !(residual.norm_squared() > EXACT * EXACT) {
            break;
        }
        let columns = directions.map(|direction| constraint_change(&essential, &direction));
        // The length of the coordinates stays: a step along them is forbidden.
        let normal = Matrix4::from_fn(|i, j| columns[i].dot(&columns[j]) + coordinates[i] * coordinates[j]);
        let right = Vector4::from_fn(|i, _| -columns[i].dot(&residual));
        let Some(step) = solve_positive_definite(&normal, &right) else { break };
        let Some(next) = (coordinates + step).try_normalize(0.0) else { break };
        let next_essential = combine(&next);
        let next_residual = constraint(&next_essential);
        if !(next_residual.norm_squared() < residual.norm_squared()) {
            break;
        }
        (coordinates, essential, residual) = (next, next_essential, next_residual);
    }
    essential
}

/// `E Eᵀ E - ½ tr(E Eᵀ) E`, zero for an essential matrix.
fn constraint(e: &Matrix3<f64>) -> Matrix3<f64> {
    e * e.transpose() * e - 0.5 * e.norm_squared() * e
}

/// The derivative of [`constraint`] in a direction.
fn constraint_change(e: &Matrix3<f64>, d: &Matrix3<f64>) -> Matrix3<f64> {
    let transposed = e.transpose();
    d * (transposed * e) + e * d.transpose() * e + (e * transposed) * d
        - e.dot(d) * e
        - 0.5 * e.norm_squared() * d
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::epipolar::essential_from_pose;
    use crate::so3::skew;
    use crate::test_support::{Random, TwoViews, two_views};

    fn five(points: &[Vector2<f64>]) -> [Vector2<f64>; 5] {
        [points[0], points[1], points[2], points[3], points[4]]
    }

    #[test]
    fn truth_is_among_the_matrices_and_all_are_essential() {
        let mut random = Random::new("five points");
        for planar in [false, true] {
            let (mut good, mut count, mut exact) = (0, 0, 0);
            for _ in 0..3000 {
                let views = two_views(&mut random, 5, 0.0, planar);
                let pose = views.second_from_first;
                let truth = (skew(&pose.translation) * pose.rotation_matrix()).normalize();
                let found = essential_from_five(&five(&views.first), &five(&views.second));
                let nearest = found
                    .iter()
                    .map(|e| (e - truth).norm().min((e + truth).norm()))
                    .fold(f64::INFINITY, f64::min);
                good += usize::from(nearest < 1e-6);
                count += found.len();
                for e in &found {
                    let square = e * e.transpose();
                    let cubic = square * e - 0.5 * square.trace() * e;
                    exact += usize::from(cubic.norm() < 1e-9);
                }
            }
            assert!(
                good >= 2985 && exact as f64 > 0.998 * count as f64,
                "planar {planar}: {good} {exact} {count}"
            );
            assert!(count > 3000 && count < 30_000);
        }
    }

    #[test]
    fn degenerate_input_gives_none_or_finite() {
        let mut random = Random::new("five degenerate");
        let views = two_views(&mut random, 5, 0.0, false);
        let (first, second) = (five(&views.first), five(&views.second));
        assert!(essential_from_five(&[first[0]; 5], &[second[0]; 5]).is_empty());
        assert!(essential_from_five(&[Vector2::repeat(f64::NAN); 5], &second).is_empty());
        assert!(essential_from_five(&first, &[Vector2::repeat(f64::INFINITY); 5]).is_empty());
        let mut twice = (first, second);
        (twice.0[4], twice.1[4]) = (first[0], second[0]);
        assert!(essential_from_five(&twice.0, &twice.1).is_empty());
        let line = [0.0, 0.1, 0.2, 0.3, 0.4].map(|x| Vector2::new(x, 0.0));
        for e in essential_from_five(&line, &line).iter().chain(&essential_from_five(&first, &first)) {
            assert!(e.iter().all(|value| value.is_finite()));
        }
    }

    #[test]
    fn eight_points_and_more_give_the_truth_and_feel_noise() {
        let mut random = Random::new("essential from eight");
        let off = |views: &TwoViews| {
            let truth = essential_from_pose(&views.second_from_first).normalize();
            let found = essential_from_eight(&views.first, &views.second).unwrap();
            let twice: Matrix3<f64> = 2.0 * found * found.transpose() * found - found;
            assert!(twice.norm() < 1e-12, "two equal singular values and a zero: {twice}");
            (found - truth).norm().min((found + truth).norm())
        };
        let mut good = 0;
        for case in 0..1000 {
            good += usize::from(off(&two_views(&mut random, 8 + case % 20, 0.0, false)) < 1e-5);
        }
        assert!(good >= 990, "{good}");
        let mut median = |noise: f64| {
            let mut errors: Vec<f64> =
                (0..301).map(|_| off(&two_views(&mut random, 100, noise, false))).collect();
            errors.sort_by(f64::total_cmp);
            errors[150]
        };
        let (small, large) = (median(1e-5), median(1e-4));
        assert!(small > 1e-6 && large > 5.0 * small && large < 20.0 * small, "{small} {large}");
        let plane = two_views(&mut random, 20, 0.0, true);
        assert!(essential_from_eight(&plane.first, &plane.second).is_none());
        assert!(essential_from_eight(&plane.first[..7], &plane.second[..7]).is_none());
        assert!(essential_from_eight(&[Vector2::repeat(f64::NAN); 9], &plane.second[..9]).is_none());
    }
}
