//! Synthetic scenes with known truth: view graphs, features, rendered photographs; comparison.
