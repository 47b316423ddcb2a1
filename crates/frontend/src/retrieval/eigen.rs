//! Eigenvectors of small symmetric matrices from sums, products and square roots in a fixed order: the same bits on every
//! processor.

/// Makes vectors orthogonal and of length one (modified Gram–Schmidt, twice); those that depend on others are dropped.
pub(super) fn orthonormalize(vectors: &mut Vec<Vec<f64>>) {
    let mut done: Vec<Vec<f64>> = Vec::with_capacity(vectors.len());
    for mut vector in vectors.drain(..) {
        let before = dot(&vector, &vector).sqrt();
        for _ in 0..2 {
            for other in &done {
                let along = dot(&vector, other);
                vector.iter_mut().zip(other).for_each(|(value, other)| *value -= along * other);
            }
        }
        let length = dot(&vector, &vector).sqrt();
        if length > 1e-12 * before {
            vector.iter_mut().for_each(|value| *value /= length);
            done.push(vector);
        }
    }
    *vectors = done;
}

/// Dot product in a fixed number of sums, so that it becomes vector instructions.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (a_parts, a_rest) = a.as_chunks::<4>();
    let (b_parts, b_rest) = b.as_chunks::<4>();
    let mut sums = [0.0; 4];
    for (a, b) in a_parts.iter().zip(b_parts) {
        (0..4).for_each(|k| sums[k] += a[k] * b[k]);
    }
    sums.iter().sum::<f64>() + a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum::<f64>()
}

/// Sweeps at most; a dozen are enough for some hundred rows.
const MAX_SWEEPS: usize = 30;

/// All eigenvalues of a symmetric matrix of `n` rows, greatest first, and the vector of each: Jacobi's method (Golub & Van
/// Loan, section 8.5).
pub(super) fn symmetric_eigen(matrix: &[f64], n: usize) -> (Vec<f64>, Vec<Vec<f64>>) {
    let mut rows: Vec<Vec<f64>> = matrix.chunks_exact(n.max(1)).map(<[f64]>::to_vec).collect();
    let mut vectors: Vec<Vec<f64>> =
        (0..n).map(|k| (0..n).map(|j| f64::from(u8::from(j == k))).collect()).collect();
    let scale: f64 = rows.iter().map(|row| dot(row, row)).sum();
    for _ in 0..MAX_SWEEPS {
        let off: f64 = (0..n).map(|p| rows[p][p + 1..].iter().map(|value| value * value).sum::<f64>()).sum();
        if off <= 1e-24 * scale {
            break;
        }
        for p in 0..n {
            for q in p + 1..n {
                rotate(&mut rows, &mut vectors, (p, q));
            }
        }
    }
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| rows[b][b].total_cmp(&rows[a][a]).then(a.cmp(&b)));
    let values = order.iter().map(|&k| rows[k][k]).collect();
    (values, order.into_iter().map(|k| std::mem::take(&mut vectors[k])).collect())
}

/// The rotation in the plane of two axes that makes their off-diagonal entry zero.
fn rotate(rows: &mut [Vec<f64>], vectors: &mut [Vec<f64>], (p, q): (usize, usize)) {
    let off = rows[p][q];
    if off == 0.0 {
        return;
    }
    let half = (rows[q][q] - rows[p][p]) / (2.0 * off);
    let tangent = half.signum() / (half.abs() + (half * half + 1.0).sqrt());
    let tangent = if half == 0.0 { 1.0 } else { tangent };
    let cosine = 1.0 / (tangent * tangent + 1.0).sqrt();
    let sine = tangent * cosine;
    for row in rows.iter_mut() {
        let (a, b) = (row[p], row[q]);
        row[p] = cosine * a - sine * b;
        row[q] = sine * a + cosine * b;
    }
    turn(rows, (p, q), (cosine, sine));
    turn(vectors, (p, q), (cosine, sine));
}

/// Turns two rows into each other.
fn turn(rows: &mut [Vec<f64>], (p, q): (usize, usize), (cosine, sine): (f64, f64)) {
    let (before, after) = rows.split_at_mut(q);
    for (a, b) in before[p].iter_mut().zip(&mut after[0]) {
        let (x, y) = (*a, *b);
        *a = cosine * x - sine * y;
        *b = sine * x + cosine * y;
    }
}
