//! The whole of a mapping: submap after submap until no pair can start another.

use terrane_geometry::Seed;
use terrane_scene::SubmapOutcome;

use crate::cluster::Cluster;
use crate::error::Kind;
use crate::grow::{self, Ground, Grown};
use crate::initial::{self, Start, Strictness};
use crate::{
    ClusterInput, InitialTrial, MappingError, MappingOptions, MappingReport, TrialVerdict, assemble, focal,
};

/// A submap with this share of the images that it could reach is taken without looking for a better start.
const GOOD_SHARE: f64 = 0.5;

/// Rebuilds the cameras and points of a cluster.
///
/// Submaps are in frames and scales of their own, with camera centres about the origin and an extent of about ten; the
/// largest is first. Every image of the cluster has a fate in the outcome: its submap, or the reason why it is in none.
/// The same input, options and seed give the same bytes for any number of threads. Position priors are carried for later
/// stages and do not bear on the result.
///
/// # Errors
/// When the input contradicts itself (an image twice, a match of a feature that does not exist, a camera without a
/// record) or an option is out of range.
pub fn reconstruct(
    input: &ClusterInput,
    options: &MappingOptions,
    seed: Seed,
) -> Result<(SubmapOutcome, MappingReport), MappingError> {
    let problems = options.validate("mapping");
    if !problems.is_empty() {
        return Err(Kind::Options(problems.join("; ")).into());
    }
    let cluster = Cluster::new(input, options.triangulation.two_view_limit)?;
    let (cameras, guessed) = focal::initial_cameras(&cluster, seed);
    let ground = Ground { cluster: &cluster, options, cameras: &cameras, guessed: &guessed };
    let mut mapping = Mapping {
        ground: &ground,
        taken: vec![false; cluster.num_images()],
        submaps: Vec::new(),
        trials: Vec::new(),
        reasons: vec![None; cluster.num_images()],
    };
    while mapping.submaps.len() < options.max_submaps {
        let seed = seed.derive("submap").item(&[mapping.submaps.len() as u64]);
        if !mapping.add_submap(seed)? {
            break;
        }
    }
    Ok(mapping.finish())
}

/// The submaps so far.
struct Mapping<'a, 'g> {
    ground: &'g Ground<'a>,
    taken: Vec<bool>,
    submaps: Vec<Grown<'a>>,
    trials: Vec<InitialTrial>,
    /// Why an image is in no submap.
    reasons: Vec<Option<String>>,
}

impl<'a> Mapping<'a, '_> {
    /// Finds the largest submap among the images that are left; false when there is none.
    fn add_submap(&mut self, seed: Seed) -> Result<bool, MappingError> {
        let Some(best) = self.largest(seed)? else { return Ok(false) };
        for image in best.model.registered() {
            self.taken[image] = true;
        }
        self.submaps.push(best);
        Ok(true)
    }

    /// The largest model from several starts, the first of which usually does.
    fn largest(&mut self, seed: Seed) -> Result<Option<Grown<'a>>, MappingError> {
        let options = self.ground.options;
        let mut candidates = initial::candidates(self.ground.cluster, &self.taken);
        candidates.truncate(options.initial.max_trials);
        let mut starts: Vec<Option<Result<Start, String>>> = candidates.iter().map(|_| None).collect();
        let mut best: Option<(Grown<'a>, usize)> = None;
        let mut num_models = 0;
        let first_trial = self.trials.len();
        let ladder = Strictness::ladder(&options.initial);
        for (level, strictness) in ladder.iter().enumerate() {
            for (place, &pair) in candidates.iter().enumerate() {
                if num_models >= options.initial.max_models || self.is_covered(best.as_ref(), pair) {
                    continue;
                }
                let start = starts[place].get_or_insert_with(|| self.start(pair, seed));
                let weakness = match start {
                    Ok(start) => initial::weakness(start, strictness),
                    Err(reason) => Some(reason.clone()),
                };
                if let Some(reason) = weakness {
                    if level + 1 == ladder.len() {
                        self.record(pair, TrialVerdict::Refused { reason });
                    }
                    continue;
                }
                let Ok(start) = start else { continue };
                num_models += 1;
                let seed = seed.derive("grow").item(&[pair as u64]);
                let grown = grow::grow(self.ground, pair, start, &self.taken, seed)?;
                let images = grown.model.num_registered();
                let trial = self.trials.len();
                self.record(pair, TrialVerdict::Outgrown { images: images as u32 });
                self.remember(&grown);
                if images >= self.fewest_images()
                    && best.as_ref().is_none_or(|(known, _)| is_larger(&grown, known))
                {
                    best = Some((grown, trial));
                }
                if images as f64 >= GOOD_SHARE * self.reachable_from(pair) as f64 {
                    num_models = options.initial.max_models;
                }
            }
            if best.is_some() {
                break;
            }
        }
        self.explain_unstarted(first_trial);
        Ok(best.map(|(grown, trial)| {
            self.trials[trial].verdict = TrialVerdict::Kept { images: grown.report.num_images };
            grown
        }))
    }

    fn start(&self, pair: usize, seed: Seed) -> Result<Start, String> {
        let ground = self.ground;
        let options = (&ground.options.initial, &ground.options.triangulation);
        initial::start(
            ground.cluster,
            pair,
            ground.cameras,
            options,
            seed.derive("start").item(&[pair as u64]),
        )
    }

    fn record(&mut self, pair: usize, verdict: TrialVerdict) {
        let pair = self.ground.cluster.pairs[pair].source.summary.pair;
        self.trials.push(InitialTrial { pair, verdict });
    }

    /// Whether a pair lies within a model of some size: starting there again would hardly give another.
    fn is_covered(&self, best: Option<&(Grown<'a>, usize)>, pair: usize) -> bool {
        let pair = &self.ground.cluster.pairs[pair];
        best.is_some_and(|(grown, _)| {
            let model = &grown.model;
            model.num_registered() >= 5 && model.is_registered(pair.first) && model.is_registered(pair.second)
        })
    }

    /// Fewest images of a submap that is kept.
    fn fewest_images(&self) -> usize {
        if self.submaps.is_empty() { 2 } else { self.ground.options.min_submap_images }
    }

    /// Images that are linked to a pair by pairs of images that are left.
    fn reachable_from(&self, pair: usize) -> usize {
        let cluster = self.ground.cluster;
        let first = cluster.pairs[pair].first;
        let mut seen = self.taken.clone();
        let mut open = vec![first];
        seen[first] = true;
        let mut count = 0;
        while let Some(image) = open.pop() {
            count += 1;
            for &at in &cluster.pairs_of[image] {
                let other = cluster.pairs[at].other(image);
                if !seen[other] {
                    seen[other] = true;
                    open.push(other);
                }
            }
        }
        count
    }

    /// Keeps the last word of a model on the images that it left out.
    fn remember(&mut self, grown: &Grown<'a>) {
        for (image, refusal) in grown.refusals.iter().enumerate() {
            if let Some(refusal) = refusal {
                self.reasons[image] = Some(refusal.reason(&self.ground.options.registration));
            }
        }
    }

    /// Says of the images of refused pairs why these could start nothing, where nothing else is known.
    fn explain_unstarted(&mut self, first_trial: usize) {
        let cluster = self.ground.cluster;
        for trial in &self.trials[first_trial..] {
            let TrialVerdict::Refused { reason } = &trial.verdict else { continue };
            for image in [trial.pair.first(), trial.pair.second()] {
                let Ok(at) = cluster.images.binary_search_by_key(&image, |entry| entry.image) else {
                    continue;
                };
                let (a, b) = (trial.pair.first(), trial.pair.second());
                self.reasons[at]
                    .get_or_insert_with(|| format!("no submap starts here: of pair {a}-{b}, {reason}"));
            }
        }
    }

    fn finish(mut self) -> (SubmapOutcome, MappingReport) {
        let cluster = self.ground.cluster;
        self.submaps
            .sort_by_key(|grown| std::cmp::Reverse((grown.report.num_images, grown.report.num_points)));
        let reasons: Vec<String> = (0..cluster.num_images())
            .map(|image| self.reasons[image].clone().unwrap_or_else(|| self.missing_link(image)))
            .collect();
        let (models, submaps): (Vec<_>, Vec<_>) =
            self.submaps.into_iter().map(|grown| (grown.model, grown.report)).unzip();
        let report = MappingReport {
            cluster: cluster.id,
            num_images: cluster.num_images() as u32,
            num_pairs: cluster.pairs.len() as u32,
            num_matches: cluster.pairs.iter().map(|pair| pair.source.matches.len() as u64).sum(),
            num_registered: submaps.iter().map(|submap| submap.num_images).sum(),
            submaps,
            trials: self.trials,
        };
        (assemble::outcome(cluster, &models, &reasons), report)
    }

    /// Why an image that no model ever tried is left out.
    fn missing_link(&self, image: usize) -> String {
        let cluster = self.ground.cluster;
        let pairs = &cluster.pairs_of[image];
        if cluster.images[image].keypoints_px.is_empty() {
            "it has no features".to_owned()
        } else if pairs.is_empty() {
            "it has no verified pair with another image of the cluster".to_owned()
        } else if pairs.iter().all(|&at| !cluster.pairs[at].source.summary.kind.has_baseline()) {
            "the camera only turned between it and every image that it matches: there is no depth".to_owned()
        } else {
            "it sees too few points of any submap".to_owned()
        }
    }
}

/// More images, or as many with more points.
fn is_larger(a: &Grown<'_>, b: &Grown<'_>) -> bool {
    (a.report.num_images, a.report.num_points) > (b.report.num_images, b.report.num_points)
}
