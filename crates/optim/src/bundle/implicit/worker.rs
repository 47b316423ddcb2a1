//! Holding parts and answering for them: the same on this machine's threads and behind a network.

use std::sync::Arc;

use nalgebra::Vector3;
use rayon::prelude::*;

use super::super::layout::{Cameras, Layout};
use super::super::step::Tried;
use super::super::{
    AdjustedCameras, BundleError, BundleOptions, BundleProblem, Precision, Preconditioner, ShardError,
};
use super::clusters::Clusters;
use super::coarse::{CoarseGroups, middles};
use super::part::{CameraMap, Part};
use super::real::Real;
use super::state::{Frame, PartState, packed};

/// What is asked of the holder of parts. Vectors are those of all camera unknowns.
#[derive(Clone, Debug, PartialEq)]
pub enum PartRequest {
    /// Linearise at the accepted cameras and points, or (without `anew`) as before; eliminate points.
    Linearise {
        /// Damping relative to the diagonal.
        damping: f64,
        /// Whether cameras and points have moved.
        anew: bool,
    },
    /// Build preconditioners.
    Prepare {
        /// The packed diagonal block of every pose; empty when cluster blocks are not wanted.
        diagonal: Vec<f64>,
        /// Whether the coarse matrix is wanted.
        coarse: bool,
    },
    /// Multiply the reduced system by a vector.
    Multiply(Vec<f64>),
    /// Solve with the cluster's block.
    Solve(Vec<f64>),
    /// Try a step.
    Try {
        /// Damping of the model.
        damping: f64,
        /// The step of all cameras.
        step: Vec<f64>,
    },
    /// Make the tried step the accepted one.
    Accept,
    /// The accepted points.
    Points,
}

/// The camera side of an adjustment: what every holder of parts needs to know, and nothing that grows with points.
pub struct CameraSide {
    pub(super) problem: BundleProblem,
    pub(super) options: BundleOptions,
    pub(super) observed: Vec<bool>,
    pub(super) layout: Layout,
    pub(super) map: CameraMap,
    pub(super) clusters: Clusters,
    pub(super) coarse: CoarseGroups,
}

impl CameraSide {
    /// The unknowns of a problem of which the poses in `observed` see points.
    pub fn new(
        problem: BundleProblem,
        options: BundleOptions,
        observed: Vec<bool>,
        clusters: Clusters,
    ) -> Self {
        let layout = Layout::new(&problem, &observed, None, options.behind_camera);
        let map = CameraMap::new(&problem, &layout);
        let coarse = CoarseGroups { num_clusters: clusters.count, shared: map.shared.clone() };
        Self { problem, options, observed, layout, map, clusters, coarse }
    }

    /// The cameras at the start.
    pub fn problem(&self) -> &BundleProblem {
        &self.problem
    }

    /// The options of the solve.
    pub fn options(&self) -> &BundleOptions {
        &self.options
    }

    /// Whether each pose sees any point.
    pub fn observed(&self) -> &[bool] {
        &self.observed
    }

    /// The clusters of poses.
    pub fn clusters(&self) -> &Clusters {
        &self.clusters
    }

    /// The cameras at the start as numbers: seven of each pose, the parameters of each of the intrinsics, three of each
    /// position bias and of each landmark.
    pub fn flatten(&self) -> Vec<f64> {
        self.flatten_cameras(&Cameras::of(&self.problem))
    }

    /// Cameras as numbers, as [`CameraSide::flatten`].
    pub(super) fn flatten_cameras(&self, cameras: &Cameras) -> Vec<f64> {
        let poses = cameras.poses.iter().flat_map(|pose| {
            let (q, t) = (pose.rotation.coords, pose.translation);
            [q.x, q.y, q.z, q.w, t.x, t.y, t.z]
        });
        let intrinsics = cameras.intrinsics.iter().flat_map(|camera| camera.params().iter().copied());
        let kept = cameras.biases_m.iter().chain(&cameras.landmarks).flat_map(|x| [x.x, x.y, x.z]);
        poses.chain(intrinsics).chain(kept).collect()
    }

    /// The way back from [`CameraSide::flatten_cameras`].
    pub(super) fn unflatten(&self, numbers: &[f64]) -> Result<Cameras, BundleError> {
        let mut cameras = AdjustedCameras::of(&self.problem);
        let params: usize = cameras.intrinsics.iter().map(|camera| camera.params().len()).sum();
        let kept = cameras.biases_m.len() + cameras.landmarks.len();
        if numbers.len() != 7 * cameras.poses.len() + params + 3 * kept {
            return Err(BundleError::invalid(
                "the cameras to go on from are those of another problem".to_owned(),
            ));
        }
        let (of_poses, mut rest) = numbers.split_at(7 * cameras.poses.len());
        for (pose, v) in cameras.poses.iter_mut().zip(of_poses.as_chunks::<7>().0) {
            // As it was, to the last bit: not normalised again.
            let quaternion = nalgebra::Quaternion::new(v[3], v[0], v[1], v[2]);
            pose.rotation = nalgebra::UnitQuaternion::new_unchecked(quaternion);
            pose.translation = Vector3::new(v[4], v[5], v[6]);
        }
        for camera in &mut cameras.intrinsics {
            let (own, after) = rest.split_at(camera.params().len());
            camera.params_mut().copy_from_slice(own);
            rest = after;
        }
        let targets = cameras.biases_m.iter_mut().chain(&mut cameras.landmarks);
        targets.zip(rest.as_chunks::<3>().0).for_each(|(target, x)| *target = Vector3::from(*x));
        Ok(cameras.into())
    }

    pub(super) fn frame<'a>(&'a self, cameras: &'a Cameras) -> Frame<'a> {
        Frame {
            problem: &self.problem,
            options: &self.options,
            layout: &self.layout,
            map: &self.map,
            clusters: &self.clusters,
            cameras,
        }
    }
}

/// Where parts lie that are not held, and where steps are kept so that a lost holder's parts can be taken over.
pub trait PartStore: Send + Sync {
    /// A part as it was at the start.
    ///
    /// # Errors
    /// When it can't be read.
    fn load(&self, part: u32) -> Result<Part, ShardError>;

    /// The points of a part after a number of accepted steps, at least one.
    ///
    /// # Errors
    /// When they can't be read.
    fn load_points(&self, part: u32, step: u64) -> Result<Vec<Vector3<f64>>, ShardError>;

    /// Keeps the points of a part for a step that is being tried; the accepted one and this one are needed.
    ///
    /// # Errors
    /// When they can't be written.
    fn store_points(&self, part: u32, step: u64, points: &[Vector3<f64>]) -> Result<(), ShardError>;
}

/// Holds parts and answers for them.
pub struct PartWorker {
    side: Arc<CameraSide>,
    cameras: Cameras,
    next: Option<Cameras>,
    /// Accepted steps so far.
    step: u64,
    damping: f64,
    parts: Vec<Held>,
    store: Option<Arc<dyn PartStore>>,
    /// Memory for parts that is not taken yet.
    memory_bytes: u64,
}

struct Held {
    index: u32,
    state: Box<dyn Answer>,
    /// Whether it stays in memory between requests.
    resident: bool,
}

impl PartWorker {
    /// Nothing held yet. `memory_bytes` is for held parts; with a store, parts beyond it are read again for each request.
    pub fn new(side: Arc<CameraSide>, store: Option<Arc<dyn PartStore>>, memory_bytes: u64) -> Self {
        let cameras = Cameras::of(&side.problem);
        Self { side, cameras, next: None, step: 0, damping: 0.0, parts: Vec::new(), store, memory_bytes }
    }

    /// Moves to the accepted cameras of another solver, in the form of [`CameraSide::flatten`].
    ///
    /// # Errors
    /// When there are not as many numbers as that.
    pub fn resume(&mut self, step: u64, cameras: &[f64]) -> Result<(), BundleError> {
        self.cameras = self.side.unflatten(cameras)?;
        (self.step, self.next) = (step, None);
        Ok(())
    }

    /// Takes a part over, from memory.
    ///
    /// # Errors
    /// When the part is not valid.
    pub fn take(&mut self, index: u32, part: Part) -> Result<(), BundleError> {
        part.validate(index as usize, self.side.problem.poses.len())?;
        let Some(members) = self.side.clusters.members.get(index as usize) else {
            return Err(BundleError::invalid(format!("part {index} has no cluster: the problem has fewer")));
        };
        let stride = self.side.map.stride;
        let double = self.side.options.precision == Precision::Double;
        let bytes = if double {
            PartState::<f64>::held_bytes(&part, stride)
        } else {
            PartState::<f32>::held_bytes(&part, stride)
        };
        // The cluster's factor stays in any case.
        let unknowns = self.side.map.width() * members.len();
        let factor = (unknowns * (unknowns + 1) / 2 * if double { 8 } else { 4 }) as u64;
        self.memory_bytes = self.memory_bytes.saturating_sub(factor);
        let resident = self.store.is_none() || bytes <= self.memory_bytes;
        self.memory_bytes -= if resident { bytes.min(self.memory_bytes) } else { 0 };
        let part = if resident { part } else { Part::default() };
        let state: Box<dyn Answer> = if double {
            Box::new(PartState::<f64>::new(part, stride))
        } else {
            Box::new(PartState::<f32>::new(part, stride))
        };
        let at = self.parts.partition_point(|held| held.index < index);
        self.parts.insert(at, Held { index, state, resident });
        Ok(())
    }

    /// Takes a part over, from the store, at the accepted step.
    ///
    /// # Errors
    /// When it can't be read or is not valid.
    pub fn take_stored(&mut self, index: u32) -> Result<(), BundleError> {
        let Some(store) = self.store.clone() else {
            return Err(BundleError::invalid(format!("part {index} can't be taken over: there is no store")));
        };
        let part = stored_part(store.as_ref(), index, self.step)?;
        self.take(index, part)
    }

    /// The parts that are held, ascending, and whether each stays in memory.
    pub fn held(&self) -> impl Iterator<Item = (u32, bool)> + '_ {
        self.parts.iter().map(|held| (held.index, held.resident))
    }

    /// What a request changes for all parts; before they are asked to answer it.
    ///
    /// # Errors
    /// When a vector is not as long as that of all unknowns.
    pub fn begin(&mut self, request: &PartRequest) -> Result<(), BundleError> {
        let map = &self.side.map;
        let (length, expected) = match request {
            PartRequest::Multiply(x) | PartRequest::Solve(x) => (x.len(), map.num_unknowns),
            PartRequest::Try { step, .. } => (step.len(), map.num_unknowns),
            PartRequest::Prepare { diagonal, .. } if !diagonal.is_empty() => {
                (diagonal.len(), packed(map.width()) * map.of_pose.len())
            }
            _ => (0, 0),
        };
        if length != expected {
            return Err(BundleError::invalid(format!(
                "a question with {length} numbers where {expected} are needed: solver and holder differ in version"
            )));
        }
        match request {
            PartRequest::Accept => {
                if let Some(next) = self.next.take() {
                    (self.cameras, self.step) = (next, self.step + 1);
                }
            }
            PartRequest::Try { step, .. } => self.next = self.cameras.stepped(&self.side.layout, step),
            PartRequest::Linearise { damping, .. } => self.damping = *damping,
            _ => {}
        }
        Ok(())
    }

    /// Answers for every part, ascending, or only for those in `only`, after [`PartWorker::begin`]. What the numbers are
    /// depends on the request.
    ///
    /// # Errors
    /// When a part can't be read or written.
    pub fn answer(
        &mut self,
        request: &PartRequest,
        only: Option<&[u32]>,
    ) -> Result<Vec<(u32, Vec<f64>)>, BundleError> {
        let middles = match request {
            PartRequest::Prepare { coarse: true, .. } => middles(&self.cameras, &self.side.clusters),
            _ => Vec::new(),
        };
        let context = AnswerContext {
            frame: self.side.frame(&self.cameras),
            coarse: &self.side.coarse,
            middles: &middles,
            next: self.next.as_ref(),
            damping: self.damping,
            step: self.step,
            store: self.store.as_deref(),
        };
        let wanted = |held: &&mut Held| only.is_none_or(|only| only.contains(&held.index));
        self.parts
            .par_iter_mut()
            .filter(wanted)
            .map(|held| Ok((held.index, held.answer(&context, request)?)))
            .collect()
    }
}

struct AnswerContext<'a> {
    frame: Frame<'a>,
    coarse: &'a CoarseGroups,
    middles: &'a [Vector3<f64>],
    next: Option<&'a Cameras>,
    damping: f64,
    step: u64,
    store: Option<&'a dyn PartStore>,
}

fn stored_part(store: &dyn PartStore, index: u32, step: u64) -> Result<Part, BundleError> {
    let mut part = store.load(index)?;
    if step > 0 {
        let points = store.load_points(index, step)?;
        if points.len() != part.points.len() {
            return Err(BundleError::invalid(format!("the points of part {index} changed during the solve")));
        }
        part.points = points;
    }
    Ok(part)
}

impl Held {
    fn answer(
        &mut self,
        context: &AnswerContext<'_>,
        request: &PartRequest,
    ) -> Result<Vec<f64>, BundleError> {
        let away = !self.resident && !matches!(request, PartRequest::Solve(_) | PartRequest::Accept);
        if let (true, Some(store)) = (away, context.store) {
            let part = stored_part(store, self.index, context.step)?;
            part.validate(self.index as usize, context.frame.problem.poses.len())?;
            let linearise = !matches!(request, PartRequest::Linearise { .. } | PartRequest::Points);
            self.state.refill(part, context, linearise);
        }
        let answer = match request {
            // Without memory of the last time, everything is new.
            PartRequest::Linearise { damping, .. } if away => {
                let request = PartRequest::Linearise { damping: *damping, anew: true };
                self.state.answer(context, self.index, &request)
            }
            PartRequest::Accept if !self.resident => Vec::new(),
            _ => self.state.answer(context, self.index, request),
        };
        if let (PartRequest::Try { .. }, Some(store)) = (request, context.store) {
            // Before the step is answered for: who takes over later finds it.
            store.store_points(self.index, context.step + 1, self.state.tried())?;
        }
        if away {
            self.state.release();
        }
        Ok(answer)
    }
}

/// A part of either precision.
trait Answer: Send {
    fn answer(&mut self, context: &AnswerContext<'_>, index: u32, request: &PartRequest) -> Vec<f64>;
    fn refill(&mut self, part: Part, context: &AnswerContext<'_>, linearise: bool);
    fn release(&mut self);
    fn tried(&self) -> &[Vector3<f64>];
}

impl<T: Real> Answer for PartState<T> {
    fn answer(&mut self, context: &AnswerContext<'_>, index: u32, request: &PartRequest) -> Vec<f64> {
        let frame = &context.frame;
        match request {
            PartRequest::Linearise { damping, anew } => {
                if *anew {
                    self.linearise(frame);
                }
                let steepest = self.eliminate(*damping);
                let sums = self.camera_sums(frame.map.stride, steepest);
                let width = frame.map.width();
                let diagonal: Vec<f64> = sums
                    .normal
                    .chunks_exact(packed(width))
                    .flat_map(|block| (0..width).map(|a| block[packed(a) + a]))
                    .collect();
                let whole = frame.options.preconditioner == Preconditioner::PowerSeries;
                let normal = if whole { &sums.normal[..] } else { &[] };
                let arrays = [&self.gradient, &sums.reduced_gradient, &diagonal, &sums.reduced[..], normal];
                [self.cost, sums.steepest].iter().chain(arrays.into_iter().flatten()).copied().collect()
            }
            PartRequest::Prepare { diagonal, coarse } => {
                if !diagonal.is_empty() {
                    self.factorize_local(frame, index as usize, diagonal);
                }
                if *coarse { self.coarse_matrix(frame, context.coarse, context.middles) } else { Vec::new() }
            }
            PartRequest::Multiply(x) => {
                let x = self.gathered(frame.map, x);
                let mut y = vec![0.0; x.len()];
                self.lanes.multiply(frame.map.stride, &x, &mut y, &mut self.scratch);
                y
            }
            PartRequest::Solve(right) => match &mut self.local {
                Some(local) => local.solve(frame.map, right),
                None => Vec::new(),
            },
            PartRequest::Try { damping, step } => {
                let Some(next) = context.next else { return vec![f64::INFINITY, 0.0, 0.0, 0.0] };
                let step = self.gathered(frame.map, step);
                let Tried { cost, model_reduction, step_squared, norm_squared } =
                    self.try_step(frame, *damping, &step, next);
                vec![cost, model_reduction, step_squared, norm_squared]
            }
            PartRequest::Accept => {
                std::mem::swap(&mut self.part.points, &mut self.tried);
                Vec::new()
            }
            PartRequest::Points => self.part.points.iter().flat_map(|x| [x.x, x.y, x.z]).collect(),
        }
    }

    fn refill(&mut self, part: Part, context: &AnswerContext<'_>, linearise: bool) {
        self.refill(part, context.frame.map.stride);
        if linearise {
            self.linearise(&context.frame);
            self.eliminate(context.damping);
        }
    }

    fn release(&mut self) {
        self.release();
    }

    fn tried(&self) -> &[Vector3<f64>] {
        &self.tried
    }
}

impl<T: Real> PartState<T> {
    /// The unknowns of the part's cameras.
    fn gathered(&self, map: &CameraMap, all: &[f64]) -> Vec<f64> {
        let width = map.width();
        let mut local = vec![0.0; width * self.part.poses.len()];
        for (pose, local) in self.part.poses.iter().zip(local.chunks_exact_mut(width)) {
            map.gather(*pose, all, local);
        }
        local
    }
}
