//! Features of images with known answers.
