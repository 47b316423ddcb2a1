//! Large least squares: bundle adjustment, rotation and position averaging, Sim(3) graphs.
//!
//! Arrays in, arrays out: this crate knows no images, files or network. Everything is a pure function of its inputs and
//! gives the same bytes for any number of threads: work is cut into fixed parts and sums are folded in index order.

pub mod bundle;
pub mod linear;
mod loss;

pub use loss::Loss;
