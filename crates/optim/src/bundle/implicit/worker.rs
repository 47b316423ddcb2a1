//! Holding parts and answering for them: the same on this machine's threads and behind a network.

use rayon::prelude::*;

use super::super::layout::{Cameras, Layout};
use super::super::step::Tried;
use super::super::{BundleError, BundleOptions, BundleProblem, Precision};
use super::clusters::Clusters;
use super::coarse::{CoarseGroups, middles};
use super::part::{CameraMap, Part};
use super::real::Real;
use super::state::{Frame, PartState};

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
    pub(super) layout: Layout,
    pub(super) map: CameraMap,
    pub(super) clusters: Clusters,
    pub(super) coarse: CoarseGroups,
}

impl CameraSide {
    /// The unknowns of a problem of which the poses in `observed` see points.
    pub fn new(problem: BundleProblem, options: BundleOptions, observed: &[bool], clusters: Clusters) -> Self {
        let layout = Layout::new(&problem, observed, None);
        let map = CameraMap::new(&problem, &layout, observed);
        let coarse = CoarseGroups { num_clusters: clusters.count, shared: map.shared.clone() };
        Self { problem, options, layout, map, clusters, coarse }
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

/// Holds parts and answers for them.
pub struct PartWorker {
    side: std::sync::Arc<CameraSide>,
    cameras: Cameras,
    next: Option<Cameras>,
    parts: Vec<(u32, Box<dyn Answer>)>,
}

impl PartWorker {
    /// Takes parts, numbered by cluster; they begin at the problem's cameras and their own points.
    ///
    /// # Errors
    /// When a part is not valid.
    pub fn new(side: std::sync::Arc<CameraSide>, parts: Vec<(u32, Part)>) -> Result<Self, BundleError> {
        let cameras = Cameras::new(side.problem.poses.clone(), side.problem.intrinsics.clone());
        let mut worker = Self { side, cameras, next: None, parts: Vec::new() };
        for (index, part) in parts {
            worker.add(index, part)?;
        }
        Ok(worker)
    }

    fn add(&mut self, index: u32, part: Part) -> Result<(), BundleError> {
        part.validate(index as usize, self.side.problem.poses.len())?;
        let stride = self.side.map.stride;
        let state: Box<dyn Answer> = match self.side.options.precision {
            Precision::Single => Box::new(PartState::<f32>::new(part, stride)),
            Precision::Double => Box::new(PartState::<f64>::new(part, stride)),
        };
        self.parts.push((index, state));
        Ok(())
    }

    /// Answers for every part, in the order in which they were taken. What the numbers are depends on the request.
    pub fn answer(&mut self, request: &PartRequest) -> Vec<(u32, Vec<f64>)> {
        match request {
            PartRequest::Accept => {
                if let Some(next) = self.next.take() {
                    self.cameras = next;
                }
            }
            PartRequest::Try { step, .. } => self.next = self.cameras.stepped(&self.side.layout, step),
            _ => {}
        }
        let frame = self.side.frame(&self.cameras);
        let middles = match request {
            PartRequest::Prepare { coarse: true, .. } => middles(&self.cameras, &self.side.clusters),
            _ => Vec::new(),
        };
        let context = AnswerContext {
            frame,
            coarse: &self.side.coarse,
            middles: &middles,
            next: self.next.as_ref(),
        };
        self.parts.par_iter_mut().map(|(index, part)| (*index, part.answer(&context, *index, request))).collect()
    }
}

struct AnswerContext<'a> {
    frame: Frame<'a>,
    coarse: &'a CoarseGroups,
    middles: &'a [nalgebra::Vector3<f64>],
    next: Option<&'a Cameras>,
}

/// A part of either precision.
trait Answer: Send {
    fn answer(&mut self, context: &AnswerContext<'_>, index: u32, request: &PartRequest) -> Vec<f64>;
}

impl<T: Real> Answer for PartState<T> {
    fn answer(&mut self, context: &AnswerContext<'_>, index: u32, request: &PartRequest) -> Vec<f64> {
        let frame = &context.frame;
        match request {
            PartRequest::Linearise { damping, anew } => {
                if *anew {
                    self.linearise(frame);
                }
                self.eliminate(*damping, frame.map.stride);
                let sums = &self.sums;
                let arrays = [&sums.gradient, &sums.reduced_gradient, &sums.normal, &sums.reduced];
                [sums.cost, sums.steepest].iter().chain(arrays.into_iter().flatten()).copied().collect()
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
