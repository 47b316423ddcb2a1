//! Everything about a mapping that may be chosen.

use serde::{Deserialize, Serialize};

/// Options of [`crate::reconstruct`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MappingOptions {
    /// Fewest images of a submap beyond the first; the first may have two. Range: 2 and more. Default 3: two views
    /// have no third that could contradict them.
    pub min_submap_images: usize,
    /// Most submaps of one cluster. Range: 1 and more. Default 20.
    pub max_submaps: usize,
    /// Choice of the pair to start from.
    pub initial: InitialPairOptions,
    /// Adding an image to the model.
    pub registration: RegistrationOptions,
    /// Adding, completing and filtering points.
    pub triangulation: TriangulationOptions,
    /// Local and full bundle adjustment.
    pub adjustment: AdjustmentOptions,
}

impl Default for MappingOptions {
    fn default() -> Self {
        Self {
            min_submap_images: 3,
            max_submaps: 20,
            initial: InitialPairOptions::default(),
            registration: RegistrationOptions::default(),
            triangulation: TriangulationOptions::default(),
            adjustment: AdjustmentOptions::default(),
        }
    }
}

/// Choice of the pair that a submap starts from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct InitialPairOptions {
    /// Fewest points that the pair must give, once halved when no pair has as many. Range: 10 and more. Default 100
    /// (Schönberger & Frahm 2016, their implementation).
    pub min_points: usize,
    /// Smallest median angle between the rays of the pair's points in degrees, halved twice when no pair has it.
    /// Range: above 0, below 90. Default 12, between the 16 of Schönberger & Frahm's implementation and what aerial
    /// blocks with 80 % overlap offer.
    pub min_median_angle_deg: f64,
    /// Share of the baseline that may point along the optical axis. Range: 0 to 1. Default 0.95 (as above).
    pub max_forward_motion: f64,
    /// Most pairs whose geometry is tried. Range: 1 and more. Default 60.
    pub max_trials: usize,
    /// Most initial pairs from which a whole model is grown when models stay small; the largest is kept. Range: 1 and
    /// more. Default 3.
    pub max_models: usize,
    /// Largest error of a match in pixels. Range: above 0. Default 4 (as above).
    pub max_error_px: f64,
}

impl Default for InitialPairOptions {
    fn default() -> Self {
        Self {
            min_points: 100,
            min_median_angle_deg: 12.0,
            max_forward_motion: 0.95,
            max_trials: 60,
            max_models: 3,
            max_error_px: 4.0,
        }
    }
}

/// Adding an image to the model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RegistrationOptions {
    /// Largest reprojection error of an inlier in pixels. Range: above 0. Default 8, loose because the intrinsics
    /// may still be wrong; points are then filtered more strictly.
    pub max_error_px: f64,
    /// Fewest inliers. Range: 6 and more. Default 20 (30 in Schönberger & Frahm's implementation, whose features are
    /// denser).
    pub min_inliers: usize,
    /// Smallest share of inliers among the correspondences. Range: 0 to 1. Default 0.25 (as above).
    pub min_inlier_ratio: f64,
    /// Most attempts to add one image. Range: 1 and more. Default 3 (as above).
    pub max_attempts: u32,
    /// Most RANSAC iterations of an attempt. Range: 1 and more. Default 10000.
    pub max_iterations: u32,
    /// Probability that RANSAC has drawn an outlier-free sample. Range: 0 to 1. Default 0.99999.
    pub confidence: f64,
}

impl Default for RegistrationOptions {
    fn default() -> Self {
        Self {
            max_error_px: 8.0,
            min_inliers: 20,
            min_inlier_ratio: 0.25,
            max_attempts: 3,
            max_iterations: 10_000,
            confidence: 0.999_99,
        }
    }
}

/// Adding, completing and filtering points. Defaults from Schönberger & Frahm 2016 and their implementation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TriangulationOptions {
    /// Largest reprojection error of an observation in pixels. Range: above 0. Default 4.
    pub max_error_px: f64,
    /// Smallest largest angle between two rays of a point in degrees. Range: above 0, below 90. Default 1.5.
    pub min_angle_deg: f64,
    /// How many matches away from a track a further observation may be. Range: 1 and more. Default 5.
    pub completion_depth: u32,
    /// Share of a pair's matches that share a point below which the pair is triangulated again. Range: 0 to 1.
    /// Default 0.2.
    pub retriangulation_ratio: f64,
    /// Matches that no third image shares become points only in pairs with fewer other matches than this: nothing
    /// confirms them, but chains of images need them. Range: any; 0 leaves all of them out. Default 100: on castle-P19
    /// leaving them out lowers the error of camera centres by an eighth.
    pub two_view_limit: usize,
}

impl Default for TriangulationOptions {
    fn default() -> Self {
        Self {
            max_error_px: 4.0,
            min_angle_deg: 1.5,
            completion_depth: 5,
            retriangulation_ratio: 0.2,
            two_view_limit: 100,
        }
    }
}

/// Local and full bundle adjustment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AdjustmentOptions {
    /// Images that a local adjustment moves, the new one included. Range: 2 and more. Default 6 (Schönberger & Frahm
    /// 2016).
    pub local_images: usize,
    /// Most iterations of a local adjustment. Range: 1 and more. Default 10.
    pub local_iterations: u32,
    /// Models up to this many images are adjusted whole after each image. Range: 2 and more. Default 8: it is as cheap
    /// as a local adjustment and settles the intrinsics.
    pub small_model_images: usize,
    /// Growth in images since the last full adjustment that calls for the next. Range: above 1. Default 1.2 (1.1 in
    /// Schönberger & Frahm's implementation; measured to make no difference here).
    pub full_growth_images: f64,
    /// Growth in points since the last full adjustment that calls for the next. Range: above 1. Default 1.25.
    pub full_growth_points: f64,
    /// Most iterations of a full adjustment while the model grows. Range: 1 and more. Default 10.
    pub full_iterations: u32,
    /// Most iterations of a full adjustment of the finished model. Range: 1 and more. Default 50.
    pub final_iterations: u32,
    /// Most rounds of adjusting and filtering the finished model. Range: 1 and more. Default 5.
    pub max_refinements: u32,
    /// Share of observations that a round of refinement must change to call for another. Range: 0 to 1. Default
    /// 0.0005 (Schönberger & Frahm's implementation).
    pub min_refinement_change: f64,
    /// Scale of the robust loss in pixels: SoftL1 while the model grows, Cauchy for the finished model. Range: above 0.
    /// Default 1, two to three times the noise of SIFT keypoints.
    pub loss_scale_px: f64,
    /// Refine focal lengths that the user did not give. Default true.
    pub refine_focal: bool,
    /// Refine distortion of cameras whose intrinsics the user did not give. Default true.
    pub refine_distortion: bool,
    /// Refine principal points of such cameras in the finished model. Default false: it is badly determined.
    pub refine_principal_point: bool,
    /// Smallest sane focal length as a share of the image's longer side. Range: above 0. Default 0.1.
    pub min_focal_ratio: f64,
    /// Largest sane focal length as a share of the image's longer side. Range: above the smallest. Default 10.
    pub max_focal_ratio: f64,
    /// Largest sane distortion coefficient. Range: above 0. Default 1.
    pub max_distortion: f64,
}

impl Default for AdjustmentOptions {
    fn default() -> Self {
        Self {
            local_images: 6,
            local_iterations: 10,
            small_model_images: 8,
            full_growth_images: 1.2,
            full_growth_points: 1.25,
            full_iterations: 10,
            final_iterations: 50,
            max_refinements: 5,
            min_refinement_change: 0.0005,
            loss_scale_px: 1.0,
            refine_focal: true,
            refine_distortion: true,
            refine_principal_point: false,
            min_focal_ratio: 0.1,
            max_focal_ratio: 10.0,
            max_distortion: 1.0,
        }
    }
}

impl MappingOptions {
    /// Every problem at once, each with its path (`mapping.initial.min_points: must be at least 10`).
    pub fn validate(&self, path: &str) -> Vec<String> {
        let mut problems = Vec::new();
        let mut check = |holds: bool, field: &str, rule: &str| {
            if !holds {
                problems.push(format!("{path}.{field}: must be {rule}"));
            }
        };
        check(self.min_submap_images >= 2, "min_submap_images", "at least 2");
        check(self.max_submaps >= 1, "max_submaps", "at least 1");
        let angle = |deg: f64| deg > 0.0 && deg < 90.0;
        let share = |value: f64| (0.0..=1.0).contains(&value);
        let initial = &self.initial;
        check(initial.min_points >= 10, "initial.min_points", "at least 10");
        check(angle(initial.min_median_angle_deg), "initial.min_median_angle_deg", "above 0 and below 90");
        check(share(initial.max_forward_motion), "initial.max_forward_motion", "between 0 and 1");
        check(initial.max_trials >= 1, "initial.max_trials", "at least 1");
        check(initial.max_models >= 1, "initial.max_models", "at least 1");
        check(initial.max_error_px > 0.0, "initial.max_error_px", "above 0");
        let registration = &self.registration;
        check(registration.max_error_px > 0.0, "registration.max_error_px", "above 0");
        check(registration.min_inliers >= 6, "registration.min_inliers", "at least 6");
        check(share(registration.min_inlier_ratio), "registration.min_inlier_ratio", "between 0 and 1");
        check(registration.max_attempts >= 1, "registration.max_attempts", "at least 1");
        check(registration.max_iterations >= 1, "registration.max_iterations", "at least 1");
        check(share(registration.confidence), "registration.confidence", "between 0 and 1");
        let points = &self.triangulation;
        check(points.max_error_px > 0.0, "triangulation.max_error_px", "above 0");
        check(angle(points.min_angle_deg), "triangulation.min_angle_deg", "above 0 and below 90");
        check(points.completion_depth >= 1, "triangulation.completion_depth", "at least 1");
        check(share(points.retriangulation_ratio), "triangulation.retriangulation_ratio", "between 0 and 1");
        let adjustment = &self.adjustment;
        check(adjustment.local_images >= 2, "adjustment.local_images", "at least 2");
        check(adjustment.local_iterations >= 1, "adjustment.local_iterations", "at least 1");
        check(adjustment.small_model_images >= 2, "adjustment.small_model_images", "at least 2");
        check(adjustment.full_growth_images > 1.0, "adjustment.full_growth_images", "above 1");
        check(adjustment.full_growth_points > 1.0, "adjustment.full_growth_points", "above 1");
        check(adjustment.full_iterations >= 1, "adjustment.full_iterations", "at least 1");
        check(adjustment.final_iterations >= 1, "adjustment.final_iterations", "at least 1");
        check(adjustment.max_refinements >= 1, "adjustment.max_refinements", "at least 1");
        check(share(adjustment.min_refinement_change), "adjustment.min_refinement_change", "between 0 and 1");
        check(adjustment.loss_scale_px > 0.0, "adjustment.loss_scale_px", "above 0");
        check(adjustment.min_focal_ratio > 0.0, "adjustment.min_focal_ratio", "above 0");
        let focal = adjustment.max_focal_ratio > adjustment.min_focal_ratio;
        check(focal, "adjustment.max_focal_ratio", "above min_focal_ratio");
        check(adjustment.max_distortion > 0.0, "adjustment.max_distortion", "above 0");
        problems
    }
}
