//! AprilGrids (Furgale, Rehder & Siegwart 2013): tags of the family 36h11 with black squares at their corners.
//!
//! The squares make every corner of a tag a saddle. Four edges around dark that close are a tag's outline; its bits are read through
//! their homography. Each tag counts alone, so that a part of the grid is enough.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Vector2};
use terrane_geometry::homography::homography_from_four;

use super::gray::FloatImage;
use super::links::{Links, link};
use super::saddles::{Level, Saddle, refined};
use super::{NotFound, TargetView, scale_of, tag36h11};
use crate::FrontendError;

/// A grid of tags. Its frame, as Kalibr's: x to the right, y up, the origin at the lower left corner of tag 0; numbers grow along
/// x, then along y.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AprilGrid {
    /// Tags along x.
    pub columns: usize,
    /// Tags along y.
    pub rows: usize,
    /// Side of a tag's black outline, metres.
    pub tag_m: f64,
    /// Gap between tags, in parts of their side.
    pub spacing: f64,
}

impl AprilGrid {
    /// A grid.
    ///
    /// # Errors
    /// No tags, more than the family has, or lengths that aren't above 0.
    pub fn new(columns: usize, rows: usize, tag_m: f64, spacing: f64) -> Result<Self, FrontendError> {
        let count = columns.saturating_mul(rows);
        if count == 0 || count > tag36h11::CODES.len() || !(tag_m > 0.0) || !(spacing > 0.0) {
            return Err(FrontendError::invalid_option(format!(
                "an AprilGrid has 1 to {} tags, with a side and a spacing above 0",
                tag36h11::CODES.len()
            )));
        }
        Ok(Self { columns, rows, tag_m, spacing })
    }

    /// Corners of a tag as it is printed: upper left, upper right, lower right, lower left; metres.
    pub fn corners_m(&self, id: usize) -> [Vector2<f64>; 4] {
        let pitch_m = self.tag_m * (1.0 + self.spacing);
        let lower_left = Vector2::new((id % self.columns) as f64, (id / self.columns) as f64) * pitch_m;
        [(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)]
            .map(|(x, y)| lower_left + Vector2::new(x, y) * self.tag_m)
    }
}

/// Corners of tags by number; `None` where a number is seen twice.
type Tags = BTreeMap<usize, Option<[Vector2<f64>; 4]>>;

/// See [`super::detect`]; `levels` are the picture, then halved again and again.
pub(super) fn detect(grid: &AprilGrid, levels: &[FloatImage]) -> Result<TargetView, NotFound> {
    let mut tags = Tags::new();
    for (index, image) in levels.iter().enumerate() {
        let level = Level::new(image);
        let saddles = level.saddles();
        let links = link(&level.fine, &saddles);
        // A finer level has the say.
        for (id, corners) in read_all(&level.fine, &saddles, &links) {
            let scaled = corners.map(|corners| corners.map(|corner| corner * scale_of(index)));
            tags.entry(id).or_insert(scaled);
        }
        if tags.len() >= grid.columns * grid.rows {
            break;
        }
    }
    let smooth = levels.first().map(FloatImage::smoothed).ok_or(NotFound::Nothing)?;
    let others = tags.keys().any(|&id| id >= grid.columns * grid.rows);
    let mut view = TargetView::default();
    for (&id, corners) in tags.range(..grid.columns * grid.rows) {
        let Some(corners) = corners else { continue };
        let side_px = (0..4).map(|k| (corners[(k + 1) % 4] - corners[k]).norm()).fold(f64::MAX, f64::min);
        // Within the black border, which is an eighth of the side at least, and the small squares.
        let radius_px = (0.9 * side_px * grid.spacing.min(0.125)).clamp(2.5, 8.0);
        for (xy_m, corner) in grid.corners_m(id).iter().zip(corners) {
            if let Some(xy_px) = refined(&smooth, corner, radius_px) {
                view.xy_on_target_m.push(*xy_m);
                view.xy_px.push(xy_px);
            }
        }
    }
    match (view.xy_px.is_empty(), others) {
        (false, _) => Ok(view),
        (true, true) => Err(NotFound::OtherTags),
        (true, false) => Err(NotFound::Nothing),
    }
}

fn read_all(image: &FloatImage, saddles: &[Saddle], links: &Links) -> Tags {
    let mut tags = Tags::new();
    for from in 0..saddles.len() {
        for ray in 0..4 {
            let Some(ring) = ring(saddles, links, from, ray) else { continue };
            let corners = ring.map(|saddle| saddles[saddle].xy_px);
            if let Some((id, corners)) = read(image, &corners) {
                tags.entry(id).and_modify(|seen| *seen = None).or_insert(Some(corners));
            }
        }
    }
    tags
}

/// Four saddles around a dark field, which lies on the side towards which the angles of `ray` grow; only from its first saddle.
fn ring(saddles: &[Saddle], links: &Links, from: usize, ray: usize) -> Option<[usize; 4]> {
    if saddles[from].is_bright(ray) {
        return None;
    }
    let (mut at, mut along) = (from, ray);
    let mut ring = [0; 4];
    for place in &mut ring {
        *place = at;
        let (next, back) = links[at][along]?;
        (at, along) = (next, (back + 3) % 4);
    }
    let first = ring.iter().min().is_some_and(|&least| least == from);
    (first && (at, along) == (from, ray)).then_some(ring)
}

/// The number of the tag within four corners, and its corners as printed, from the upper left clockwise.
fn read(image: &FloatImage, corners: &[Vector2<f64>; 4]) -> Option<(usize, [Vector2<f64>; 4])> {
    let middle = corners.iter().sum::<Vector2<f64>>() / 4.0;
    let size_px = (corners[2] - corners[0]).norm().max(1.0);
    let unit = corners.map(|corner| (corner - middle) / size_px);
    let square = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(x, y)| Vector2::new(x, y));
    let to_unit = homography_from_four(&square, &unit)?;
    let sample = |at: Vector2<f64>| image.sample(&(mapped(&to_unit, &at) * size_px + middle));
    // Kalibr prints borders of two bits, AprilRobotics of one.
    for border in [2usize, 1] {
        let cells = 6 + 2 * border;
        let value = |column: usize, row: usize| {
            let at = |part: f64, k: usize| (k as f64 + part) / cells as f64;
            let parts = [(0.5, 0.5), (0.3, 0.3), (0.7, 0.3), (0.3, 0.7), (0.7, 0.7)];
            let sum: f64 = parts.iter().map(|p| sample(Vector2::new(at(p.0, column), at(p.1, row)))).sum();
            sum / parts.len() as f64
        };
        let outside = 0.05;
        let white: f64 = [(0.5, -outside), (1.0 + outside, 0.5), (0.5, 1.0 + outside), (-outside, 0.5)]
            .iter()
            .map(|&(x, y)| sample(Vector2::new(x, y)))
            .sum::<f64>()
            / 4.0;
        let is_border = |i: usize| !(border..6 + border).contains(&i);
        let cell = |i: usize| (i % cells, i / cells);
        let dark: Vec<f64> = (0..cells * cells)
            .map(cell)
            .filter(|&(column, row)| is_border(column) || is_border(row))
            .map(|(column, row)| value(column, row))
            .collect();
        let black = dark.iter().sum::<f64>() / dark.len() as f64;
        let threshold = 0.5 * (white + black);
        if !(white - black > 10.0) || dark.iter().any(|&value| value > threshold) {
            continue;
        }
        let bits = (0..36)
            .fold(0u64, |bits, i| bits << 1 | u64::from(value(border + i % 6, border + i / 6) > threshold));
        if let Some((id, turns)) = tag36h11::identify(bits) {
            // Turned clockwise, the last corner comes first.
            return Some((id, std::array::from_fn(|k| corners[(k + 4 - turns) % 4])));
        }
    }
    None
}

fn mapped(h: &Matrix3<f64>, at: &Vector2<f64>) -> Vector2<f64> {
    let mapped = h * at.push(1.0);
    mapped.xy() / mapped.z
}
