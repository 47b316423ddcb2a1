//! One similarity per submap, from all seams and all satellite positions together.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use terrane_geometry::{Seed, Sim3, so3};
use terrane_optim::sim3_graph::{self, Sim3Edge, Sim3GraphOptions};
use terrane_scene::{ImageId, RegisteredImage};

use super::{PlaceOptions, PlacedComponent, PlacedSeam, Placement, fuse, tree};
use crate::SubmapSummary;
use crate::align::{Seam, SeamVerdict};
use crate::georegister::{GeoOutcome, LocalPosition, register, residuals};

/// Rounds of solving and judging; each may switch seams off.
const MAX_ROUNDS: usize = 8;

/// A seam that may be used.
#[derive(Clone)]
pub(super) struct UsableSeam {
    /// Its place in the input.
    pub(super) at: usize,
    pub(super) a: u32,
    pub(super) b: u32,
    pub(super) edge: Sim3Edge,
    /// Shared points that agreed: how strong it is.
    pub(super) strength: f64,
    /// Where the submaps meet, in a.
    pub(super) middle_in_a: Vector3<f64>,
    /// Median depth, in units of b.
    pub(super) depth_in_b: f64,
}

/// Places submaps by one joint robust solve per component over all its seams, then again together with satellite
/// positions where they can carry a geo-reference.
///
/// Seams that contradict the cycles they close are switched off one by one, the worst first, each with the reason;
/// a component that falls apart by that becomes several. A spanning tree gives only the start. A submap without any
/// seam is a component of its own.
pub fn place(
    submaps: &[SubmapSummary],
    seams: &[Seam],
    positions: &[LocalPosition],
    options: &PlaceOptions,
    seed: Seed,
) -> Placement {
    let mut placed: Vec<PlacedSeam> =
        seams.iter().map(|seam| PlacedSeam { a: seam.a, b: seam.b, ..Default::default() }).collect();
    let mut used = usable_seams(submaps, seams, &mut placed);
    let mut world_from_submap = vec![Sim3::identity(); submaps.len()];
    for _ in 0..MAX_ROUNDS.max(seams.len()) {
        world_from_submap = solve_seams(submaps, &used);
        let worst = worst_seam(&used, &world_from_submap, options);
        let Some((index, reason)) = worst else { break };
        placed[used[index].at].refused = Some(reason);
        used.remove(index);
    }
    let mut members = tree::components(submaps.len(), &used);
    let size = |submaps_of: &Vec<u32>| distinct_images(submaps, submaps_of);
    members.sort_by_key(|submaps_of| (std::cmp::Reverse(size(submaps_of)), submaps_of[0]));
    let mut placement = Placement { component_of: vec![0; submaps.len()], ..Default::default() };
    for (number, submaps_of) in members.into_iter().enumerate() {
        submaps_of.iter().for_each(|submap| placement.component_of[*submap as usize] = number as u32);
        let num_images = distinct_images(submaps, &submaps_of);
        let seed = seed.item(&[u64::from(submaps_of[0])]);
        let geo = bring_home(submaps, &submaps_of, &used, positions, &mut world_from_submap, (options, seed));
        placement.components.push(PlacedComponent { submaps: submaps_of, num_images, geo });
    }
    for (seam, input) in placed.iter_mut().zip(seams) {
        if let SeamVerdict::Accepted { b_from_a, .. } = &input.outcome.verdict {
            let same = placement.component_of[input.a as usize] == placement.component_of[input.b as usize];
            if same && let Some(usable) = usable(submaps, 0, input, b_from_a) {
                fill_residual(seam, &usable, &world_from_submap);
            }
        }
    }
    placement.world_from_submap = world_from_submap;
    placement.seams = placed;
    placement
}

/// Accepted seams in the form that the solver reads; the others are marked as refused.
fn usable_seams(submaps: &[SubmapSummary], seams: &[Seam], placed: &mut [PlacedSeam]) -> Vec<UsableSeam> {
    let mut used = Vec::new();
    for (at, seam) in seams.iter().enumerate() {
        match &seam.outcome.verdict {
            SeamVerdict::Refused { reason } => placed[at].refused = Some(reason.clone()),
            SeamVerdict::Accepted { b_from_a, .. } => match usable(submaps, at, seam, b_from_a) {
                Some(usable) => used.push(usable),
                None => placed[at].refused = Some("it names submaps that are not there, or numbers that are not finite".to_owned()),
            },
        }
    }
    used
}

fn usable(submaps: &[SubmapSummary], at: usize, seam: &Seam, b_from_a: &Sim3) -> Option<UsableSeam> {
    let (_, information) = seam.outcome.accepted()?;
    let (a, b) = (submaps.get(seam.a as usize)?, submaps.get(seam.b as usize)?);
    let finite = b_from_a.scale > 0.0
        && b_from_a.scale.is_finite()
        && b_from_a.translation.iter().chain(b_from_a.rotation.coords.iter()).all(|value| value.is_finite())
        && information.iter().all(|value| value.is_finite());
    if seam.a == seam.b || !finite {
        return None;
    }
    let shared: Vec<Vector3<f64>> =
        a.centers().filter(|(image, _)| b.cam_from_submap(*image).is_some()).map(|(_, center)| center).collect();
    let middle_in_a = match shared.len() {
        0 => a.centers().map(|(_, center)| center).next()?,
        count => shared.iter().sum::<Vector3<f64>>() / count as f64,
    };
    Some(UsableSeam {
        at,
        a: seam.a,
        b: seam.b,
        edge: Sim3Edge { from: seam.a, to: seam.b, to_from_from: *b_from_a, information: *information },
        strength: f64::from(seam.outcome.evidence.num_inliers.max(1)),
        middle_in_a,
        depth_in_b: b.median_depth.max(f64::MIN_POSITIVE),
    })
}

/// The joint robust solve of all components, each from a spanning tree of its strongest and best confirmed seams.
fn solve_seams(submaps: &[SubmapSummary], used: &[UsableSeam]) -> Vec<Sim3> {
    let initial = tree::spread(submaps, used);
    let edges: Vec<Sim3Edge> = used.iter().map(|seam| seam.edge.clone()).collect();
    sim3_graph::solve(&initial, &edges, &[], &Sim3GraphOptions::default()).world_from_node
}

/// What a seam leaves over under a placement.
struct LeftOver {
    rotation_deg: f64,
    distance: f64,
    relative_distance: f64,
    scale: f64,
}

fn left_over(seam: &UsableSeam, world_from_submap: &[Sim3]) -> LeftOver {
    let (world_from_a, world_from_b) = (world_from_submap[seam.a as usize], world_from_submap[seam.b as usize]);
    let through_seam = world_from_b * seam.edge.to_from_from;
    let distance = (through_seam.transform_point(&seam.middle_in_a)
        - world_from_a.transform_point(&seam.middle_in_a))
    .norm();
    LeftOver {
        rotation_deg: so3::angle_between(&through_seam.rotation, &world_from_a.rotation).to_degrees(),
        distance,
        relative_distance: distance / (world_from_b.scale * seam.depth_in_b),
        scale: (through_seam.scale / world_from_a.scale).ln().abs().exp() - 1.0,
    }
}

fn fill_residual(placed: &mut PlacedSeam, seam: &UsableSeam, world_from_submap: &[Sim3]) {
    let left = left_over(seam, world_from_submap);
    placed.rotation_deg = left.rotation_deg;
    placed.distance = left.distance;
    placed.relative_distance = left.relative_distance;
    placed.scale = left.scale;
}

/// The seam that disagrees most with the joint solution, beyond what a right one may; and why.
fn worst_seam(used: &[UsableSeam], world_from_submap: &[Sim3], options: &PlaceOptions) -> Option<(usize, String)> {
    let mut worst: Option<(f64, usize, String)> = None;
    for (index, seam) in used.iter().enumerate() {
        let left = left_over(seam, world_from_submap);
        let excess = (left.rotation_deg / options.max_seam_rotation_deg)
            .max(left.scale / options.max_seam_scale)
            .max(left.relative_distance / options.max_seam_distance);
        if !(excess <= 1.0) && worst.as_ref().is_none_or(|(other, _, _)| excess > *other) {
            let reason = format!(
                "the other seams contradict it: {:.1} degrees, {:.1} % of scale, {:.1} % of the depth are left over",
                left.rotation_deg,
                100.0 * left.scale,
                100.0 * left.relative_distance
            );
            worst = Some((excess, index, reason));
        }
    }
    worst.map(|(_, index, reason)| (index, reason))
}

fn distinct_images(submaps: &[SubmapSummary], members: &[u32]) -> u32 {
    let mut images: Vec<ImageId> =
        members.iter().flat_map(|submap| submaps[*submap as usize].images.iter().map(|entry| entry.0)).collect();
    images.sort_unstable();
    images.dedup();
    images.len() as u32
}

/// Brings a component into the local frame and solves it again with its positions, or into a frame that is
/// pleasant to look at.
fn bring_home(
    submaps: &[SubmapSummary],
    members: &[u32],
    used: &[UsableSeam],
    positions: &[LocalPosition],
    world_from_submap: &mut [Sim3],
    (options, seed): (&PlaceOptions, Seed),
) -> GeoOutcome {
    let images = fuse::fused_images(submaps, members, world_from_submap);
    let mut geo = register(&images, positions, &options.geo, seed);
    let new_from_old = match &geo {
        GeoOutcome::Registered { enu_from_local, .. } => *enu_from_local,
        GeoOutcome::NotRegistered { frame_from_local, .. } => *frame_from_local,
    };
    for submap in members {
        world_from_submap[*submap as usize] = new_from_old * world_from_submap[*submap as usize];
    }
    if let GeoOutcome::Registered { report, .. } = &mut geo {
        let inliers: Vec<ImageId> =
            report.residuals.iter().filter(|residual| residual.inlier).map(|residual| residual.image).collect();
        solve_with_positions(submaps, members, used, (positions, &inliers), world_from_submap);
        let images = fuse::fused_images(submaps, members, world_from_submap);
        *report = residuals(&images, positions, &options.geo);
    }
    geo
}

/// The joint solve of seams and satellite positions, for the submaps of one component.
fn solve_with_positions(
    submaps: &[SubmapSummary],
    members: &[u32],
    used: &[UsableSeam],
    (positions, inliers): (&[LocalPosition], &[ImageId]),
    world_from_submap: &mut [Sim3],
) {
    let node_of: BTreeMap<u32, u32> = members.iter().enumerate().map(|(node, submap)| (*submap, node as u32)).collect();
    let edges: Vec<Sim3Edge> = used
        .iter()
        .filter_map(|seam| {
            let (from, to) = (*node_of.get(&seam.a)?, *node_of.get(&seam.b)?);
            Some(Sim3Edge { from, to, ..seam.edge.clone() })
        })
        .collect();
    let mut copies: BTreeMap<ImageId, u32> = BTreeMap::new();
    for submap in members {
        for (image, _) in submaps[*submap as usize].centers() {
            *copies.entry(image).or_insert(0) += 1;
        }
    }
    let mut priors = Vec::new();
    for submap in members {
        for (image, x_in_node) in submaps[*submap as usize].centers() {
            let Ok(at) = positions.binary_search_by_key(&image, |position| position.image) else { continue };
            if inliers.binary_search(&image).is_ok() {
                // One position measures an image once, in however many submaps it is.
                let sigma_m = positions[at].sigma_m * f64::from(copies[&image]).sqrt();
                priors.push(sim3_graph::PositionPrior {
                    node: node_of[submap],
                    x_in_node,
                    x_in_world: positions[at].x_in_enu,
                    sigma_m,
                });
            }
        }
    }
    let initial: Vec<Sim3> = members.iter().map(|submap| world_from_submap[*submap as usize]).collect();
    let solved = sim3_graph::solve(&initial, &edges, &priors, &Sim3GraphOptions::default()).world_from_node;
    for (submap, similarity) in members.iter().zip(solved) {
        world_from_submap[*submap as usize] = similarity;
    }
}

/// For other modules of this stage: the images of a component by the mean over its submaps.
pub(super) fn component_images(
    submaps: &[SubmapSummary],
    placement: &Placement,
    component: usize,
) -> Vec<RegisteredImage> {
    let members = placement.components.get(component).map_or(&[][..], |found| &found.submaps);
    fuse::fused_images(submaps, members, &placement.world_from_submap)
}
