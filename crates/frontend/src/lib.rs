//! Photographs in; features, retrieval, pair selection, matching and verification out.
