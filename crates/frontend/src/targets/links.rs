//! Which saddles are ends of one edge.

use std::f64::consts::{PI, TAU};

use nalgebra::Vector2;
use rayon::prelude::*;

use super::gray::FloatImage;
use super::saddles::Saddle;

/// For each saddle and each of its rays: the saddle at the ray's end, and which of that one's rays comes back.
pub(super) type Links = Vec<[Option<(usize, usize)>; 4]>;

/// Angles between a ray and the way to its end, above which it isn't its end: perspective bends nothing, distortion little.
const MAX_BEND_RAD: f64 = 0.3;

/// How many nearer saddles may lie beside an edge, on the way to its end.
const MAX_TRIED: usize = 6;

/// Links each ray to the nearest saddle that has a ray back, the same sides and an edge all along, where both choose each other.
pub(super) fn link(image: &FloatImage, saddles: &[Saddle]) -> Links {
    let chosen: Links = (0..saddles.len()).into_par_iter().map(|from| ends(image, saddles, from)).collect();
    let mutual = |from: usize, ray: usize| {
        chosen[from][ray].filter(|&(to, back)| chosen[to][back] == Some((from, ray)))
    };
    (0..saddles.len()).map(|from| std::array::from_fn(|ray| mutual(from, ray))).collect()
}

fn ends(image: &FloatImage, saddles: &[Saddle], from: usize) -> [Option<(usize, usize)>; 4] {
    let a = &saddles[from];
    let mut candidates: [Vec<(f64, usize, usize)>; 4] = Default::default();
    for (to, b) in saddles.iter().enumerate() {
        let way = b.xy_px - a.xy_px;
        let distance_px = way.norm();
        if to == from || distance_px < 3.0 {
            continue;
        }
        let angle = way.y.atan2(way.x);
        let Some(ray) = ray_along(a, angle) else { continue };
        let Some(back) = ray_along(b, angle + PI) else { continue };
        if a.is_bright(ray) != b.is_bright((back + 3) % 4) {
            continue;
        }
        let contrast = a.contrast.min(b.contrast);
        if contrast < 0.2 * a.contrast.max(b.contrast) {
            continue;
        }
        candidates[ray].push((distance_px, to, back));
    }
    let mut ray = 0;
    candidates.map(|mut nearest| {
        let bright = a.is_bright(ray);
        ray += 1;
        nearest.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
        let mut tried = nearest.into_iter().take(MAX_TRIED);
        tried.find(|&(_, to, _)| is_edge(image, a, &saddles[to], bright)).map(|(_, to, back)| (to, back))
    })
}

fn ray_along(saddle: &Saddle, angle_rad: f64) -> Option<usize> {
    let off = |ray: f64| ((angle_rad - ray + PI).rem_euclid(TAU) - PI).abs();
    (0..4).find(|&k| off(saddle.rays_rad[k]) < MAX_BEND_RAD)
}

/// Whether one side of the way is brighter than the other all along; `bright` is the side towards which angles grow.
fn is_edge(image: &FloatImage, a: &Saddle, b: &Saddle, bright: bool) -> bool {
    let way = b.xy_px - a.xy_px;
    let length_px = way.norm();
    let across = Vector2::new(-way.y, way.x) / length_px * (0.15 * length_px).clamp(1.5, 5.0);
    let least = 0.25 * a.contrast.min(b.contrast);
    [0.2, 0.35, 0.5, 0.65, 0.8].iter().all(|&t| {
        let at = a.xy_px + way * t;
        let difference = image.sample(&(at + across)) - image.sample(&(at - across));
        (if bright { difference } else { -difference }) > least
    })
}
