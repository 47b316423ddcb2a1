//! Large least squares: bundle adjustment, rotation and position averaging, Sim(3) graphs.
//!
//! Arrays in, arrays out: this crate knows no images, files or network. Everything is a pure function of its inputs and
//! gives the same bytes for any number of threads: work is cut into fixed parts and sums are folded in index order.

pub mod bundle;
mod graph;
pub mod linear;
mod loss;
pub mod position_averaging;
pub mod rotation_averaging;
pub mod sim3_graph;

pub use loss::Loss;
