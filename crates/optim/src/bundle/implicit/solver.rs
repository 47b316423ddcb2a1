//! The camera side of the implicit solver: gathers what the parts answer, and solves for steps.

use std::sync::Arc;

use nalgebra::Vector3;

use super::super::layout::{Cameras, NONE};
use super::super::levenberg_marquardt::{Backend, Linearised, minimise};
use super::super::step::Tried;
use super::super::terms::{self, Term, terms};
use super::super::{
    AdjustedCameras, BundleError, BundleOptions, BundleProblem, BundleReport, BundleSolver, Preconditioner,
    Shards,
};
use super::conjugate_gradients;
use super::host::{LocalHost, PartHost};
use super::known;
use super::local::cluster_indices;
use super::partition::{Partition, partition};
use super::preconditioner::{BlockFactors, Coarse, Inverse};
use super::state::packed;
use super::system::{CameraSystem, Preconditioned};
use super::worker::{CameraSide, PartRequest, PartWorker};

/// Solves a problem that was cut by [`super::partition`], whoever holds the parts; `poses` are those of each part. Begins
/// with the report of the partition. The adjusted cameras come back; points stay with the holders.
///
/// # Errors
/// When the options do not fit the problem, or a part can't be reached.
pub fn solve_parts(
    side: Arc<CameraSide>,
    host: &mut dyn PartHost,
    poses: Vec<Vec<u32>>,
    report: &mut BundleReport,
) -> Result<AdjustedCameras, BundleError> {
    let any = report.observations > 0 || side.problem.has_measurements();
    let anything = any && (side.map.num_unknowns > 0 || report.points > 0);
    let mut driver = Driver::new(side.clone(), host, poses)?;
    report.solver = BundleSolver::Implicit;
    report.termination = minimise(&mut driver, &side.options, anything, report)?;
    report.linear_iterations = driver.linear_iterations;
    Ok(driver.cameras.into())
}

/// Solves a problem with all parts in this process; the adjusted cameras, and the points of each shard.
pub(in super::super) fn solve_here(
    problem: &BundleProblem,
    shards: &dyn Shards,
    options: &BundleOptions,
    report: &mut BundleReport,
) -> Result<(Cameras, Vec<Vec<Vector3<f64>>>), BundleError> {
    let Partition { side, parts, origins, report: found } = partition(problem, shards, options)?;
    *report = found;
    let side = Arc::new(side);
    let poses = parts.iter().map(|part| part.poses.clone()).collect();
    let mut worker = PartWorker::new(side.clone(), None, u64::MAX);
    for (index, part) in parts.into_iter().enumerate() {
        worker.take(index as u32, part)?;
    }
    let mut host = LocalHost(worker);
    let cameras = solve_parts(side, &mut host, poses, report)?;
    let mut points = Vec::with_capacity(shards.len());
    for index in 0..shards.len() {
        points.push(shards.load(index)?.points.clone());
    }
    for (origins, answer) in origins.iter().zip(host.ask(&PartRequest::Points)?) {
        for ((shard, point), x) in origins.iter().zip(answer.as_chunks::<3>().0) {
            points[*shard as usize][*point as usize] = Vector3::from(*x);
        }
    }
    Ok((cameras.into(), points))
}

/// The camera side, whoever holds the parts.
struct Driver<'a> {
    side: Arc<CameraSide>,
    host: &'a mut dyn PartHost,
    /// The poses of each part.
    poses: Vec<Vec<u32>>,
    cameras: Cameras,
    next: Option<Cameras>,
    sums: Sums,
    inverse: Inverse,
    linear_iterations: u64,
}

/// What all parts and priors add up to, by unknown.
#[derive(Default)]
struct Sums {
    /// The gradient, negated.
    descent: Vec<f64>,
    /// The same after elimination.
    reduced_descent: Vec<f64>,
    /// The diagonal that is damped.
    diagonal: Vec<f64>,
    /// `λ D`.
    damping: Vec<f64>,
    /// Packed normal equations of each pose, with priors.
    normal: Vec<f64>,
    /// Packed diagonal blocks of the reduced system, with priors.
    reduced: Vec<f64>,
    /// Packed blocks that no single pose owns.
    shared: Vec<Vec<f64>>,
    terms: Vec<Term>,
    steepest: f64,
}

impl<'a> Driver<'a> {
    fn new(
        side: Arc<CameraSide>,
        host: &'a mut dyn PartHost,
        poses: Vec<Vec<u32>>,
    ) -> Result<Self, BundleError> {
        let kind = match side.options.preconditioner {
            Preconditioner::Auto => Preconditioner::TwoLevel,
            kind => kind,
        };
        let apart = side.map.shared.is_empty() && side.problem.priors.distances.is_empty();
        if kind == Preconditioner::PowerSeries && !apart {
            return Err(BundleError::invalid(
                "the power series needs intrinsics that no two poses share, and neither landmarks, biases nor distances: \
                 hold them, or choose two-level"
                    .to_owned(),
            ));
        }
        let cameras = Cameras::of(&side.problem);
        let terms = terms(&side.problem, &side.layout, &cameras, &side.options);
        let frame = side.frame(&cameras);
        let coarse = match kind {
            Preconditioner::TwoLevel => {
                let touched = poses.iter().map(|poses| side.coarse.of_poses(&frame, poses)).collect();
                Some(Coarse::new(&side, touched, &terms)?)
            }
            _ => None,
        };
        let by_cluster = matches!(kind, Preconditioner::TwoLevel | Preconditioner::ClusterBlocks);
        let cluster_indices = match by_cluster {
            true => side.clusters.members.iter().map(|members| cluster_indices(&side.map, members)).collect(),
            false => Vec::new(),
        };
        let factors = BlockFactors::new(&side, &[], &[], false);
        let inverse = Inverse { kind, factors, coarse, cluster_indices };
        Ok(Self {
            side,
            host,
            poses,
            cameras,
            next: None,
            sums: Sums::default(),
            inverse,
            linear_iterations: 0,
        })
    }

    /// Adds up what parts answered to [`PartRequest::Linearise`]; the cost.
    fn gather(&mut self, answers: &[Vec<f64>]) -> f64 {
        let (map, width) = (&self.side.map, self.side.map.width());
        let (n, num_poses) = (map.num_unknowns, map.of_pose.len());
        let sums = &mut self.sums;
        let whole = self.inverse.kind == Preconditioner::PowerSeries;
        let (mut gradient, mut reduced_gradient) = (vec![0.0; n], vec![0.0; n]);
        sums.normal = vec![0.0; if whole { packed(width) * num_poses } else { 0 }];
        sums.reduced = vec![0.0; packed(width) * num_poses];
        sums.diagonal = vec![0.0; n];
        sums.steepest = 0.0;
        let mut cost = 0.0;
        for (poses, answer) in self.poses.iter().zip(answers) {
            let [part_cost, steepest, rest @ ..] = answer.as_slice() else { continue };
            cost += part_cost;
            sums.steepest = sums.steepest.max(*steepest);
            let (vectors, blocks) = rest.split_at(3 * width * poses.len());
            let targets = [&mut gradient, &mut reduced_gradient, &mut sums.diagonal];
            for (target, vector) in
                targets.into_iter().zip(vectors.chunks_exact((width * poses.len()).max(1)))
            {
                for (pose, local) in poses.iter().zip(vector.chunks_exact(width)) {
                    map.scatter(*pose, local, target);
                }
            }
            let targets = [&mut sums.reduced, &mut sums.normal];
            for (target, block) in
                targets.into_iter().zip(blocks.chunks_exact((packed(width) * poses.len()).max(1)))
            {
                for (pose, block) in poses.iter().zip(block.chunks_exact(packed(width))) {
                    let target = &mut target[packed(width) * *pose as usize..][..packed(width)];
                    target.iter_mut().zip(block).for_each(|(sum, add)| *sum += add);
                }
            }
        }
        sums.descent = gradient.iter().map(|g| -g).collect();
        sums.reduced_descent = reduced_gradient.iter().map(|g| -g).collect();
        cost
    }

    /// Adds what priors and marks say; their cost. Without `anew` the cameras have not moved.
    fn add_terms(&mut self, anew: bool) -> f64 {
        let side = self.side.as_ref();
        let sums = &mut self.sums;
        if anew {
            sums.terms = terms(&side.problem, &side.layout, &self.cameras, &side.options);
        }
        known::for_each_unknown(side, &sums.terms, |unknown, slope, diagonal| {
            sums.descent[unknown] -= slope;
            sums.reduced_descent[unknown] -= slope;
            sums.diagonal[unknown] += diagonal;
        });
        known::add_to_pose_blocks(side, &sums.terms, &mut sums.reduced);
        if !sums.normal.is_empty() {
            known::add_to_pose_blocks(side, &sums.terms, &mut sums.normal);
        }
        sums.terms.iter().map(|term| term.cost).sum()
    }

    /// Builds the preconditioner for the damping at hand.
    fn prepare(&mut self) -> Result<(), BundleError> {
        let (side, sums) = (self.side.clone(), &mut self.sums);
        let width = side.map.width();
        let from = match self.inverse.kind {
            Preconditioner::PowerSeries => &sums.normal,
            _ => &sums.reduced,
        };
        let mut blocks = from.clone();
        for (unknowns, block) in side.map.of_pose.iter().zip(blocks.chunks_exact_mut(packed(width))) {
            if unknowns.pose != NONE {
                (0..6).for_each(|a| block[packed(a) + a] += sums.damping[unknowns.pose as usize + a]);
            }
            for a in 0..unknowns.num_intrinsics as usize {
                block[packed(6 + a) + 6 + a] += sums.damping[unknowns.intrinsics as usize + a];
            }
        }
        sums.shared = shared_blocks(&side, from, &sums.damping, &sums.terms);
        let by_cluster = !self.inverse.cluster_indices.is_empty();
        self.inverse.factors = BlockFactors::new(&side, &blocks, &sums.shared, !by_cluster);
        if !by_cluster {
            return Ok(());
        }
        let coarse = self.inverse.coarse.is_some();
        let answers = self.host.ask(&PartRequest::Prepare { diagonal: blocks, coarse })?;
        if let Some(coarse) = &mut self.inverse.coarse {
            check_lengths(&answers, coarse.part_lengths(&side))?;
            coarse.assemble(&side, &self.cameras, &answers, (&sums.damping, &sums.terms));
        }
        Ok(())
    }
}

impl Backend for Driver<'_> {
    fn linearise(&mut self, damping: f64, anew: bool) -> Result<Linearised, BundleError> {
        let answers = self.host.ask(&PartRequest::Linearise { damping, anew })?;
        let blocks = 1 + usize::from(self.inverse.kind == Preconditioner::PowerSeries);
        let (width, of) = (self.side.map.width(), |poses: &Vec<u32>| poses.len());
        let lengths = self.poses.iter().map(of).map(|n| 2 + n * (3 * width + blocks * packed(width)));
        check_lengths(&answers, lengths)?;
        let cost = self.gather(&answers) + self.add_terms(anew);
        let tiny = f64::MIN_POSITIVE.sqrt();
        for d in &mut self.sums.diagonal {
            // A parameter without any effect stays where it is.
            *d = d.max(tiny);
        }
        self.sums.damping = self.sums.diagonal.iter().map(|d| (damping * d).max(tiny)).collect();
        let slopes = self.sums.descent.iter().zip(&self.sums.diagonal).map(|(g, d)| g * g / d);
        Ok(Linearised { cost, steepest: slopes.fold(self.sums.steepest, f64::max) })
    }

    fn try_step(&mut self, damping: f64) -> Result<Option<Tried>, BundleError> {
        self.prepare()?;
        let side = self.side.clone();
        let solved = {
            let Self { host, poses, sums, inverse, .. } = self;
            let system = CameraSystem {
                side: &side,
                host: &mut **host,
                poses,
                damping: &sums.damping,
                terms: &sums.terms,
            };
            let options = &side.options;
            let mut system = Preconditioned { system, inverse };
            let (tolerance, most) = (options.linear_tolerance, options.max_linear_iterations);
            conjugate_gradients::solve(&mut system, &sums.reduced_descent, tolerance, most)?
        };
        self.linear_iterations += u64::from(solved.iterations);
        let step = &solved.x;
        if !step.iter().all(|h| h.is_finite()) {
            return Ok(None);
        }
        let Some(next) = self.cameras.stepped(&side.layout, step) else { return Ok(None) };
        // ½ h·(λ D h + descent + what conjugate gradients left over).
        let model: f64 = (0..step.len())
            .map(|i| {
                let damped = damping * self.sums.diagonal[i] * step[i];
                0.5 * step[i] * (damped + self.sums.descent[i] + solved.residual[i])
            })
            .sum();
        let mut sum = Tried {
            cost: terms::cost(&side.problem, &side.layout, &next, &side.options),
            model_reduction: model,
            step_squared: step.iter().map(|h| h * h).sum(),
            norm_squared: self.cameras.squared_norm(&side.layout),
        };
        let answers = self.host.ask(&PartRequest::Try { damping, step: solved.x })?;
        for answer in &answers {
            if let [cost, model_reduction, step_squared, norm_squared] = answer[..] {
                sum = sum.plus(&Tried { cost, model_reduction, step_squared, norm_squared });
            }
        }
        self.next = Some(next);
        Ok(Some(sum))
    }

    fn accept(&mut self) -> Result<(), BundleError> {
        if let Some(next) = self.next.take() {
            if self.host.wants_cameras() {
                self.host.accepted(self.side.flatten_cameras(&next));
            }
            self.host.ask(&PartRequest::Accept)?;
            self.cameras = next;
        }
        Ok(())
    }
}

/// Answers may come from another process: a wrong length is an error, not a panic.
fn check_lengths(answers: &[Vec<f64>], lengths: impl Iterator<Item = usize>) -> Result<(), BundleError> {
    match answers.iter().map(Vec::len).eq(lengths) {
        true => Ok(()),
        false => Err(BundleError::lost(
            "a holder's answer has a wrong length: solver and holder differ in version".into(),
        )),
    }
}

/// The blocks that no single pose owns: sums over the poses and terms, damped once.
fn shared_blocks(side: &CameraSide, blocks: &[f64], damping: &[f64], terms: &[Term]) -> Vec<Vec<f64>> {
    let width = side.map.width();
    let mut shared: Vec<Vec<f64>> =
        side.map.shared.iter().map(|(_, n)| vec![0.0; packed(*n as usize)]).collect();
    let find = |first: u32| side.map.shared.binary_search_by_key(&first, |(first, _)| *first).ok();
    for (unknowns, block) in side.map.of_pose.iter().zip(blocks.chunks_exact(packed(width))) {
        let Some(at) = (unknowns.num_intrinsics > 0).then(|| find(unknowns.intrinsics)).flatten() else {
            continue;
        };
        for a in 0..unknowns.num_intrinsics as usize {
            for b in 0..=a {
                shared[at][packed(a) + b] += block[packed(6 + a) + 6 + b];
            }
        }
    }
    for ((first, n), block) in side.map.shared.iter().zip(&mut shared) {
        for a in 0..*n as usize {
            block[packed(a) + a] += damping[*first as usize + a];
        }
    }
    known::add_to_shared_blocks(side, terms, &mut shared);
    shared
}

#[cfg(test)]
pub(super) use prepared::Prepared;

#[cfg(test)]
mod prepared {
    use super::*;

    /// A linearised problem of which tests look at the system.
    pub struct Prepared {
        side: Arc<CameraSide>,
        host: LocalHost,
        poses: Vec<Vec<u32>>,
        sums: Sums,
        inverse: Inverse,
    }

    impl Prepared {
        pub fn new(side: Arc<CameraSide>, mut host: LocalHost, poses: Vec<Vec<u32>>, damping: f64) -> Self {
            let mut driver = Driver::new(side.clone(), &mut host, poses.clone()).unwrap();
            driver.linearise(damping, true).unwrap();
            driver.prepare().unwrap();
            let Driver { sums, inverse, .. } = driver;
            Self { side, host, poses, sums, inverse }
        }

        pub fn num_unknowns(&self) -> usize {
            self.side.map.num_unknowns
        }

        fn system(&mut self) -> Preconditioned<'_> {
            let system = CameraSystem {
                side: &self.side,
                host: &mut self.host,
                poses: &self.poses,
                damping: &self.sums.damping,
                terms: &self.sums.terms,
            };
            Preconditioned { system, inverse: &mut self.inverse }
        }

        pub fn multiply(&mut self, x: &[f64]) -> Vec<f64> {
            conjugate_gradients::System::multiply(&mut self.system(), x).unwrap()
        }

        pub fn precondition(&mut self, r: &[f64]) -> Vec<f64> {
            conjugate_gradients::System::precondition(&mut self.system(), r).unwrap()
        }
    }
}
