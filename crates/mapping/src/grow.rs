//! One submap from one start: image after image, with adjustment and filtering between.

use terrane_geometry::{Camera, Rigid3, Seed};
use terrane_optim::Loss;
use terrane_optim::bundle::{BundleOptions, RefineIntrinsics};

use crate::bundle::{self, Scope};
use crate::cluster::Cluster;
use crate::initial::Start;
use crate::model::{Model, PointId};
use crate::points::{self, Limits};
use crate::registration::{self, Refusal};
use crate::{MappingError, MappingOptions, SubmapReport, assemble};

/// Images with fewer observations than this are held by too little.
const MIN_OBSERVED: u32 = 10;
/// Growth of the points that an image sees which is worth another attempt.
const RETRY_GROWTH: f64 = 1.25;
/// Rounds of retriangulation that a pair gets.
const MAX_RETRIANGULATIONS: u8 = 3;

/// What every submap of a cluster starts from.
pub(crate) struct Ground<'a> {
    /// The images and matches.
    pub cluster: &'a Cluster<'a>,
    /// Options of the mapping.
    pub options: &'a MappingOptions,
    /// Intrinsics to start from.
    pub cameras: &'a [Camera],
    /// Cameras whose focal length is a mere guess.
    pub guessed: &'a [bool],
}

/// A submap that has stopped growing.
pub(crate) struct Grown<'a> {
    /// The submap.
    pub model: Model<'a>,
    /// How it grew.
    pub report: SubmapReport,
    /// The last reason against each image that was tried.
    pub refusals: Vec<Option<Refusal>>,
}

/// Grows a submap from a pair. Images that are `taken` stay out of it.
pub(crate) fn grow<'a>(
    ground: &Ground<'a>,
    pair: usize,
    start: &Start,
    taken: &[bool],
    seed: Seed,
) -> Result<Grown<'a>, MappingError> {
    let mut grower = Grower::new(ground, pair, start, seed);
    grower.settle_start()?;
    while grower.holds() {
        if grower.register_next(taken)? {
            continue;
        }
        // Nothing more fits as it stands: refine the whole, which may let in images that failed before.
        grower.refine()?;
        grower.attempts.fill(0);
        if !grower.register_next(taken)? {
            break;
        }
    }
    Ok(grower.finish())
}

struct Grower<'a, 'g> {
    ground: &'g Ground<'a>,
    model: Model<'a>,
    limits: Limits,
    seed: Seed,
    report: SubmapReport,
    /// Failed attempts for each image since the last refinement.
    attempts: Vec<u32>,
    /// What each image saw when it failed last.
    visible_at_failure: Vec<u32>,
    refusals: Vec<Option<Refusal>>,
    /// Images that are not tried again.
    barred: Vec<bool>,
    /// Retriangulations of each pair.
    retriangulations: Vec<u8>,
    /// Images and points at the last full adjustment.
    at_last_full: (usize, usize),
    /// Counts random streams.
    step: u64,
}

impl<'a, 'g> Grower<'a, 'g> {
    fn new(ground: &'g Ground<'a>, pair: usize, start: &Start, seed: Seed) -> Self {
        let cluster = ground.cluster;
        let mut model = Model::new(cluster, ground.cameras.to_vec(), ground.guessed.to_vec());
        let images = &cluster.pairs[pair];
        model.set_pose(images.first, Rigid3::identity());
        model.set_pose(images.second, start.second_from_first);
        for (x_in_world, features) in &start.points {
            if !cluster.is_lone(features[0]) {
                model.add_point(*x_in_world, features);
            }
        }
        let report =
            SubmapReport { initial_pair: Some(images.source.summary.pair), ..SubmapReport::default() };
        Self {
            ground,
            model,
            limits: Limits::new(&ground.options.triangulation),
            seed,
            report,
            attempts: vec![0; cluster.num_images()],
            visible_at_failure: vec![0; cluster.num_images()],
            refusals: vec![None; cluster.num_images()],
            barred: vec![false; cluster.num_images()],
            retriangulations: vec![0; cluster.pairs.len()],
            at_last_full: (2, 0),
            step: 0,
        }
    }

    fn next_seed(&mut self, part: &str) -> Seed {
        self.step += 1;
        self.seed.derive(part).item(&[self.step])
    }

    /// Whether there is still a model to grow.
    fn holds(&self) -> bool {
        self.model.num_registered() >= 2 && self.model.num_points() >= MIN_OBSERVED as usize
    }

    /// Two views say little about intrinsics: only poses and points move.
    fn settle_start(&mut self) -> Result<(), MappingError> {
        self.adjust_whole(RefineIntrinsics::NONE, &self.growing_solver())?;
        let ids = self.model.point_ids();
        self.filter(&ids);
        self.mark_full();
        Ok(())
    }

    /// Registers the most promising image that will, and settles the model around it.
    fn register_next(&mut self, taken: &[bool]) -> Result<bool, MappingError> {
        let options = self.ground.options;
        for image in registration::next_images(&self.model, options.registration.min_inliers as u32) {
            if taken[image] || self.barred[image] || !self.is_worth_trying(image) {
                continue;
            }
            let seed = self.next_seed("register");
            match registration::register(&mut self.model, image, &options.registration, seed) {
                Ok(()) => {
                    let seed = self.next_seed("triangulate");
                    points::triangulate_image(&mut self.model, image, self.limits, seed);
                    self.settle(image)?;
                    return Ok(true);
                }
                Err(refusal) => {
                    self.report.failed_registrations += 1;
                    self.attempts[image] += 1;
                    self.visible_at_failure[image] = self.model.visibility.num_visible(image);
                    self.refusals[image] = Some(refusal);
                }
            }
        }
        Ok(false)
    }

    /// An image that failed waits until it sees clearly more.
    fn is_worth_trying(&self, image: usize) -> bool {
        let attempts = self.attempts[image];
        let visible = f64::from(self.model.visibility.num_visible(image));
        let grown = visible >= RETRY_GROWTH * f64::from(self.visible_at_failure[image]);
        attempts == 0 || (attempts < self.ground.options.registration.max_attempts && grown)
    }

    /// Adjusts after an image was added: around it, or everything when the model is small or has grown enough.
    fn settle(&mut self, image: usize) -> Result<(), MappingError> {
        let options = &self.ground.options.adjustment;
        let (images, points) = (self.model.num_registered(), self.model.num_points());
        let grown = images as f64 >= options.full_growth_images * self.at_last_full.0 as f64
            || points as f64 >= options.full_growth_points * self.at_last_full.1 as f64;
        if images <= options.small_model_images || grown {
            return self.adjust_fully();
        }
        let scope = Scope::around(&self.model, image, options.local_images);
        let solver = BundleOptions {
            max_iterations: options.local_iterations,
            cost_tolerance: 1e-4,
            ..self.solver(Loss::SoftL1)
        };
        let solved = bundle::adjust(&mut self.model, &scope, &solver)?;
        self.report.local_adjustments += 1;
        self.report.adjustment_iterations += solved.iterations;
        let mut changed = self.extend_touched();
        changed.extend(scope.points);
        changed.sort_unstable();
        changed.dedup();
        self.filter(&changed);
        Ok(())
    }

    /// A full adjustment while the model grows.
    fn adjust_fully(&mut self) -> Result<(), MappingError> {
        self.extend_touched();
        self.retriangulate();
        self.adjust_whole(self.refinement(), &self.growing_solver())?;
        let ids = self.model.point_ids();
        self.filter(&ids);
        self.remove_weak_images();
        self.mark_full();
        Ok(())
    }

    /// The refinement of a model that has stopped growing: adjust, extend and filter until little changes.
    fn refine(&mut self) -> Result<(), MappingError> {
        let adjustment = &self.ground.options.adjustment;
        let depth = self.ground.options.triangulation.completion_depth;
        self.retriangulate();
        for round in 0..adjustment.max_refinements {
            let before = self.model.num_observations().max(1);
            let ids = self.model.point_ids();
            let mut changed = points::complete(&mut self.model, &ids, depth, self.limits);
            let ids = self.model.point_ids();
            changed += points::merge(&mut self.model, &ids, self.limits);
            let refine = self.refinement();
            // What is still wrong by now is wrong for good: a loss that forgets it, where growth needs one that is convex.
            let solver = BundleOptions {
                max_iterations: adjustment.final_iterations,
                cost_tolerance: 1e-6,
                ..self.solver(Loss::Cauchy)
            };
            self.adjust_whole(refine, &solver)?;
            let ids = self.model.point_ids();
            changed += self.filter(&ids);
            self.remove_weak_images();
            if round > 0 && (changed as f64) < adjustment.min_refinement_change * before as f64 {
                break;
            }
        }
        self.mark_full();
        Ok(())
    }

    /// Wrong matches that are not yet filtered out must not bend the model.
    fn solver(&self, loss: Loss) -> BundleOptions {
        let loss_scale_px = self.ground.options.adjustment.loss_scale_px;
        BundleOptions { loss, loss_scale_px, ..BundleOptions::default() }
    }

    /// The solver of full adjustments while the model grows.
    fn growing_solver(&self) -> BundleOptions {
        BundleOptions {
            max_iterations: self.ground.options.adjustment.full_iterations,
            cost_tolerance: 1e-5,
            ..self.solver(Loss::SoftL1)
        }
    }

    /// Which intrinsics may move now.
    fn refinement(&self) -> RefineIntrinsics {
        let adjustment = &self.ground.options.adjustment;
        if self.model.num_registered() < 3 {
            return RefineIntrinsics::NONE;
        }
        RefineIntrinsics {
            focal: adjustment.refine_focal,
            principal_point: adjustment.refine_principal_point
                && self.model.num_registered() > adjustment.small_model_images,
            distortion: adjustment.refine_distortion,
        }
    }

    /// Adjusts everything. Where a camera leaves the sane range, all goes back and is adjusted again without its freedom.
    fn adjust_whole(&mut self, refine: RefineIntrinsics, solver: &BundleOptions) -> Result<(), MappingError> {
        let before = self.model.clone_geometry();
        for _ in 0..=self.model.cameras.len() {
            let scope = Scope::whole(&self.model, refine);
            let solved = bundle::adjust(&mut self.model, &scope, solver)?;
            self.report.full_adjustments += 1;
            self.report.adjustment_iterations += solved.iterations;
            let insane: Vec<usize> = (0..self.model.cameras.len())
                .filter(|&at| !bundle::is_sane(&self.model.cameras[at], &self.ground.options.adjustment))
                .filter(|&at| !self.model.frozen[at])
                .collect();
            if insane.is_empty() {
                break;
            }
            self.model.restore_geometry(&before);
            insane.into_iter().for_each(|camera| self.tame(camera));
        }
        self.model.normalise();
        Ok(())
    }

    /// Holds a camera at its first intrinsics. When few of the images are its, it may be no camera at all (a map, a drawing,
    /// a crop), and these images leave the model for good.
    fn tame(&mut self, camera: usize) {
        self.model.cameras[camera] = self.ground.cameras[camera];
        self.model.frozen[camera] = true;
        self.report.reset_cameras += 1;
        let registered = self.model.registered();
        let (own, others): (Vec<usize>, Vec<usize>) =
            registered.into_iter().partition(|&image| self.model.cluster.camera_of[image] == camera);
        if own.len() >= others.len() {
            return;
        }
        for image in own {
            self.model.deregister(image);
            self.barred[image] = true;
            self.refusals[image] = Some(Refusal::InsaneCamera);
            self.report.removed_images += 1;
        }
    }

    /// Completes and merges the tracks that changed; those that did so, or came of it.
    fn extend_touched(&mut self) -> Vec<PointId> {
        let depth = self.ground.options.triangulation.completion_depth;
        let ids = self.model.take_touched();
        points::complete(&mut self.model, &ids, depth, self.limits);
        points::merge(&mut self.model, &ids, self.limits);
        let mut changed = ids;
        changed.extend(self.model.take_touched());
        changed
    }

    fn retriangulate(&mut self) {
        let ratio = self.ground.options.triangulation.retriangulation_ratio;
        let seed = self.next_seed("retriangulate");
        let limits = self.limits;
        let attempts = (ratio, MAX_RETRIANGULATIONS);
        points::retriangulate(&mut self.model, &mut self.retriangulations, attempts, limits, seed);
    }

    fn filter(&mut self, ids: &[PointId]) -> usize {
        let removed = points::filter(&mut self.model, ids, self.limits);
        self.report.filtered_observations += removed as u64;
        removed
    }

    fn remove_weak_images(&mut self) {
        let removed = points::remove_weak_images(&mut self.model, MIN_OBSERVED);
        self.report.removed_images += removed.len() as u32;
        for image in removed {
            self.attempts[image] += 1;
            self.visible_at_failure[image] = self.model.visibility.num_visible(image);
            self.refusals[image] = Some(Refusal::LostSupport { min_observed: MIN_OBSERVED });
        }
    }

    fn mark_full(&mut self) {
        self.at_last_full = (self.model.num_registered(), self.model.num_points());
    }

    fn finish(mut self) -> Grown<'a> {
        self.model.normalise();
        let result = assemble::reconstruction(&self.model);
        self.report.num_images = self.model.num_registered() as u32;
        self.report.num_points = self.model.num_points() as u64;
        self.report.num_observations = self.model.num_observations() as u64;
        self.report.mean_reprojection_error_px = result.mean_reprojection_error_px();
        self.report.mean_track_length = result.mean_track_length();
        Grown { model: self.model, report: self.report, refusals: self.refusals }
    }
}
