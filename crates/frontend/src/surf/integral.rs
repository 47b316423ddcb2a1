//! Sums over boxes of pixels, each from four look-ups (Crow 1984; Viola & Jones 2001).
//!
//! Sums wrap around at 2³²: differences of them are right for every box of less than 2²⁴ pixels.

use crate::image::GrayImage;

/// Sums of all pixels above and to the left of each pixel's corner.
pub(super) struct Integral {
    pub width: usize,
    pub height: usize,
    /// `width + 1` sums a row, `height + 1` rows; the first of each is zero.
    pub sums: Vec<u32>,
}

impl Integral {
    pub(super) fn new(image: &GrayImage) -> Self {
        let (width, height) = (image.width, image.height);
        let stride = width + 1;
        let mut sums = vec![0_u32; stride * (height + 1)];
        for (y, pixels) in image.data.chunks_exact(width.max(1)).enumerate() {
            let (above, below) = sums.split_at_mut((y + 1) * stride);
            let above = &above[y * stride..];
            let mut sum = 0_u32;
            for ((out, &over), &pixel) in below[1..].iter_mut().zip(&above[1..]).zip(pixels) {
                sum = sum.wrapping_add(u32::from(pixel));
                *out = over.wrapping_add(sum);
            }
        }
        Self { width, height, sums }
    }

    /// Sums from one row to the next.
    pub(super) fn stride(&self) -> usize {
        self.width + 1
    }

    /// The sum over columns `x0..x1` and rows `y0..y1`, of which only those inside the image count.
    #[inline]
    pub(super) fn sum(&self, (x0, x1): (i32, i32), (y0, y1): (i32, i32)) -> i32 {
        let column = |x: i32| x.clamp(0, self.width as i32) as usize;
        let row = |y: i32| y.clamp(0, self.height as i32) as usize * self.stride();
        let (x0, x1, y0, y1) = (column(x0), column(x1), row(y0), row(y1));
        let at = |k: usize| self.sums[k];
        let sum = at(y1 + x1).wrapping_sub(at(y1 + x0)).wrapping_sub(at(y0 + x1)).wrapping_add(at(y0 + x0));
        sum as i32
    }

    /// Haar wavelets (Bay et al. 2008) of `2 * half` pixels a side around the corner between pixels: right less left,
    /// and lower less upper.
    #[inline]
    pub(super) fn haar(&self, (x, y): (i32, i32), half: i32) -> (f32, f32) {
        let (left, right) = (x - half, x + half);
        let (top, bottom) = (y - half, y + half);
        let quarters = [
            self.sum((left, x), (top, y)),
            self.sum((x, right), (top, y)),
            self.sum((left, x), (y, bottom)),
            self.sum((x, right), (y, bottom)),
        ];
        let dx = quarters[1] + quarters[3] - quarters[0] - quarters[2];
        let dy = quarters[2] + quarters[3] - quarters[0] - quarters[1];
        (dx as f32, dy as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_add_up_inside_and_at_the_edges() {
        let (width, height) = (23, 17);
        let data: Vec<u8> = (0..width * height).map(|at| ((at * 97) % 256) as u8).collect();
        let image = GrayImage { width, height, data };
        let integral = Integral::new(&image);
        for (x0, x1, y0, y1) in [(0, 23, 0, 17), (3, 9, 2, 16), (5, 6, 5, 6), (-4, 3, 10, 90), (7, 7, 1, 5)] {
            let inside = |at: usize| {
                let (x, y) = ((at % width) as i32, (at / width) as i32);
                (x0..x1).contains(&x) && (y0..y1).contains(&y)
            };
            let truth: i32 =
                image.data.iter().enumerate().filter(|(at, _)| inside(*at)).map(|(_, v)| i32::from(*v)).sum();
            assert_eq!(integral.sum((x0, x1), (y0, y1)), truth);
        }
        let (dx, dy) = integral.haar((10, 8), 3);
        let right = integral.sum((10, 13), (5, 11)) - integral.sum((7, 10), (5, 11));
        let lower = integral.sum((7, 13), (8, 11)) - integral.sum((7, 13), (5, 8));
        assert_eq!((dx, dy), (right as f32, lower as f32));
    }

    #[test]
    fn sums_beyond_32_bits_wrap_and_boxes_stay_right() {
        // Sums that wrap are as good as any: start them near the end.
        let image = GrayImage { width: 40, height: 40, data: vec![255; 1600] };
        let mut integral = Integral::new(&image);
        integral.sums.iter_mut().for_each(|sum| *sum = sum.wrapping_add(u32::MAX - 1000));
        assert_eq!(integral.sum((2, 30), (5, 39)), 28 * 34 * 255);
    }
}
