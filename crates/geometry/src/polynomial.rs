//! Real roots of polynomials: in closed form up to degree two, by Newton's method at three, by Sturm's theorem above.
//!
//! Coefficients are given from the constant term up. Roots come in no particular order unless said; double roots may be
//! reported once or, when rounding parts them from the real axis, not at all.

use smallvec::SmallVec;

/// Real roots of `c[0] + c[1] x + c[2] x²`, without cancellation.
pub(crate) fn quadratic_roots(c: [f64; 3]) -> SmallVec<[f64; 3]> {
    let mut roots = SmallVec::<[f64; 3]>::new();
    let half = 0.5 * c[1];
    let discriminant = half * half - c[0] * c[2];
    if !(discriminant >= 0.0) {
        return roots;
    }
    let q = -(half + discriminant.sqrt().copysign(half));
    if c[2] != 0.0 {
        roots.push(q / c[2]);
    }
    if q != 0.0 {
        roots.push(c[0] / q);
    }
    roots.retain(|root| root.is_finite());
    roots
}

/// Real roots of `c[0] + c[1] x + c[2] x² + c[3] x³`: the outermost by Newton's method from beyond it, where it can't
/// overshoot (Deiters & Macías-Salinas 2014), the others of what is left. No transcendental functions, so that the bits are the
/// same on any processor.
pub(crate) fn cubic_roots(c: [f64; 4]) -> SmallVec<[f64; 3]> {
    let largest = c.iter().fold(0.0, |m: f64, value| m.max(value.abs()));
    if !(c[3].abs() > 1e-14 * largest) {
        return quadratic_roots([c[0], c[1], c[2]]);
    }
    let [c0, c1, c2] = [c[0] / c[3], c[1] / c[3], c[2] / c[3]];
    let newton = |x: f64| {
        let value = c0 + x * (c1 + x * (c2 + x));
        let slope = c1 + x * (2.0 * c2 + 3.0 * x);
        let next = x - value / slope;
        if next.is_finite() { next } else { x }
    };
    let outermost = outermost_root([c0, c1, c2], newton);
    // Divided by `x - root` from the side that loses fewer digits.
    let linear = c2 + outermost;
    let constant = if outermost.abs() > 1.0 { -c0 / outermost } else { c1 + outermost * linear };
    let mut roots = quadratic_roots([constant, linear, 1.0]);
    for root in &mut roots {
        *root = newton(newton(*root));
    }
    roots.push(outermost);
    roots.retain(|root| root.is_finite());
    roots
}

/// The root of a monic cubic farthest from its point of inflection.
fn outermost_root(c: [f64; 3], newton: impl Fn(f64) -> f64) -> f64 {
    const MAX_STEPS: usize = 60;
    let [c0, c1, c2] = c;
    let inflection = -c2 / 3.0;
    let at_inflection = c0 + inflection * (c1 + inflection * (c2 + inflection));
    let discriminant = c2 * c2 - 3.0 * c1;
    // With two extrema the root lies beyond the one on its side, at least here; with none, not beyond the cube root of the value.
    let reach = match discriminant > 0.0 {
        true => (2.0 / 3.0) * discriminant.sqrt(),
        false => above_cube_root(at_inflection.abs()),
    };
    let mut x = inflection - reach.copysign(at_inflection);
    for _ in 0..MAX_STEPS {
        let next = newton(x);
        let done = (next - x).abs() <= 1e-15 * (1.0 + x.abs());
        x = next;
        if done {
            break;
        }
    }
    x
}

/// A little more than the cube root of a positive number: a third of its exponent, by its bits.
fn above_cube_root(value: f64) -> f64 {
    const BIAS: u64 = 0x2a9f_7893_0000_0000;
    if value > 0.0 && value.is_finite() { 1.1 * f64::from_bits(value.to_bits() / 3 + BIAS) } else { 0.0 }
}

/// Real roots of a polynomial of degree 10, isolated by Sturm's theorem (1829) and polished by safeguarded Newton steps.
///
/// Roots outside [-1, 1] are found as inverses of those of the reversed polynomial, so that all work is well scaled.
pub(crate) fn degree_ten_roots(c: &[f64; 11]) -> SmallVec<[f64; 10]> {
    /// Inverse of the largest root that is looked for.
    const TINY: f64 = 1e-12;
    let mut roots = SmallVec::new();
    let largest = c.iter().fold(0.0, |m: f64, value| m.max(value.abs()));
    if !(largest > 0.0 && largest.is_finite()) {
        return roots;
    }
    let inside = c.map(|value| value / largest);
    let mut outside = inside;
    outside.reverse();
    let chain = SturmChain::new(&inside);
    let at = |x: f64| chain.sign_changes(x);
    let (below, above) = (at(-1.0), at(1.0));
    let mut brackets = SmallVec::new();
    isolate(&inside, &at, (-1.0, below), (1.0, above), &mut brackets);
    let num_inside = brackets.len();
    // In w = 1 / x the count falls where it grows in x.
    let at_inverse = |w: f64| MEMBERS - chain.sign_changes(1.0 / w);
    let (lowest, highest) = (chain.sign_changes_at_infinity(-1.0), chain.sign_changes_at_infinity(1.0));
    isolate(&outside, &at_inverse, (-1.0, MEMBERS - below), (-TINY, MEMBERS - lowest), &mut brackets);
    isolate(&outside, &at_inverse, (TINY, MEMBERS - highest), (1.0, MEMBERS - above), &mut brackets);
    for (chunk, brackets) in brackets.chunks(ROOTS).enumerate() {
        for (lane, root) in polish(brackets).into_iter().enumerate() {
            match root {
                Some(root) if chunk * ROOTS + lane < num_inside => roots.push(root),
                Some(w) if w.abs() < 1.0 && w != 0.0 => roots.push(1.0 / w),
                _ => {}
            }
        }
    }
    roots.retain(|root| root.is_finite());
    roots
}

/// Where a polynomial has one root.
struct Bracket<'a> {
    polynomial: &'a [f64; 11],
    low: f64,
    high: f64,
}

/// Bisects until each part holds one root of `c`; ends come with their sign changes.
fn isolate<'a>(
    c: &'a [f64; 11],
    sign_changes: &impl Fn(f64) -> usize,
    low: (f64, usize),
    high: (f64, usize),
    brackets: &mut SmallVec<[Bracket<'a>; 10]>,
) {
    let count = low.1.saturating_sub(high.1);
    if count == 0 {
        return;
    }
    if count == 1 || high.0 - low.0 < 1e-12 {
        brackets.push(Bracket { polynomial: c, low: low.0, high: high.0 });
        return;
    }
    let middle = 0.5 * (low.0 + high.0);
    let middle = (middle, sign_changes(middle));
    isolate(c, sign_changes, low, middle, brackets);
    isolate(c, sign_changes, middle, high, brackets);
}

/// Members of a chain: that of degree ten, its derivative, and remainders.
const MEMBERS: usize = 11;
/// Members that are evaluated together, with empty ones.
const LANES: usize = 12;

/// Sturm's chain of a polynomial.
struct SturmChain {
    /// By power, then by member, so that all members are evaluated side by side.
    coefficients: [[f64; LANES]; 11],
    degrees: [usize; MEMBERS],
    len: usize,
}

impl SturmChain {
    fn new(c: &[f64; 11]) -> Self {
        let mut members = [[0.0; 11]; MEMBERS];
        let mut degrees = [0; MEMBERS];
        let mut degree = 10;
        while degree > 0 && c[degree].abs() < 1e-15 {
            degree -= 1;
        }
        (members[0], degrees[0]) = (scaled(*c, degree), degree);
        let mut len = 1;
        if degree > 0 {
            let derivative =
                std::array::from_fn(|i| if i < degree { c[i + 1] * (i + 1) as f64 } else { 0.0 });
            (members[1], degrees[1]) = (scaled(derivative, degree - 1), degree - 1);
            len = 2;
        }
        while len < MEMBERS && degrees[len - 1] > 0 {
            let (remainder, degree) =
                negated_remainder(&members[len - 2], degrees[len - 2], &members[len - 1], degrees[len - 1]);
            if remainder[..=degree].iter().all(|value| value.abs() < 1e-15) {
                break;
            }
            (members[len], degrees[len]) = (scaled(remainder, degree), degree);
            len += 1;
        }
        let mut coefficients = [[0.0; LANES]; 11];
        for (lane, (member, degree)) in members.iter().zip(degrees).enumerate().take(len) {
            for power in 0..=degree {
                coefficients[power][lane] = member[power];
            }
        }
        Self { coefficients, degrees, len }
    }

    fn sign_changes(&self, x: f64) -> usize {
        let mut values = [0.0; LANES];
        for row in self.coefficients.iter().rev() {
            for lane in 0..LANES {
                values[lane] = values[lane] * x + row[lane];
            }
        }
        let (mut changes, mut last) = (0, 0.0);
        for &value in &values[..self.len] {
            if value != 0.0 {
                changes += usize::from(value * last < 0.0);
                last = value.signum();
            }
        }
        changes
    }

    /// Of the leading terms as `sign` times infinity is approached.
    fn sign_changes_at_infinity(&self, sign: f64) -> usize {
        let (mut changes, mut last) = (0, 0.0);
        for lane in 0..self.len {
            let degree = self.degrees[lane];
            let odd = if degree % 2 == 1 { sign } else { 1.0 };
            let value = self.coefficients[degree][lane] * odd;
            if value != 0.0 {
                changes += usize::from(value * last < 0.0);
                last = value.signum();
            }
        }
        changes
    }
}

/// Scaled to largest coefficient one (a positive factor keeps all signs).
fn scaled(member: [f64; 11], degree: usize) -> [f64; 11] {
    let largest = member[..=degree].iter().fold(0.0, |m: f64, value| m.max(value.abs()));
    let factor = 1.0 / largest;
    if largest > 0.0 && factor.is_finite() { member.map(|value| value * factor) } else { member }
}

/// Minus the remainder of a polynomial by one of lower degree, with its degree.
fn negated_remainder(
    dividend: &[f64; 11],
    dividend_degree: usize,
    divisor: &[f64; 11],
    divisor_degree: usize,
) -> ([f64; 11], usize) {
    let mut rest = *dividend;
    let inverse = 1.0 / divisor[divisor_degree];
    for top in (divisor_degree..=dividend_degree).rev() {
        let factor = rest[top] * inverse;
        for i in 0..=divisor_degree {
            rest[top - divisor_degree + i] -= factor * divisor[i];
        }
        rest[top] = 0.0;
    }
    let mut degree = divisor_degree.saturating_sub(1);
    let largest = rest[..=degree].iter().fold(0.0, |m: f64, value| m.max(value.abs()));
    while degree > 0 && rest[degree].abs() < 1e-13 * largest {
        degree -= 1;
    }
    (rest.map(|value| -value), degree)
}

/// Roots that are polished side by side: each is a chain of operations that wait for each other.
const ROOTS: usize = 8;

/// The roots between bounds of different sign by Newton's method, with bisection whenever it leaves them. As many as there are
/// brackets, in their order, at most [`ROOTS`].
fn polish(brackets: &[Bracket<'_>]) -> SmallVec<[Option<f64>; ROOTS]> {
    let mut c = [[0.0; ROOTS]; 11];
    let (mut low, mut high) = ([0.0; ROOTS], [0.0; ROOTS]);
    for (lane, bracket) in brackets.iter().enumerate().take(ROOTS) {
        (low[lane], high[lane]) = (bracket.low, bracket.high);
        for (row, value) in c.iter_mut().zip(bracket.polynomial) {
            row[lane] = *value;
        }
    }
    let (at_low, at_high) = (evaluate(&c, &low).0, evaluate(&c, &high).0);
    let ends = |lane: usize| -> Option<Option<f64>> {
        let (low, high) = (low[lane], high[lane]);
        if at_low[lane] == 0.0 {
            Some(Some(low))
        } else if at_high[lane] == 0.0 {
            Some(Some(high))
        } else if at_low[lane] * at_high[lane] > 0.0 {
            // A double root that rounding made two: its middle is as good as any.
            Some((high - low < 1e-10).then_some(0.5 * (low + high)))
        } else {
            None
        }
    };
    let at_ends: [_; ROOTS] = std::array::from_fn(ends);
    let x = newton_on_path(&c, &at_low, (low, high), at_ends.map(|found| found.is_some()));
    (0..brackets.len().min(ROOTS)).map(|lane| at_ends[lane].unwrap_or(Some(x[lane]))).collect()
}

/// [`newton`] by wider registers where the processor has them: the same operations, hence the same bits.
fn newton_on_path(
    c: &[[f64; ROOTS]; 11],
    at_low: &[f64; ROOTS],
    bounds: ([f64; ROOTS], [f64; ROOTS]),
    done: [bool; ROOTS],
) -> [f64; ROOTS] {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx2")]
        fn with_avx2(
            c: &[[f64; ROOTS]; 11],
            at_low: &[f64; ROOTS],
            bounds: ([f64; ROOTS], [f64; ROOTS]),
            done: [bool; ROOTS],
        ) -> [f64; ROOTS] {
            newton(c, at_low, bounds, done)
        }
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2, as was just found.
            return unsafe { with_avx2(c, at_low, bounds, done) };
        }
    }
    newton(c, at_low, bounds, done)
}

/// Newton's method in every lane that is not done.
#[inline(always)]
fn newton(
    c: &[[f64; ROOTS]; 11],
    at_low: &[f64; ROOTS],
    (mut low, mut high): ([f64; ROOTS], [f64; ROOTS]),
    mut done: [bool; ROOTS],
) -> [f64; ROOTS] {
    let mut x: [f64; ROOTS] = std::array::from_fn(|lane| 0.5 * (low[lane] + high[lane]));
    for _ in 0..60 {
        let (value, slope) = evaluate(c, &x);
        for l in 0..ROOTS {
            let is_low = value[l] * at_low[l] > 0.0;
            low[l] = if is_low { x[l] } else { low[l] };
            high[l] = if is_low { high[l] } else { x[l] };
            let newton = x[l] - value[l] / slope[l];
            let middle = 0.5 * (low[l] + high[l]);
            let next = if newton > low[l] && newton < high[l] { newton } else { middle };
            // Newton's next step would be its square.
            let is_near = (next - x[l]).abs() <= 1e-9 * (1.0 + x[l].abs());
            x[l] = if done[l] { x[l] } else { next };
            done[l] |= is_near;
        }
        if done == [true; ROOTS] {
            break;
        }
    }
    x
}

/// The values and the slopes of the polynomial in each lane.
#[inline(always)]
fn evaluate(c: &[[f64; ROOTS]; 11], x: &[f64; ROOTS]) -> ([f64; ROOTS], [f64; ROOTS]) {
    let (mut value, mut slope) = ([0.0; ROOTS], [0.0; ROOTS]);
    for row in c.iter().rev() {
        for l in 0..ROOTS {
            slope[l] = slope[l] * x[l] + value[l];
            value[l] = value[l] * x[l] + row[l];
        }
    }
    (value, slope)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::Random;

    /// The coefficients of the product of `x - root` over the roots.
    fn from_roots<const N: usize>(roots: &[f64]) -> [f64; N] {
        let mut c = [0.0; N];
        c[0] = 1.0;
        for (degree, root) in roots.iter().enumerate() {
            for i in (0..=degree + 1).rev() {
                c[i] = if i > 0 { c[i - 1] } else { 0.0 } - root * c[i];
            }
        }
        c
    }

    fn assert_roots(mut found: Vec<f64>, mut truth: Vec<f64>, tolerance: f64) {
        found.sort_by(f64::total_cmp);
        truth.sort_by(f64::total_cmp);
        assert_eq!(found.len(), truth.len(), "{found:?} {truth:?}");
        for (a, b) in found.iter().zip(&truth) {
            assert!((a - b).abs() < tolerance * (1.0 + b.abs()), "{found:?} {truth:?}");
        }
    }

    #[test]
    fn cubics_and_quadratics_give_their_roots_back() {
        let mut random = Random::new("cubic");
        for _ in 0..1000 {
            let truth: Vec<f64> = (0..3).map(|i| f64::from(i) + random.uniform(-0.4, 0.4)).collect();
            let c: [f64; 4] = from_roots(&truth);
            let gain = random.uniform(-5.0, 5.0);
            assert_roots(cubic_roots(c.map(|value| value * gain)).to_vec(), truth.clone(), 1e-10);
            let c: [f64; 3] = from_roots(&truth[..2]);
            assert_roots(quadratic_roots(c).to_vec(), truth[..2].to_vec(), 1e-10);
        }
        assert_roots(cubic_roots([-8.0, 0.0, 0.0, 1.0]).to_vec(), vec![2.0], 1e-12);
        assert_roots(cubic_roots([-4.0, 0.0, 1.0, 0.0]).to_vec(), vec![-2.0, 2.0], 1e-12);
        assert_roots(quadratic_roots([-4.0, 2.0, 0.0]).to_vec(), vec![2.0], 1e-12);
        assert!(quadratic_roots([1.0, 0.0, 1.0]).is_empty());
        assert!(cubic_roots([f64::NAN; 4]).is_empty() && cubic_roots([0.0; 4]).is_empty());
    }

    #[test]
    fn all_real_roots_of_degree_ten_are_found() {
        let mut random = Random::new("sturm");
        for _ in 0..500 {
            let truth: Vec<f64> =
                (0..10).map(|i| 0.35 * (f64::from(i) - 4.5) + random.uniform(-0.1, 0.1)).collect();
            assert_roots(degree_ten_roots(&from_roots(&truth)).to_vec(), truth, 1e-6);
        }
    }

    #[test]
    fn both_compilations_polish_to_the_same_bits() {
        let mut random = Random::new("polish");
        for _ in 0..200 {
            let c: [[f64; ROOTS]; 11] =
                std::array::from_fn(|_| std::array::from_fn(|_| random.uniform(-1.0, 1.0)));
            let bounds: [[f64; ROOTS]; 2] =
                [-1.0, 0.3].map(|low| std::array::from_fn(|_| random.uniform(low, low + 0.7)));
            let at_low = evaluate(&c, &bounds[0]).0;
            let done = std::array::from_fn(|lane| lane == 3);
            let plain = newton(&c, &at_low, (bounds[0], bounds[1]), done);
            let found = newton_on_path(&c, &at_low, (bounds[0], bounds[1]), done);
            assert_eq!(plain.map(f64::to_bits), found.map(f64::to_bits));
        }
    }

    #[test]
    fn complex_pairs_are_left_out_and_far_roots_found() {
        let mut random = Random::new("sturm complex");
        for _ in 0..500 {
            let truth: Vec<f64> = vec![random.uniform(-60.0, -20.0), random.uniform(-0.9, 0.9), 3.0, 1.5];
            let mut c: [f64; 11] = from_roots(&truth);
            for _ in 0..3 {
                // Times x² + b x + c without real roots.
                let b = random.uniform(-1.0, 1.0);
                let old = c;
                c = std::array::from_fn(|i| {
                    let at = |k: usize| if i >= k { old[i - k] } else { 0.0 };
                    at(2) + b * at(1) + 1.3 * at(0)
                });
            }
            assert_roots(degree_ten_roots(&c).to_vec(), truth, 1e-7);
        }
        assert!(degree_ten_roots(&[f64::NAN; 11]).is_empty() && degree_ten_roots(&[0.0; 11]).is_empty());
        let mut constant = [0.0; 11];
        constant[0] = 3.0;
        assert!(degree_ten_roots(&constant).is_empty());
    }
}
