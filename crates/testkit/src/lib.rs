//! Synthetic scenes with known truth, for tests, benches and the demo.
//!
//! Three levels, each a product with its own options: view graphs and features (see [`scene`]), rendered photographs,
//! and the comparison of a result with the truth (see [`compare`]). Real photographs under known maps: [`homographies`].

pub mod compare;
pub mod homographies;
pub mod scene;
pub mod town;
