//! Matching and verification of real pairs: CPU seconds, and inliers beside COLMAP's on the same pairs.

use std::collections::BTreeMap;

use nalgebra::Vector2;
use rayon::prelude::*;
use terrane_benches::Request;
use terrane_benches::table::{Bar, Row};
use terrane_benches::usage::cpu_of;
use terrane_frontend::matching::{MatchKernel, MatchOptions, PreparedImage, match_prepared};
use terrane_frontend::sift::{self, SiftOptions};
use terrane_frontend::verification::{Candidate, VerificationOptions, View, verify};
use terrane_geometry::Seed;
use terrane_scene::{Features, ImageId, ImagePair};

use crate::peer;
use crate::sets::{Photograph, SETS, Set, decoded};
use crate::surveyed::{Inlier, Surveyed, colmap_inliers};

/// Pairs of the largest set that are looked at: every so many-th.
const MOST_PAIRS: usize = 300;
/// COLMAP's least number of inliers of a verified pair.
const MIN_INLIERS: f64 = 15.0;

pub fn rows(request: &Request) -> anyhow::Result<Vec<Row>> {
    let mut rows = Vec::new();
    let mut ratios = Vec::new();
    let mut milliseconds = Vec::new();
    for set in SETS.iter().filter(|set| request.wants_set(set.name, set.quick)) {
        let answer = peer::frontend(set, &[]);
        let Some(theirs) = answer.as_ref().and_then(|answer| inliers_by_pair(&answer.value)) else {
            rows.push(
                Row::new(format!("{}: inliers", set.name), None, "", Bar::None).note("COLMAP did not run"),
            );
            continue;
        };
        let photographs = set.photographs(usize::MAX)?;
        let confirmed = Surveyed::of(set)?.zip(colmap_inliers(set));
        let compared = compare(&photographs, &theirs, confirmed.as_ref())?;
        let cpu = answer.as_ref().and_then(|answer| peer::number(&answer.value, &["match", "cpu_s"]));
        let tried = answer.as_ref().and_then(|answer| answer.value["pairs_tried"].as_f64());
        let per_pair = cpu.zip(tried).map(|(cpu, tried)| cpu / tried.max(1.0));
        rows.extend(set_rows(set, &compared, per_pair));
        rows.extend(right_rows(set, &compared.right));
        ratios.extend(compared.ratios);
        milliseconds.extend(compared.verification_ms);
    }
    rows.push(Row::new(
        "inliers over COLMAP's, median over all pairs",
        median(&mut ratios),
        "",
        Bar::AtLeast(1.0),
    ));
    rows.push(Row::new(
        "verification, median over all pairs",
        median(&mut milliseconds),
        "ms",
        Bar::AtMost(3.0),
    ));
    Ok(rows)
}

/// Inliers that COLMAP found, by the names of both photographs.
fn inliers_by_pair(value: &serde_json::Value) -> Option<BTreeMap<(String, String), f64>> {
    let rows = value["pairs"].as_array()?;
    let pairs = rows.iter().filter_map(|row| {
        let (a, b) = (row[0].as_str()?.to_owned(), row[1].as_str()?.to_owned());
        Some((if a < b { (a, b) } else { (b, a) }, row[2].as_f64()?))
    });
    Some(pairs.collect())
}

/// What a set's pairs gave.
struct Compared {
    ours: Vec<f64>,
    theirs: Vec<f64>,
    ratios: Vec<f64>,
    verification_ms: Vec<f64>,
    cpu_per_pair_s: f64,
    right: Vec<Right>,
}

/// A pair's inliers, and those of them that surveyed cameras confirm.
struct Right {
    ours: [f64; 2],
    theirs: [f64; 2],
}

type Inliers = BTreeMap<(String, String), Vec<Inlier>>;

fn compare(
    photographs: &[Photograph],
    theirs: &BTreeMap<(String, String), f64>,
    confirmed: Option<&(Surveyed, Inliers)>,
) -> anyhow::Result<Compared> {
    let features: Vec<Features> = decoded(photographs)?
        .par_iter()
        .map(|image| sift::extract(&image.luma, None, &SiftOptions::default()))
        .collect();
    let place = |name: &str| photographs.iter().position(|photograph| photograph.name == name);
    let step = theirs.len().div_ceil(MOST_PAIRS).max(1);
    let chosen: Vec<(usize, usize, f64)> = theirs
        .iter()
        .step_by(step)
        .filter_map(|((a, b), inliers)| Some((place(a)?, place(b)?, *inliers)))
        .collect();
    let mut compared = Compared {
        ours: vec![],
        theirs: vec![],
        ratios: vec![],
        verification_ms: vec![],
        cpu_per_pair_s: 0.0,
        right: vec![],
    };
    let options = MatchOptions::default();
    let (preparing_s, prepared) = cpu_of(|| -> Vec<PreparedImage> {
        features.iter().map(|features| PreparedImage::new(features, &options)).collect()
    });
    // Once an image, for all of its pairs.
    let mut total_s = preparing_s * chosen.len() as f64 / theirs.len().max(1) as f64;
    for &(a, b, inliers) in &chosen {
        let (matching_s, matches) = cpu_of(|| match_prepared(&prepared[a], &prepared[b], &options));
        let ids = (ImageId(a as u32), ImageId(b as u32));
        let pair = ImagePair::new(ids.0, ids.1).ok_or_else(|| anyhow::anyhow!("a pair of one photograph"))?;
        let view = |at: usize| View { camera: &photographs[at].camera, keypoints: &features[at].keypoints };
        let candidate = Candidate { pair, first: view(a), second: view(b), matches: &matches };
        let (verification_s, verified) =
            cpu_of(|| verify(&candidate, &VerificationOptions::default(), Seed(0)));
        total_s += matching_s + verification_s;
        let matches = verified.map(|pair| pair.matches).unwrap_or_default();
        let ours = matches.len() as f64;
        if ours >= MIN_INLIERS || inliers >= MIN_INLIERS {
            compared.ours.push(ours);
            compared.theirs.push(inliers);
            compared.ratios.push(ours / inliers.max(1.0));
            compared.verification_ms.push(verification_s * 1e3);
            let inliers = inlier_points(&matches, [&features[a], &features[b]]);
            let names = [a, b].map(|at| photographs[at].name.as_str());
            compared.right.extend(confirmed.map(|confirmed| right(names, &inliers, confirmed)));
        }
    }
    compared.cpu_per_pair_s = total_s / chosen.len().max(1) as f64;
    Ok(compared)
}

fn inlier_points(matches: &[[u32; 2]], features: [&Features; 2]) -> Vec<Inlier> {
    let point = |k: usize, at: u32| {
        let keypoint = &features[k].keypoints[at as usize];
        Vector2::new(f64::from(keypoint.x_px), f64::from(keypoint.y_px))
    };
    matches.iter().map(|&[a, b]| [point(0, a), point(1, b)]).collect()
}

fn right(names: [&str; 2], ours: &[Inlier], (surveyed, theirs): &(Surveyed, Inliers)) -> Right {
    let none = Vec::new();
    let theirs = theirs.get(&names.map(str::to_owned).into()).unwrap_or(&none);
    let counts = |inliers: &[Inlier]| [inliers.len(), surveyed.num_right(names, inliers)].map(|n| n as f64);
    Right { ours: counts(ours), theirs: counts(theirs) }
}

/// Of the pairs in which either has enough right inliers: right inliers over COLMAP's. Of all: verified pairs most of whose
/// inliers are wrong.
fn right_rows(set: &Set, right: &[Right]) -> Vec<Row> {
    if right.is_empty() {
        return Vec::new();
    }
    let figure = |what: &str| format!("{}, inliers that surveyed cameras confirm: {what}", set.name);
    let enough = |pair: &&Right| pair.ours[1].max(pair.theirs[1]) >= MIN_INLIERS;
    let mut ratios: Vec<f64> =
        right.iter().filter(enough).map(|pair| pair.ours[1] / pair.theirs[1].max(1.0)).collect();
    let sum = |of: fn(&Right) -> [f64; 2]| right.iter().map(|pair| of(pair)[1]).sum::<f64>();
    let sums = sum(|pair| pair.ours) / sum(|pair| pair.theirs).max(1.0);
    let wrong = |of: fn(&Right) -> [f64; 2]| {
        let is_wrong = |[all, right]: [f64; 2]| all >= MIN_INLIERS && right < 0.5 * all;
        right.iter().filter(|pair| is_wrong(of(pair))).count() as f64
    };
    vec![
        Row::new(figure("pairs"), Some(ratios.len() as f64), "", Bar::None),
        Row::new(figure("over COLMAP's, median"), median(&mut ratios), "", Bar::None),
        Row::new(figure("all over all of COLMAP's"), Some(sums), "", Bar::None),
        Row::new(figure("verified pairs mostly wrong"), Some(wrong(|pair| pair.ours)), "", Bar::None),
        Row::new(
            figure("COLMAP's verified pairs mostly wrong"),
            Some(wrong(|pair| pair.theirs)),
            "",
            Bar::None,
        ),
    ]
}

fn set_rows(set: &Set, compared: &Compared, their_cpu_s: Option<f64>) -> Vec<Row> {
    let figure = |what: &str| format!("{}: {what}", set.name);
    let (mut ours, mut theirs, mut ratios) =
        (compared.ours.clone(), compared.theirs.clone(), compared.ratios.clone());
    let share = their_cpu_s.map(|theirs| compared.cpu_per_pair_s / theirs);
    let is_named = matches!(set.name, "castle-P19" | "brighton-half");
    let is_wide = MatchKernel::available().iter().any(|kernel| kernel.name() == "avx512-vnni");
    let (inlier_bar, cpu_bar) = if is_named {
        (Bar::AtLeast(0.98), Bar::AtMost(if is_wide { 0.05 } else { 0.2 }))
    } else {
        (Bar::None, Bar::None)
    };
    let sums = compared.ours.iter().sum::<f64>() / compared.theirs.iter().sum::<f64>().max(1.0);
    vec![
        Row::new(figure("verified pairs"), Some(ours.len() as f64), "", Bar::None),
        Row::new(figure("inliers, median"), median(&mut ours), "", Bar::None),
        Row::new(figure("COLMAP's inliers, median"), median(&mut theirs), "", Bar::None),
        Row::new(figure("inliers over COLMAP's, median"), median(&mut ratios), "", inlier_bar),
        Row::new(figure("all inliers over all of COLMAP's"), Some(sums), "", Bar::None),
        Row::new(
            figure("match + verify, CPU per pair"),
            Some(compared.cpu_per_pair_s * 1e3),
            "ms",
            Bar::None,
        ),
        Row::new(figure("match + verify, share of COLMAP's CPU"), share, "", cpu_bar),
    ]
}

fn median(values: &mut [f64]) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
