//! Synthetic scenes with known truth, for tests, benches and the demo.
//!
//! Three levels, each a product with its own options: view graphs and features (see [`scene`]), rendered photographs,
//! and the comparison of a result with the truth (see [`compare`]). Real photographs under known maps: [`homographies`].
//!
//! For readers of files: image files of every kind (see [`files`]), mutations of them (see [`mutate`]), and an allocator
//! that counts (see [`allocation`]).

pub mod allocation;
pub mod compare;
pub mod files;
pub mod homographies;
pub mod mutate;
pub mod scene;
pub mod targets;
pub mod town;
