//! Points and their observations, in parts that can be loaded, linearised and dropped one by one.

use std::borrow::Cow;

use nalgebra::Vector3;

use super::BundleError;

/// One image point of one scene point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BundleObservation {
    /// Index of the pose that saw it.
    pub pose: u32,
    /// Index of the point within its shard.
    pub point: u32,
    /// Where it was seen, in pixels; pixel centres at (0.5, 0.5).
    pub xy_px: [f32; 2],
}

/// A part of the points with all their observations.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BundleShard {
    /// Points in the world's frame.
    pub points: Vec<Vector3<f64>>,
    /// Hold all points of this shard.
    pub fixed_points: bool,
    /// Observations, ascending in `point`.
    pub observations: Vec<BundleObservation>,
}

impl BundleShard {
    /// Checks order, indices and finiteness against the number of poses; `shard` names it in messages.
    pub fn validate(&self, shard: usize, num_poses: usize) -> Result<(), BundleError> {
        if u32::try_from(self.observations.len()).is_err() || u32::try_from(self.points.len()).is_err() {
            return Err(BundleError::invalid(format!(
                "shard {shard} has more than 2^32 entries: cut it smaller"
            )));
        }
        if let Some(i) = self.points.iter().position(|x| !x.iter().all(|v| v.is_finite())) {
            return Err(BundleError::invalid(format!(
                "point {i} of shard {shard} is not finite: leave it out"
            )));
        }
        let mut last = 0;
        for (i, observation) in self.observations.iter().enumerate() {
            let BundleObservation { pose, point, xy_px } = *observation;
            if pose as usize >= num_poses || point as usize >= self.points.len() {
                return Err(BundleError::invalid(format!(
                    "observation {i} of shard {shard} names pose {pose} of {num_poses} and point {point} of {}",
                    self.points.len()
                )));
            }
            if point < last {
                return Err(BundleError::invalid(format!(
                    "observation {i} of shard {shard} is out of order: sort observations by point"
                )));
            }
            if !(xy_px[0].is_finite() && xy_px[1].is_finite()) {
                return Err(BundleError::invalid(format!("observation {i} of shard {shard} is not finite")));
            }
            last = point;
        }
        Ok(())
    }
}

/// A shard that could not be loaded or stored; says which and why.
#[derive(Debug, thiserror::Error)]
#[error("shard {shard}: {reason}")]
pub struct ShardError {
    /// Which shard.
    pub shard: usize,
    /// Why, for people.
    pub reason: String,
    /// What the store said.
    #[source]
    pub source: Option<Box<dyn std::error::Error + Send + Sync>>,
}

/// Where shards live.
///
/// A solve loads every shard several times, in ascending order, and must find the same observations each time, and
/// the points that were stored last. It never holds two borrowed shards at once.
pub trait Shards: Sync {
    /// How many shards there are; constant during a solve.
    fn len(&self) -> usize;

    /// Whether there are none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The shard at `index`.
    fn load(&self, index: usize) -> Result<Cow<'_, BundleShard>, ShardError>;

    /// Replaces the points of the shard at `index`; as many as it has.
    fn store_points(&mut self, index: usize, points: &[Vector3<f64>]) -> Result<(), ShardError>;
}

/// Shards in memory.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct InMemoryShards(pub Vec<BundleShard>);

impl Shards for InMemoryShards {
    fn len(&self) -> usize {
        self.0.len()
    }

    fn load(&self, index: usize) -> Result<Cow<'_, BundleShard>, ShardError> {
        self.0.get(index).map(Cow::Borrowed).ok_or_else(|| absent(index))
    }

    fn store_points(&mut self, index: usize, points: &[Vector3<f64>]) -> Result<(), ShardError> {
        let shard = self.0.get_mut(index).ok_or_else(|| absent(index))?;
        if shard.points.len() != points.len() {
            let reason = format!("has {} points, not {}", shard.points.len(), points.len());
            return Err(ShardError { shard: index, reason, source: None });
        }
        shard.points.copy_from_slice(points);
        Ok(())
    }
}

fn absent(shard: usize) -> ShardError {
    ShardError { shard, reason: "there is no such shard".to_owned(), source: None }
}
