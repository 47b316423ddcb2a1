//! Planar calibration targets: corners of checkerboards and AprilGrids, found in grey pictures.
//!
//! Both are read from one kind of corner, where two dark and two bright sectors meet (see `saddles`), and from the edges that
//! join them (see `links`). A checkerboard is a lattice of such edges, a tag a ring of four around dark.

mod aprilgrid;
mod checkerboard;
mod gray;
mod links;
mod saddles;
pub mod tag36h11;
#[cfg(test)]
mod tests;

use std::fmt;
use std::str::FromStr;

use nalgebra::Vector2;

use crate::FrontendError;
use crate::image::GrayImage;
pub use aprilgrid::AprilGrid;
pub use checkerboard::Checkerboard;
use gray::FloatImage;

/// A planar target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Target {
    /// Squares in two colours.
    Checkerboard(Checkerboard),
    /// Tags with small squares at their corners, as Kalibr prints them.
    AprilGrid(AprilGrid),
}

/// Points of a target, and where a picture shows them: in the same order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TargetView {
    /// Points on the target's plane, metres.
    pub xy_on_target_m: Vec<Vector2<f64>>,
    /// Their pixels.
    pub xy_px: Vec<Vector2<f64>>,
}

/// Why a picture shows no target that can be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NotFound {
    /// Nothing like it is there.
    #[error("no target is seen")]
    Nothing,
    /// Some of the board is there.
    #[error(
        "a board of {columns} x {rows} inner corners is seen, not one of {wanted_columns} x {wanted_rows}: show all of it"
    )]
    OtherBoard {
        /// Columns that are seen.
        columns: usize,
        /// Rows that are seen.
        rows: usize,
        /// Columns of the target.
        wanted_columns: usize,
        /// Rows of the target.
        wanted_rows: usize,
    },
    /// The board's outline is there, and too little within it.
    #[error("{seen} of {wanted} corners are seen: uncover the board, and avoid glare")]
    Covered {
        /// Corners that are seen.
        seen: usize,
        /// Corners of the target.
        wanted: usize,
    },
    /// Tags are there, but none of the grid's.
    #[error("tags are seen, but none with a number of this grid: check its columns and rows")]
    OtherTags,
}

/// The target's corners in a picture.
///
/// Looks at the picture in several resolutions, coarse ones first, and places corners in the finest.
///
/// # Errors
/// The reason, when the target isn't there or can't be used.
pub fn detect(target: &Target, image: &GrayImage) -> Result<TargetView, NotFound> {
    const LARGEST_COARSE_SIDE_PX: usize = 240;
    if image.width.saturating_mul(image.height) != image.data.len() {
        return Err(NotFound::Nothing);
    }
    let mut levels = vec![FloatImage::new(image)];
    while let Some(last) = levels.last()
        && last.width.max(last.height) > LARGEST_COARSE_SIDE_PX
        && let Some(half) = last.halved()
    {
        levels.push(half);
    }
    match target {
        Target::Checkerboard(board) => checkerboard::detect(board, &levels),
        Target::AprilGrid(grid) => aprilgrid::detect(grid, &levels),
    }
}

impl FromStr for Target {
    type Err = FrontendError;

    fn from_str(text: &str) -> Result<Self, FrontendError> {
        let wrong = || {
            FrontendError::invalid_option(format!(
                "target `{text}` is not of the form checkerboard:COLUMNSxROWS[:SQUARE_M], counting inner corners, or \
                 aprilgrid:COLUMNSxROWS[:TAG_M:SPACING], SPACING being the gap between tags in parts of TAG_M"
            ))
        };
        let parts: Vec<&str> = text.split(':').collect();
        let (columns, rows) = parts.get(1).and_then(|size| size.split_once('x')).ok_or_else(wrong)?;
        let count = |text: &str| text.parse::<usize>().map_err(|_| wrong());
        let length = |text: &str| match text.parse::<f64>() {
            Ok(length) if length > 0.0 && length.is_finite() => Ok(length),
            _ => Err(wrong()),
        };
        let (columns, rows) = (count(columns)?, count(rows)?);
        match parts[..] {
            ["checkerboard", _] => Checkerboard::new(columns, rows, 1.0).map(Self::Checkerboard),
            ["checkerboard", _, square] => {
                Checkerboard::new(columns, rows, length(square)?).map(Self::Checkerboard)
            }
            ["aprilgrid", _] => AprilGrid::new(columns, rows, 1.0, 0.3).map(Self::AprilGrid),
            ["aprilgrid", _, tag, spacing] => {
                AprilGrid::new(columns, rows, length(tag)?, length(spacing)?).map(Self::AprilGrid)
            }
            _ => Err(wrong()),
        }
    }
}

impl fmt::Display for Target {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Checkerboard(b) => write!(f, "checkerboard:{}x{}:{}", b.columns, b.rows, b.square_m),
            Self::AprilGrid(g) => write!(f, "aprilgrid:{}x{}:{}:{}", g.columns, g.rows, g.tag_m, g.spacing),
        }
    }
}

/// Scale from a level of a pyramid to the picture itself.
fn scale_of(level: usize) -> f64 {
    (1u64 << level) as f64
}
