//! Which matches turn and grow as most do (weak geometric consistency: Jégou, Douze & Schmid 2008).
//!
//! Between two views of one scene most keypoints turn by about the same angle and grow by about the same factor; those of
//! wrong matches do so by chance. Matches that agree are likelier to be right than the ratio of their distances tells, so that
//! samples are drawn from them first; and where no more agree than by chance, hardly anything is to be found.

use std::f32::consts::TAU;

use terrane_scene::Keypoint;

/// Bins of a whole turn, and how many of them are one direction: 60 degrees.
const TURNS: usize = 24;
const SAME_TURN: usize = 4;
/// Bins of growth, four to a doubling, from a sixteenth to sixteenfold; a doubling is one growth.
const GROWTHS: usize = 32;
const SAME_GROWTH: usize = 4;
/// By how many standard deviations of chance more matches must agree. The best of all windows of nothing but chance reaches
/// half of that more often than not.
const SIGNIFICANT: f64 = 4.0;

/// Whether each match agrees with most; `None` when no more of them agree than may do so by chance.
pub(super) fn agreeing(pairs: &[(&Keypoint, &Keypoint)]) -> Option<Vec<bool>> {
    let edges = growth_edges();
    let bins: Vec<(usize, usize)> = pairs.iter().map(|(a, b)| (turn(a, b), growth(a, b, &edges))).collect();
    let mut counts = [[0_u32; GROWTHS]; TURNS];
    for &(turn, growth) in &bins {
        counts[turn][growth] += 1;
    }
    let count = |turn: usize, growth: usize| -> u32 {
        let turns = (turn..turn + SAME_TURN).map(|turn| turn % TURNS);
        turns.map(|turn| counts[turn][growth..growth + SAME_GROWTH].iter().sum::<u32>()).sum()
    };
    let windows = (0..TURNS).flat_map(|turn| (0..=GROWTHS - SAME_GROWTH).map(move |growth| (turn, growth)));
    // The first of those with the most.
    let (most, turn, growth) = windows.fold((0, 0, 0), |best, (turn, growth)| {
        let count = count(turn, growth);
        if count > best.0 { (count, turn, growth) } else { best }
    });
    // Wrong matches grow alike too, for there are more fine blobs than coarse ones, but they turn by any angle.
    let grown: u32 = counts.iter().map(|row| row[growth..growth + SAME_GROWTH].iter().sum::<u32>()).sum();
    let by_chance = f64::from(grown) * SAME_TURN as f64 / TURNS as f64;
    if f64::from(most) <= by_chance + SIGNIFICANT * by_chance.sqrt() {
        return None;
    }
    let agrees = |&(t, g): &(usize, usize)| {
        (t + TURNS - turn) % TURNS < SAME_TURN && (growth..growth + SAME_GROWTH).contains(&g)
    };
    Some(bins.iter().map(agrees).collect())
}

fn turn(a: &Keypoint, b: &Keypoint) -> usize {
    let turns = ((b.orientation_rad - a.orientation_rad) / TAU).rem_euclid(1.0);
    // Not a number goes to the first; rounding may give a whole turn.
    ((turns * TURNS as f32) as usize).min(TURNS - 1)
}

fn growth(a: &Keypoint, b: &Keypoint, edges: &[f32; GROWTHS - 1]) -> usize {
    let ratio = b.scale_px / a.scale_px;
    edges.partition_point(|edge| *edge <= ratio)
}

/// The factors between neighbouring bins, ascending; the middle one is one.
fn growth_edges() -> [f32; GROWTHS - 1] {
    const QUARTER: f32 = 1.189_207_1;
    let mut edges = [1.0; GROWTHS - 1];
    let middle = (GROWTHS - 1) / 2;
    for k in 1..=middle {
        edges[middle + k] = edges[middle + k - 1] * QUARTER;
        edges[middle - k] = edges[middle - k + 1] / QUARTER;
    }
    edges
}

#[cfg(test)]
mod tests {
    use rand::RngExt;
    use terrane_geometry::Seed;

    use super::*;

    fn keypoint(scale_px: f32, orientation_rad: f32) -> Keypoint {
        Keypoint { x_px: 0.0, y_px: 0.0, scale_px, orientation_rad }
    }

    /// Some that turn by `turn_rad` and grow by `growth`, nearly, then some that do as they like.
    fn scene(
        right: usize,
        wrong: usize,
        (turn_rad, growth): (f32, f32),
        seed: u64,
    ) -> Vec<(Keypoint, Keypoint)> {
        let mut rng = Seed(seed).rng();
        let mut any = || rng.random::<f32>();
        (0..right + wrong)
            .map(|k| {
                let (scale, angle) = (1.6 + 8.0 * any() * any(), TAU * (any() - 0.5));
                let second = if k < right {
                    keypoint(scale * growth * (0.9 + 0.2 * any()), angle + turn_rad + 0.4 * (any() - 0.5))
                } else {
                    keypoint(1.6 + 8.0 * any() * any(), TAU * (any() - 0.5))
                };
                (keypoint(scale, angle), second)
            })
            .collect()
    }

    fn of(pairs: &[(Keypoint, Keypoint)]) -> Option<Vec<bool>> {
        agreeing(&pairs.iter().map(|(a, b)| (a, b)).collect::<Vec<_>>())
    }

    #[test]
    fn what_turns_and_grows_alike_is_found_among_three_times_as_much_that_does_not() {
        for (seed, motion) in
            [(0.0, 1.0), (3.1, 1.0), (-1.3, 2.2), (1.9, 0.4), (6.0, 0.7)].into_iter().enumerate()
        {
            let flags = of(&scene(40, 120, motion, seed as u64 + 1)).expect("they agree");
            let right = flags[..40].iter().filter(|f| **f).count();
            let wrong = flags[40..].iter().filter(|f| **f).count();
            assert!(right >= 36 && wrong <= 30, "{motion:?}: {right} {wrong}");
        }
    }

    #[test]
    fn chance_seldom_agrees() {
        let found = (0..200).filter(|seed| of(&scene(0, 90, (0.0, 1.0), *seed)).is_some()).count();
        assert!(found <= 6, "{found}");
    }

    #[test]
    fn features_that_all_stand_upright_agree_and_broken_ones_are_survived() {
        let upright: Vec<_> =
            (0..30).map(|k| (keypoint(2.0 + k as f32 / 100.0, 0.0), keypoint(2.0, 0.0))).collect();
        assert_eq!(of(&upright).map(|flags| flags.iter().filter(|f| **f).count()), Some(30));
        assert_eq!(of(&[]), None);
        let broken = [f32::NAN, f32::INFINITY, 0.0, -1.0, f32::MAX];
        let pairs: Vec<_> = broken
            .iter()
            .flat_map(|a| broken.iter().map(move |b| (keypoint(*a, *b), keypoint(*b, *a))))
            .collect();
        assert!(of(&pairs).is_none_or(|flags| flags.len() == pairs.len()));
    }
}
