//! Metadata of whole and of broken files.
