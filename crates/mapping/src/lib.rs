//! One cluster of matched images in, submaps out.
