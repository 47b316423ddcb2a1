//! Decoding of whole and of broken files.
