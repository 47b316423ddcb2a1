//! Submaps in, one geo-referenced reconstruction out.
