//! Fundamental matrices from seven correspondences, and by least squares from eight or more.

use nalgebra::{Matrix3, SMatrix, Vector2};
use smallvec::SmallVec;

use crate::epipolar::{Normalized, RankTwo};
use crate::essential::epipolar_row;
use crate::linear::{null_space, symmetric_eigen};
use crate::polynomial::cubic_roots;

/// Every matrix of rank two (one to three, Frobenius norm one) with `second ᵀ F first = 0` for seven correspondences
/// (Hartley & Zisserman 2004, section 11.1.2). Give points of size about one. None for dependent or non-finite input.
pub fn fundamental_from_seven(
    first: &[Vector2<f64>; 7],
    second: &[Vector2<f64>; 7],
) -> SmallVec<[Matrix3<f64>; 3]> {
    let mut rows = SMatrix::<f64, 7, 9>::zeros();
    for i in 0..7 {
        rows.set_row(i, &epipolar_row(&first[i], &second[i]).transpose());
    }
    let Some(basis) = null_space::<7, 9, 2>(&rows) else { return SmallVec::new() };
    let [a, b] = [0, 1].map(|k| Matrix3::from_row_iterator(basis.column(k).iter().copied()));
    // det(a + λ b) is a cubic in λ; its inner coefficients from values at ±1.
    let (at_plus, at_minus) = ((a + b).determinant(), (a - b).determinant());
    let (constant, leading) = (a.determinant(), b.determinant());
    let quadratic = 0.5 * (at_plus + at_minus) - constant;
    let linear = 0.5 * (at_plus - at_minus) - leading;
    cubic_roots([constant, linear, quadratic, leading])
        .into_iter()
        .map(|root| (a + b * root).normalize())
        .collect()
}

/// The matrix of rank two that fits eight or more correspondences linearly (Longuet-Higgins 1981, Hartley 1997), Frobenius
/// norm one, in the points' own unit.
///
/// `None` for fewer than eight, points on one plane or otherwise dependent, lengths that differ, non-finite values.
pub fn fundamental_from_eight(first: &[Vector2<f64>], second: &[Vector2<f64>]) -> Option<Matrix3<f64>> {
    if first.len() < 8 {
        return None;
    }
    let normalized = Normalized::new(first, second)?;
    let mut sums = SMatrix::<f64, 9, 9>::zeros();
    for (a, b) in normalized.first.iter().zip(&normalized.second) {
        let row = epipolar_row(a, b);
        sums += row * row.transpose();
    }
    let (values, vectors) = symmetric_eigen(sums);
    // Two vanishing eigenvalues: a family of matrices fits.
    if !(values[1] > 1e-12 * values[8]) || !values[8].is_finite() {
        return None;
    }
    let general = Matrix3::from_row_iterator(vectors.column(0).iter().copied());
    let rank_two = RankTwo::nearest(&general)?.matrix();
    Some((normalized.second_transform().transpose() * rank_two * normalized.first_transform()).normalize())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::epipolar::essential_from_pose;
    use crate::test_support::{Random, two_views};

    fn error(found: &Matrix3<f64>, truth: &Matrix3<f64>) -> f64 {
        let truth = truth.normalize();
        (found - truth).norm().min((found + truth).norm())
    }

    #[test]
    fn seven_points_give_the_truth() {
        let mut random = Random::new("seven");
        let mut good = 0;
        for _ in 0..2000 {
            let views = two_views(&mut random, 7, 0.0, false);
            let truth = essential_from_pose(&views.second_from_first);
            let (first, second) =
                (std::array::from_fn(|i| views.first[i]), std::array::from_fn(|i| views.second[i]));
            let found = fundamental_from_seven(&first, &second);
            assert!((1..=3).contains(&found.len()) && found.iter().all(|f| f.determinant().abs() < 1e-8));
            good += usize::from(found.iter().any(|f| error(f, &truth) < 1e-5));
        }
        assert!(good >= 1980, "{good}");
    }

    #[test]
    fn eight_points_and_more_give_the_truth_and_feel_noise() {
        let mut random = Random::new("eight");
        let mut good = 0;
        for case in 0..1000 {
            let views = two_views(&mut random, 8 + case % 20, 0.0, false);
            let found = fundamental_from_eight(&views.first, &views.second).unwrap();
            good += usize::from(error(&found, &essential_from_pose(&views.second_from_first)) < 1e-5);
        }
        assert!(good >= 990, "{good}");
        let views = two_views(&mut random, 300, 1e-3, false);
        let found = fundamental_from_eight(&views.first, &views.second).unwrap();
        let off = error(&found, &essential_from_pose(&views.second_from_first));
        assert!(off > 1e-6 && off < 0.2, "{off}");
    }

    #[test]
    fn degenerate_input_gives_none() {
        let mut random = Random::new("eight degenerate");
        let views = two_views(&mut random, 20, 0.0, false);
        let plane = two_views(&mut random, 20, 0.0, true);
        assert!(fundamental_from_eight(&plane.first, &plane.second).is_none());
        assert!(fundamental_from_eight(&views.first[..7], &views.second[..7]).is_none());
        assert!(fundamental_from_eight(&views.first, &views.second[..19]).is_none());
        assert!(fundamental_from_eight(&[views.first[0]; 9], &[views.second[0]; 9]).is_none());
        let nan = [Vector2::repeat(f64::NAN); 9];
        assert!(fundamental_from_eight(&nan, &nan).is_none());
        let mut one_bad = views.first.clone();
        one_bad[3].x = f64::NAN;
        assert!(fundamental_from_eight(&one_bad, &views.second).is_none());
        assert!(fundamental_from_seven(&[views.first[0]; 7], &[views.second[0]; 7]).is_empty());
        assert!(fundamental_from_seven(&[Vector2::repeat(f64::NAN); 7], &[views.second[0]; 7]).is_empty());
        let line: [Vector2<f64>; 7] = std::array::from_fn(|i| Vector2::new(i as f64, 2.0 * i as f64));
        assert!(fundamental_from_seven(&line, &line).iter().all(|f| f.iter().all(|value| value.is_finite())));
    }
}
