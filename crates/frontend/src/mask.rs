//! Parts of a photograph that features must keep out of: moving things, sky, water, the edge of a fisheye.

use crate::FrontendError;
use crate::image::GrayImage;

/// How far, as a share, the aspect of a mask may be from that of its photograph: a mask of an eighth of the size is rounded
/// to whole pixels.
const ASPECT_TOLERANCE: f64 = 0.02;

/// A mask: black (0) keeps features out, everything else lets them be, as in COLMAP.
///
/// A mask of another size than its photograph is looked up at the nearest pixel, as long as it has the same shape: masks
/// often come from networks that work on smaller images.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mask {
    image: GrayImage,
    width_px: usize,
    height_px: usize,
}

impl Mask {
    /// The mask of a photograph of a size.
    ///
    /// # Errors
    /// When the shapes differ: the mask is of another photograph, or turned.
    pub fn new(image: GrayImage, width_px: usize, height_px: usize) -> Result<Self, FrontendError> {
        let (width, height) = (image.width, image.height);
        let products = (width as f64 * height_px as f64, height as f64 * width_px as f64);
        let is_alike = (products.0 - products.1).abs() <= ASPECT_TOLERANCE * products.0.max(products.1);
        if image.data.is_empty() || image.data.len() != width * height || !is_alike {
            return Err(FrontendError::unsupported(format!(
                "the mask has {width} x {height} pixels and its photograph {width_px} x {height_px}, another shape: \
                 make it of the photograph as it is stored, not as it is shown"
            )));
        }
        Ok(Self { image, width_px, height_px })
    }

    /// Whether a feature may lie at a place in pixels of the photograph, whose first pixel has its centre at 0.5.
    pub fn keeps(&self, x_px: f32, y_px: f32) -> bool {
        let pixel = |at: f32, masked: usize, of: usize| {
            ((f64::from(at) * masked as f64 / of as f64).max(0.0) as usize).min(masked - 1)
        };
        let column = pixel(x_px, self.image.width, self.width_px);
        let row = pixel(y_px, self.image.height, self.height_px);
        self.image.data[row * self.image.width + column] != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sift::{self, SiftOptions};

    fn gray(width: usize, height: usize, value: impl Fn(usize, usize) -> u8) -> GrayImage {
        let data =
            (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| value(x, y)).collect();
        GrayImage { width, height, data }
    }

    /// Blobs of many sizes on grey.
    fn blobs(width: usize, height: usize) -> GrayImage {
        let mut sum = vec![128.0_f64; width * height];
        let mut state = 7_u64;
        let mut draw = |below: usize| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as usize % below
        };
        for _ in 0..width * height / 150 {
            let (x, y, sigma) = (draw(width) as f64, draw(height) as f64, 1.5 + draw(30) as f64 / 10.0);
            let height_of_blob = if draw(2) == 0 { 60.0 } else { -60.0 };
            for row in 0..height {
                for column in 0..width {
                    let distance = (column as f64 - x).powi(2) + (row as f64 - y).powi(2);
                    if distance < 16.0 * sigma * sigma {
                        sum[row * width + column] +=
                            height_of_blob * (-distance / (2.0 * sigma * sigma)).exp();
                    }
                }
            }
        }
        gray(width, height, |x, y| sum[y * width + x].clamp(0.0, 255.0) as u8)
    }

    #[test]
    fn no_keypoint_lies_in_the_dark_and_the_budget_is_spent_elsewhere() {
        let photograph = blobs(320, 240);
        let options = SiftOptions { max_features: 150, ..Default::default() };
        let without = sift::extract(&photograph, None, &options);
        assert!(without.len() > 140, "{}", without.len());
        // The left half, at full size and at a quarter of it.
        for scale in [1, 4] {
            let dark = gray(320 / scale, 240 / scale, |x, _| if x * scale < 160 { 0 } else { 1 });
            let mask = Mask::new(dark, 320, 240).unwrap();
            let with = sift::extract_masked(&photograph, None, Some(&mask), &options);
            assert!(with.keypoints.iter().all(|k| k.x_px >= 160.0), "scale {scale}");
            assert!(with.len() > 130, "{} of {}", with.len(), without.len());
            let kept = without.keypoints.iter().filter(|k| k.x_px >= 160.0);
            let both = kept.clone().filter(|k| with.keypoints.contains(k)).count();
            assert!(both * 10 >= kept.count() * 9, "{both}");
        }
        let light = Mask::new(gray(320, 240, |_, _| 255), 320, 240).unwrap();
        assert_eq!(sift::extract_masked(&photograph, None, Some(&light), &options), without);
        let dark = Mask::new(gray(320, 240, |_, _| 0), 320, 240).unwrap();
        assert!(sift::extract_masked(&photograph, None, Some(&dark), &options).is_empty());
    }

    #[test]
    fn masks_of_another_shape_are_refused() {
        assert!(Mask::new(gray(100, 75, |_, _| 1), 4000, 3000).is_ok());
        assert!(Mask::new(gray(250, 141, |_, _| 1), 2000, 1125).is_ok());
        for (width, height) in [(75, 100), (100, 100), (0, 0), (1, 0)] {
            assert!(Mask::new(gray(width, height, |_, _| 1), 4000, 3000).is_err(), "{width} x {height}");
        }
        let short = GrayImage { width: 4, height: 3, data: vec![1; 11] };
        assert!(Mask::new(short, 4, 3).is_err());
    }

    #[test]
    fn places_beyond_the_edge_count_as_at_it() {
        let mask = Mask::new(gray(4, 4, |x, _| if x == 3 { 0 } else { 9 }), 8, 8).unwrap();
        assert!(mask.keeps(-3.0, 2.0) && mask.keeps(5.99, 100.0) && mask.keeps(f32::NAN, 0.0));
        assert!(!mask.keeps(6.0, 2.0) && !mask.keeps(1e9, 2.0) && !mask.keeps(f32::INFINITY, -1.0));
    }
}
