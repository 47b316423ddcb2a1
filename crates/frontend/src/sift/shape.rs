//! The affine shape of a blob, and its surroundings as if it were round.
//!
//! A plane that is seen aslant is squeezed along one axis, and what was round is not any more. The shape is the symmetric
//! matrix of determinant one after which gradients are equally strong in all directions; it is found by iteration (Lindeberg &
//! Gårding 1997, Baumberg 2000, Mikolajczyk & Schmid 2004). Orientation and descriptor are then taken from a patch that is
//! sampled through it, so that they are nearly those of the plane seen from the front.

use super::gradient::Place;
use super::math::{cos_sin, exp_f32};
use super::octave::{Plane, Size};
use super::shared::direction_rad;

/// Standard deviation of a blob in pixels of its patch.
const PATCH_SIGMA: f32 = 2.0;
/// From the middle of a patch to its sides: a descriptor's window, turned in any direction.
const PATCH_REACH: usize = 24;
/// The same of the patch that a shape is found in.
const WINDOW_REACH: usize = 9;
/// Standard deviation of the weights in that, in pixels of the patch: one and a half of the blob's.
const WINDOW_SIGMA: f32 = 1.5 * PATCH_SIGMA;

const MAX_ROUNDS: usize = 10;
/// Gradients are equal in all directions when the weakest are this part of the strongest.
const ISOTROPY: f32 = 0.9;
/// A blob that is longer than this times its width is an edge, whose shape says nothing about the view.
const MAX_STRETCH: f32 = 4.0;

/// A symmetric positive matrix of determinant one: offsets in the photograph of offsets in a patch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Shape {
    xx: f32,
    xy: f32,
    yy: f32,
}

impl Shape {
    /// No shape: the surroundings as they are.
    pub(super) const ROUND: Self = Self { xx: 1.0, xy: 0.0, yy: 1.0 };

    /// The shape of a blob; round where it can't be told.
    pub(super) fn of(place: &Place<'_>) -> Self {
        Self::found(place).unwrap_or(Self::ROUND)
    }

    fn found(place: &Place<'_>) -> Option<Self> {
        let mut shape = Self::ROUND;
        let mut patch = Patch::new(WINDOW_REACH);
        for _ in 0..MAX_ROUNDS {
            patch.sample(place, &shape);
            let moments = patch.moments();
            let (small, large) = moments.eigenvalues();
            if !(small > 0.0 && large.is_finite()) {
                return None;
            }
            if small >= ISOTROPY * large {
                return Some(shape);
            }
            shape = shape.after(&moments)?;
            let (small, large) = shape.eigenvalues();
            if !(large <= MAX_STRETCH * small) {
                return None;
            }
        }
        None
    }

    /// What makes gradients with these second moments, seen through this shape, equal in all directions.
    fn after(&self, moments: &Self) -> Option<Self> {
        // The square is A M⁻¹ A; M⁻¹ is that up to a factor, which does not matter.
        let inverse = Self { xx: moments.yy, xy: -moments.xy, yy: moments.xx };
        let Self { xx: a, xy: b, yy: c } = *self;
        let left = (a * inverse.xx + b * inverse.xy, a * inverse.xy + b * inverse.yy);
        let right = (b * inverse.xx + c * inverse.xy, b * inverse.xy + c * inverse.yy);
        let square =
            Self { xx: left.0 * a + left.1 * b, xy: left.0 * b + left.1 * c, yy: right.0 * b + right.1 * c };
        square.root().unit()
    }

    fn determinant(&self) -> f32 {
        self.xx * self.yy - self.xy * self.xy
    }

    /// The positive square root, up to a factor: S + √|S| I (Cayley and Hamilton).
    fn root(&self) -> Self {
        let root = self.determinant().max(0.0).sqrt();
        Self { xx: self.xx + root, xy: self.xy, yy: self.yy + root }
    }

    /// Scaled to determinant one.
    fn unit(&self) -> Option<Self> {
        let size = self.determinant().sqrt();
        let unit = Self { xx: self.xx / size, xy: self.xy / size, yy: self.yy / size };
        (size > 0.0 && [unit.xx, unit.xy, unit.yy].iter().all(|v| v.is_finite())).then_some(unit)
    }

    /// The smaller and the larger one.
    fn eigenvalues(&self) -> (f32, f32) {
        let (middle, half) = (0.5 * (self.xx + self.yy), 0.5 * (self.xx - self.yy));
        let spread = (half * half + self.xy * self.xy).sqrt();
        (middle - spread, middle + spread)
    }

    /// The angle in the photograph of an angle in a patch, both in radians between -π and π.
    pub(super) fn turned(&self, angle_rad: f32) -> f32 {
        if *self == Self::ROUND {
            return angle_rad;
        }
        let (cosine, sine) = cos_sin(f64::from(angle_rad));
        let (x, y) = self.direction((cosine as f32, sine as f32));
        direction_rad(x, y)
    }

    /// Where a direction of a patch points in the photograph.
    fn direction(&self, (x, y): (f32, f32)) -> (f32, f32) {
        (self.xx * x + self.xy * y, self.xy * x + self.yy * y)
    }
}

/// What orientation and descriptor are taken from.
pub(super) enum Surroundings<'a> {
    /// The photograph as it is.
    AsTheyAre(Place<'a>),
    /// As if the blob were round.
    Rounded(Patch),
}

impl<'a> Surroundings<'a> {
    /// Of a blob of some shape.
    pub(super) fn of(place: Place<'a>, shape: &Shape) -> Self {
        if *shape == Shape::ROUND {
            Self::AsTheyAre(place)
        } else {
            Self::Rounded(Patch::around(&place, shape))
        }
    }

    pub(super) fn place(&self) -> Place<'_> {
        match self {
            Self::AsTheyAre(place) => *place,
            Self::Rounded(patch) => patch.place(),
        }
    }
}

/// A square of samples around a blob.
pub(super) struct Patch {
    plane: Plane,
    reach: usize,
}

impl Patch {
    fn new(reach: usize) -> Self {
        let side = 2 * reach + 1;
        let data = vec![0; side * side + Plane::SLACK];
        Self { plane: Plane { size: Size { width: side, height: side }, step: 1, data }, reach }
    }

    /// The surroundings of a blob, seen through its shape.
    pub(super) fn around(place: &Place<'_>, shape: &Shape) -> Self {
        let mut patch = Self::new(PATCH_REACH);
        patch.sample(place, shape);
        patch
    }

    /// Where the blob is in it.
    pub(super) fn place(&self) -> Place<'_> {
        let middle = self.reach as f32;
        Place { plane: &self.plane, x: middle, y: middle, sigma: PATCH_SIGMA }
    }

    /// Interpolates between pixels; those at the borders are repeated.
    fn sample(&mut self, place: &Place<'_>, shape: &Shape) {
        let step = place.sigma / PATCH_SIGMA;
        let side = 2 * self.reach + 1;
        let from_middle = |k: usize| (k as f32 - self.reach as f32) * step;
        let Place { plane, x, y, .. } = place;
        let (width, height) = (plane.size.width, plane.size.height);
        // The last pixel that has one after it; sides have half a dozen pixels at least.
        let (last_x, last_y) = ((width - 2) as f32, (height - 2) as f32);
        for (row, values) in self.plane.data[..side * side].chunks_exact_mut(side).enumerate() {
            for (column, value) in values.iter_mut().enumerate() {
                let (right, down) = shape.direction((from_middle(column), from_middle(row)));
                let (x, y) = ((x + right).max(0.0), (y + down).max(0.0));
                let (left, top) = (x.min(last_x) as usize, y.min(last_y) as usize);
                let (across, along) = ((x - left as f32).min(1.0), (y - top as f32).min(1.0));
                let at = top * width + left;
                let pixel = |at: usize| f32::from(plane.data[at]);
                let between = |at: usize| pixel(at) + (pixel(at + 1) - pixel(at)) * across;
                let (above, below) = (between(at), between(at + width));
                *value = (above + (below - above) * along + 0.5) as u16;
            }
        }
    }

    /// Second moments of the gradients, weighted by a Gaussian.
    fn moments(&self) -> Shape {
        let side = 2 * self.reach + 1;
        let weights: Vec<f32> = (0..side)
            .map(|k| (k as f32 - self.reach as f32) / WINDOW_SIGMA)
            .map(|distance| exp_f32(-0.5 * distance * distance))
            .collect();
        let mut moments = Shape { xx: 0.0, xy: 0.0, yy: 0.0 };
        for row in 1..side - 1 {
            for column in 1..side - 1 {
                let pixel = |at: usize| f32::from(self.plane.data[at]);
                let at = row * side + column;
                let (dx, dy) = (pixel(at + 1) - pixel(at - 1), pixel(at + side) - pixel(at - side));
                let weight = weights[row] * weights[column];
                moments.xx += weight * dx * dx;
                moments.xy += weight * dx * dy;
                moments.yy += weight * dy * dy;
            }
        }
        moments
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A Gaussian blob whose standard deviations are `long` and `short`, the long one at an angle.
    fn blob(long: f32, short: f32, angle: f32) -> Plane {
        let (width, height) = (81, 81);
        let mut data = vec![0; width * height + Plane::SLACK];
        for (k, value) in data[..width * height].iter_mut().enumerate() {
            let (x, y) = ((k % width) as f32 - 40.3, (k / width) as f32 - 39.8);
            let (along, across) = (angle.cos() * x + angle.sin() * y, angle.cos() * y - angle.sin() * x);
            let (along, across) = (along / long, across / short);
            *value = (2000.0 + 40_000.0 * (-0.5 * (along * along + across * across)).exp()) as u16;
        }
        Plane { size: Size { width, height }, step: 1, data }
    }

    fn shape_of(plane: &Plane) -> Shape {
        Shape::of(&Place { plane, x: 40.3, y: 39.8, sigma: 3.0 })
    }

    #[test]
    fn the_shape_of_a_blob_is_its_own() {
        for (long, short) in [(4.0, 3.5), (4.5, 3.0), (5.0, 2.5)] {
            for angle in [0.0_f32, 0.4, 1.2, 2.8] {
                let shape = shape_of(&blob(long, short, angle));
                let (small, large) = shape.eigenvalues();
                assert!((shape.determinant() - 1.0).abs() < 1e-3);
                let ratio = (large / small) / (long / short);
                assert!((0.85..1.1).contains(&ratio), "{long} {short} {angle}: {}", large / small);
                // Along the long axis offsets grow most.
                let (x, y) = shape.direction((angle.cos(), angle.sin()));
                assert!((x.hypot(y) / large - 1.0).abs() < 0.02, "{long} {short} {angle}: {shape:?}");
            }
        }
    }

    #[test]
    fn what_is_round_stays_as_it_is_and_edges_have_no_shape() {
        assert_eq!(shape_of(&blob(3.0, 3.0, 0.0)), Shape::ROUND);
        assert_eq!(shape_of(&blob(30.0, 2.0, 0.7)), Shape::ROUND);
        let level =
            Plane { size: Size { width: 81, height: 81 }, step: 1, data: vec![7000; 81 * 81 + Plane::SLACK] };
        assert_eq!(shape_of(&level), Shape::ROUND);
    }

    #[test]
    fn a_patch_shows_a_squeezed_blob_as_a_round_one() {
        let plane = blob(5.0, 2.5, 0.4);
        let place = Place { plane: &plane, x: 40.3, y: 39.8, sigma: 3.0 };
        let seen = Patch::around(&place, &shape_of(&plane));
        let again = Shape::of(&seen.place());
        let (small, large) = again.eigenvalues();
        assert!(large / small < 1.15, "{again:?}");
        assert_eq!(Shape::ROUND.turned(0.3), 0.3);
    }

    #[test]
    fn places_at_the_border_and_beyond_are_survived() {
        let plane = blob(5.0, 2.5, 0.4);
        for (x, y) in [(0.0, 0.0), (80.0, 80.0), (-3.0, 90.0), (40.0, 80.9)] {
            let place = Place { plane: &plane, x, y, sigma: 4.0 };
            let shape = Shape::of(&place);
            assert!((shape.determinant() - 1.0).abs() < 1e-3);
            let patch = Patch::around(&place, &shape);
            let samples = &patch.plane.data[..(2 * PATCH_REACH + 1) * (2 * PATCH_REACH + 1)];
            assert!(samples.iter().all(|value| (2000..=42_000).contains(value)), "({x}, {y})");
        }
    }
}
