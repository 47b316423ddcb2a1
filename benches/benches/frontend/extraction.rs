//! SIFT: CPU seconds an image, at equal first octave and equal number of features.

use terrane_benches::Request;
use terrane_benches::table::{Bar, Row};
use terrane_benches::usage::cpu_of;
use terrane_frontend::image::{self, DecodeOptions};
use terrane_frontend::sift::{self, FirstOctave, SiftOptions};

use crate::peer;
use crate::sets::{Photograph, Set};

/// The sets that the bar names.
const NAMES: [&str; 3] = ["fountain-P11", "brighton-half", "castle-P19"];
/// Photographs of each set; they are much alike.
const LIMIT: usize = 4;
/// Repetitions of ours, of which the quickest counts.
const ROUNDS: usize = 3;

pub fn rows(request: &Request) -> anyhow::Result<Vec<Row>> {
    let mut rows = Vec::new();
    for set in NAMES.iter().map(|name| Set::named(name)).filter(|set| request.wants_set(set.name, set.quick))
    {
        let photographs = set.photographs(LIMIT)?;
        for (octave, first_octave) in [("-1", FirstOctave::Doubled), ("0", FirstOctave::Original)] {
            rows.extend(compare(set, &photographs, octave, first_octave)?);
        }
    }
    Ok(rows)
}

fn compare(
    set: &Set,
    photographs: &[Photograph],
    octave: &str,
    first_octave: FirstOctave,
) -> anyhow::Result<Vec<Row>> {
    let limit = photographs.len().to_string();
    let flags = ["--extract-only", "--limit", &limit, "--first-octave", octave];
    let answer = peer::frontend(set, &flags);
    let count = photographs.len() as f64;
    let theirs = answer
        .as_ref()
        .and_then(|answer| peer::number(&answer.value, &["extract", "cpu_s"]))
        .map(|s| s / count);
    let features = answer.as_ref().and_then(|answer| {
        Some(
            answer.value["images"].as_object()?.values().filter_map(serde_json::Value::as_f64).sum::<f64>()
                / count,
        )
    });
    let options = SiftOptions { first_octave, ..SiftOptions::default() };
    let options = as_many(photographs, options, features)?;
    let (seconds, found) = ours(photographs, &options)?;
    let figure = |what: &str| format!("{}, first octave {octave}: {what}", set.name);
    let note = answer.as_ref().map_or("COLMAP did not run", |answer| answer.note);
    let ratio = theirs.map(|theirs| seconds / theirs);
    Ok(vec![
        Row::new(figure("CPU per image, decoding included"), Some(seconds), "s", Bar::None)
            .note(format!("{found:.0} features an image")),
        Row::new(figure("COLMAP"), theirs, "s", Bar::None)
            .note(format!("{:.0} features an image; {note}", features.unwrap_or(0.0))),
        Row::new(figure("share of COLMAP's CPU"), ratio, "", Bar::AtMost(0.1)),
    ])
}

/// Options that give as many features an image as the peer has, for a limit counts blobs.
fn as_many(
    photographs: &[Photograph],
    mut options: SiftOptions,
    wanted: Option<f64>,
) -> anyhow::Result<SiftOptions> {
    let Some(wanted) = wanted else { return Ok(options) };
    options.max_features = wanted.round() as u32;
    let (_, found) = ours(&photographs[..1], &options)?;
    options.max_features = (wanted * wanted / found.max(1.0)).round() as u32;
    Ok(options)
}

/// CPU seconds and features per image, one thread.
fn ours(photographs: &[Photograph], options: &SiftOptions) -> anyhow::Result<(f64, f64)> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    let mut best_s = f64::INFINITY;
    let mut found = 0;
    for _ in 0..ROUNDS {
        let (seconds, features) = cpu_of(|| {
            pool.install(|| -> anyhow::Result<usize> {
                let mut features = 0;
                for photograph in photographs {
                    let decoded = image::decode(&photograph.bytes, &DecodeOptions::default())?;
                    features += sift::extract(&decoded.luma, decoded.rgb.as_ref(), options).len();
                }
                Ok(features)
            })
        });
        best_s = best_s.min(seconds);
        found = features?;
    }
    let count = photographs.len() as f64;
    Ok((best_s / count, found as f64 / count))
}
