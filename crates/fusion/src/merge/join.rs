//! Which points of different submaps are one.

use nalgebra::Vector3;
use terrane_scene::{ImageId, Observation, Reconstruction};

use super::{MergeOptions, MergeReport};

/// A point of a submap, in the world.
pub(super) struct WorldPoint {
    /// Number of the submap, in the order that they were given.
    pub(super) submap: u32,
    /// Place in the submap's points.
    pub(super) point: u32,
    pub(super) x_in_world: Vector3<f64>,
}

/// Two points that own a common observation.
struct Candidate {
    a: u32,
    b: u32,
    /// How many observations they have in common.
    common: u32,
    /// A camera that sees both.
    image: ImageId,
}

/// Sets of points with the observations of each.
pub(super) struct JoinedTracks {
    parent: Vec<u32>,
    /// Observations of each root, ascending by (image, feature); empty for others.
    tracks: Vec<Vec<Observation>>,
}

/// Joins points that own common observations: most in common first, so that a conflict costs the weaker link.
///
/// A join is refused when a shared camera sees the points too far apart, or when the joint track would own two
/// features of one image.
pub(super) fn join(
    submaps: &[&Reconstruction],
    points: &[WorldPoint],
    center_of: &dyn Fn(ImageId) -> Option<Vector3<f64>>,
    options: &MergeOptions,
    report: &mut MergeReport,
) -> JoinedTracks {
    let mut joined = JoinedTracks::new(submaps, points);
    for candidate in candidates(&joined.tracks) {
        let (a, b) = (joined.root(candidate.a), joined.root(candidate.b));
        if a == b {
            continue;
        }
        let (x_a, x_b) = (points[candidate.a as usize].x_in_world, points[candidate.b as usize].x_in_world);
        let near = center_of(candidate.image).is_none_or(|center| is_near(&center, &x_a, &x_b, options));
        if !near {
            report.num_too_far += 1;
        } else if joined.conflict(a, b) {
            report.num_conflicts += 1;
        } else {
            joined.unite(a, b);
            report.num_joined += 1;
        }
    }
    joined
}

fn is_near(center: &Vector3<f64>, x_a: &Vector3<f64>, x_b: &Vector3<f64>, options: &MergeOptions) -> bool {
    let (ray_a, ray_b) = (x_a - center, x_b - center);
    let ratio = ray_a.norm() / ray_b.norm();
    let max_ratio = options.max_depth_ratio.max(1.0);
    ray_a.angle(&ray_b) <= options.max_angle_deg.to_radians()
        && ratio <= max_ratio
        && ratio >= 1.0 / max_ratio
}

/// Pairs of points with common observations, most in common first, ties by the points.
fn candidates(tracks: &[Vec<Observation>]) -> Vec<Candidate> {
    let mut owners: Vec<(ImageId, u32, u32)> = Vec::with_capacity(tracks.iter().map(Vec::len).sum());
    for (point, track) in tracks.iter().enumerate() {
        owners.extend(track.iter().map(|seen| (seen.image, seen.feature, point as u32)));
    }
    owners.sort_unstable();
    let mut pairs: Vec<(u32, u32, ImageId)> = owners
        .windows(2)
        .filter(|pair| (pair[0].0, pair[0].1) == (pair[1].0, pair[1].1) && pair[0].2 != pair[1].2)
        .map(|pair| (pair[0].2, pair[1].2, pair[0].0))
        .collect();
    drop(owners);
    pairs.sort_unstable();
    let mut candidates: Vec<Candidate> = Vec::new();
    for (a, b, image) in pairs {
        match candidates.last_mut() {
            Some(last) if (last.a, last.b) == (a, b) => last.common += 1,
            _ => candidates.push(Candidate { a, b, common: 1, image }),
        }
    }
    candidates.sort_by_key(|candidate| (std::cmp::Reverse(candidate.common), candidate.a, candidate.b));
    candidates
}

impl JoinedTracks {
    fn new(submaps: &[&Reconstruction], points: &[WorldPoint]) -> Self {
        let tracks = points
            .iter()
            .map(|at| {
                let submap = submaps[at.submap as usize];
                let mut track = submap.track(&submap.points[at.point as usize]).to_vec();
                track.sort_unstable_by_key(|seen| (seen.image, seen.feature));
                track
            })
            .collect();
        Self { parent: (0..points.len() as u32).collect(), tracks }
    }

    /// The point that stands for the set of another.
    pub(super) fn root(&mut self, point: u32) -> u32 {
        let mut at = point;
        while self.parent[at as usize] != at {
            let up = self.parent[self.parent[at as usize] as usize];
            self.parent[at as usize] = up;
            at = up;
        }
        at
    }

    /// The observations of a root, to take away.
    pub(super) fn take_track(&mut self, root: u32) -> Vec<Observation> {
        std::mem::take(&mut self.tracks[root as usize])
    }

    /// Whether two tracks own different features of one image.
    fn conflict(&self, a: u32, b: u32) -> bool {
        let (track_a, track_b) = (&self.tracks[a as usize], &self.tracks[b as usize]);
        let mut at = 0;
        for seen in track_a {
            while at < track_b.len() && track_b[at].image < seen.image {
                at += 1;
            }
            if at < track_b.len() && track_b[at].image == seen.image && track_b[at].feature != seen.feature {
                return true;
            }
        }
        false
    }

    fn unite(&mut self, a: u32, b: u32) {
        let (root, other) = (a.min(b), a.max(b));
        self.parent[other as usize] = root;
        let moved = std::mem::take(&mut self.tracks[other as usize]);
        let track = &mut self.tracks[root as usize];
        track.extend(moved);
        track.sort_unstable_by_key(|seen| (seen.image, seen.feature));
        track.dedup_by_key(|seen| (seen.image, seen.feature));
    }
}
