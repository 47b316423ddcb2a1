//! Points in shards by space: cut at the median of the longest side until each is small enough.

use nalgebra::Vector3;
use terrane_scene::{Observation, ScenePoint};

use super::MergedShard;

/// A point with its track.
pub(super) struct Track {
    pub(super) x_in_world: Vector3<f64>,
    pub(super) color: [u8; 3],
    pub(super) observations: Vec<Observation>,
}

/// Shards of at most about `max_observations`, each a box of space; points keep their order within a shard.
pub(super) fn by_space(tracks: &[Track], max_observations: u64) -> Vec<MergedShard> {
    let mut shards = Vec::new();
    let mut open = vec![(0..tracks.len() as u32).collect::<Vec<u32>>()];
    while let Some(mut members) = open.pop() {
        let total: u64 = members.iter().map(|at| tracks[*at as usize].observations.len() as u64).sum();
        if total <= max_observations.max(1) || members.len() < 2 {
            if !members.is_empty() {
                members.sort_unstable();
                shards.push(shard(tracks, &members));
            }
            continue;
        }
        let axis = longest_side(tracks, &members);
        let key = |at: &u32| tracks[*at as usize].x_in_world[axis];
        members.sort_by(|a, b| key(a).total_cmp(&key(b)).then(a.cmp(b)));
        let upper = members.split_off(members.len() / 2);
        open.push(upper);
        open.push(members);
    }
    shards
}

fn longest_side(tracks: &[Track], members: &[u32]) -> usize {
    let (mut low, mut high) = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
    for at in members {
        low = low.inf(&tracks[*at as usize].x_in_world);
        high = high.sup(&tracks[*at as usize].x_in_world);
    }
    (high - low).imax()
}

fn shard(tracks: &[Track], members: &[u32]) -> MergedShard {
    let mut shard = MergedShard::default();
    for at in members {
        let track = &tracks[*at as usize];
        shard.points.push(ScenePoint {
            x_in_world: track.x_in_world,
            color: track.color,
            first_observation: shard.observations.len() as u64,
            num_observations: track.observations.len() as u32,
        });
        shard.observations.extend_from_slice(&track.observations);
    }
    shard
}
