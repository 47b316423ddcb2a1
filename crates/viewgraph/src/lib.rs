//! The graph of verified pairs: build, filter, measure and partition with overlap.
