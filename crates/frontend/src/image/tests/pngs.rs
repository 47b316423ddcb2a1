//! PNG of every depth and colour.

use ::png::{BitDepth, ColorType};

use super::*;

fn wide(data: &[u8]) -> Vec<u8> {
    data.iter().flat_map(|v| [*v, 77]).collect()
}

#[test]
fn png_of_every_kind_is_decoded_exactly() {
    let with_alpha: Vec<u8> = picture().chunks(3).flat_map(|p| [p[0], p[1], p[2], 9]).collect();
    let gray_alpha: Vec<u8> = grays().into_iter().flat_map(|v| [v, 9]).collect();
    let indices: Vec<u8> = (0..SIZE.0 * SIZE.1).map(|k| (k % 200) as u8).collect();
    let palette: Vec<u8> = (0..200).flat_map(|k| [k, 255 - k, 7]).collect();
    let looked_up: Vec<u8> = indices.iter().flat_map(|k| [*k, 255 - *k, 7]).collect();
    for (bytes, wanted) in [
        (png(&picture(), ColorType::Rgb, BitDepth::Eight, None), Some(picture())),
        (png(&wide(&picture()), ColorType::Rgb, BitDepth::Sixteen, None), Some(picture())),
        (png(&with_alpha, ColorType::Rgba, BitDepth::Eight, None), Some(picture())),
        (png(&indices, ColorType::Indexed, BitDepth::Eight, Some(palette)), Some(looked_up)),
        (png(&grays(), ColorType::Grayscale, BitDepth::Eight, None), None),
        (png(&wide(&grays()), ColorType::Grayscale, BitDepth::Sixteen, None), None),
        (png(&gray_alpha, ColorType::GrayscaleAlpha, BitDepth::Eight, None), None),
    ] {
        let image = open(&bytes);
        match wanted {
            Some(rgb) => {
                let luma: Vec<u8> = rgb.chunks(3).map(luma_of).collect();
                assert_near(&image.luma.data, &luma, 0.51);
                assert_near(&image.rgb.unwrap().data, &halved(&rgb), 0.51);
            }
            None => assert_eq!((image.luma.data, image.rgb), (grays(), None)),
        }
    }
}

#[test]
fn few_bits_are_spread_over_the_range() {
    for (depth, bits) in [(BitDepth::One, 1), (BitDepth::Two, 2), (BitDepth::Four, 4)] {
        let row_bytes = (SIZE.0 * bits).div_ceil(8);
        let data: Vec<u8> = (0..row_bytes * SIZE.1).map(|k| (k * 37 + 11) as u8).collect();
        let image = open(&png(&data, ColorType::Grayscale, depth, None));
        let max = (1_usize << bits) - 1;
        for y in 0..SIZE.1 {
            for x in 0..SIZE.0 {
                let byte = usize::from(data[y * row_bytes + x * bits / 8]);
                let value = byte >> (8 - bits - x * bits % 8) & max;
                assert_eq!(usize::from(image.luma.data[y * SIZE.0 + x]), value * 255 / max);
            }
        }
    }
}

#[test]
fn interlaced_images_are_decoded() {
    let bytes = terrane_testkit::files::interlaced_png(SIZE.0, SIZE.1, &grays());
    assert_eq!(open(&bytes).luma.data, grays());
}

#[test]
fn narrow_ranges_of_16_bits_keep_their_contrast() {
    let (width, height) = SIZE;
    // Twelve bits in sixteen, and a thermal frame around 300 K in hundredths.
    for (offset, step) in [(0, 100), (29_000, 3)] {
        let values: Vec<u16> = (0..width * height).map(|k| offset + step * (k % width) as u16).collect();
        let data: Vec<u8> = values.iter().flat_map(|v| v.to_be_bytes()).collect();
        let luma = open(&png(&data, ColorType::Grayscale, BitDepth::Sixteen, None)).luma.data;
        let row = &luma[..width];
        // Never more than a level a unit.
        let last = if step == 3 { 105..=120 } else { 235..=245 };
        assert!(row[0] <= 20 && last.contains(&row[width - 1]), "{row:?}");
        assert!(row.windows(2).all(|pair| pair[1] > pair[0]), "{row:?}");
    }
    // A constant image stays calm.
    let flat: Vec<u8> = (0..width * height).flat_map(|_| 700_u16.to_be_bytes()).collect();
    let luma = open(&png(&flat, ColorType::Grayscale, BitDepth::Sixteen, None)).luma.data;
    assert!(luma.iter().all(|v| *v == luma[0]));
}
