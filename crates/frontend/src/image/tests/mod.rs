//! Decoding of whole and of broken files.

mod foreign;
mod jpegs;
mod pngs;
mod tiffs;

use jpeg_encoder::{ColorType as JpegColor, Encoder};

use super::*;

const SIZE: (usize, usize) = (37, 21);

/// A smooth picture in red, green and blue.
fn picture() -> Vec<u8> {
    let (width, height) = SIZE;
    (0..width * height).flat_map(|k| [(k % width * 6) as u8, (k / width * 11) as u8, 128]).collect()
}

/// BT.601 luma, from its definition.
fn luma_of(rgb: &[u8]) -> u8 {
    (0.299 * f64::from(rgb[0]) + 0.587 * f64::from(rgb[1]) + 0.114 * f64::from(rgb[2])).round() as u8
}

fn grays() -> Vec<u8> {
    picture().chunks(3).map(luma_of).collect()
}

/// Colours as an image keeps them: means of up to 2 x 2 pixels.
fn halved(rgb: &[u8]) -> Vec<u8> {
    let (width, height) = SIZE;
    let mut out = Vec::new();
    for y in (0..height).step_by(2) {
        for x in (0..width).step_by(2) {
            for channel in 0..3 {
                let cell = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)];
                let inside = cell.into_iter().filter(|(x, y)| *x < width && *y < height);
                let values: Vec<f64> =
                    inside.map(|(x, y)| f64::from(rgb[3 * (y * width + x) + channel])).collect();
                out.push((values.iter().sum::<f64>() / values.len() as f64 + 0.5) as u8);
            }
        }
    }
    out
}

fn jpeg(data: &[u8], color: JpegColor, set: impl FnOnce(&mut Encoder<&mut Vec<u8>>)) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, 95);
    set(&mut encoder);
    encoder.encode(data, SIZE.0 as u16, SIZE.1 as u16, color).unwrap();
    bytes
}

fn png(data: &[u8], color: ::png::ColorType, depth: ::png::BitDepth, palette: Option<Vec<u8>>) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = ::png::Encoder::new(&mut bytes, SIZE.0 as u32, SIZE.1 as u32);
    encoder.set_color(color);
    encoder.set_depth(depth);
    if let Some(palette) = palette {
        encoder.set_palette(palette);
    }
    encoder.write_header().unwrap().write_image_data(data).unwrap();
    bytes
}

fn open(bytes: &[u8]) -> DecodedImage {
    let image = decode(bytes, &DecodeOptions::default()).unwrap();
    assert_eq!((image.luma.width, image.luma.height), SIZE);
    image
}

fn error_of(bytes: &[u8]) -> FrontendError {
    decode(bytes, &DecodeOptions::default()).unwrap_err()
}

fn assert_near(found: &[u8], wanted: &[u8], bound: f64) {
    assert_eq!(found.len(), wanted.len());
    let sum: f64 = found.iter().zip(wanted).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
    assert!(sum <= bound * found.len() as f64, "mean difference {}", sum / found.len() as f64);
}

#[test]
fn colors_are_looked_up_in_cells() {
    let image = open(&png(&picture(), ::png::ColorType::Rgb, ::png::BitDepth::Eight, None));
    let rgb = image.rgb.unwrap();
    assert_eq!((rgb.width, rgb.height), (19, 11));
    assert_eq!(rgb.at_pixel(0, 0, SIZE), Some([3, 6, 128]));
    assert_eq!(rgb.at_pixel(1, 1, SIZE), rgb.at_pixel(0, 0, SIZE));
    assert_eq!(rgb.at_pixel(36, 20, SIZE), Some([36 * 6, 20 * 11, 128]));
    assert_eq!((rgb.at_pixel(38, 0, SIZE), rgb.at_pixel(0, 22, SIZE)), (None, None));
    // A column one pixel wide is still halved in height.
    let narrow = RgbImage { width: 1, height: 2, data: vec![1, 2, 3, 4, 5, 6] };
    assert_eq!(
        (narrow.at_pixel(0, 1, (1, 3)), narrow.at_pixel(0, 2, (1, 3))),
        (Some([1, 2, 3]), Some([4, 5, 6]))
    );
    // An image that is not reduced is its own grid.
    let whole = RgbImage { width: 2, height: 1, data: vec![1, 2, 3, 4, 5, 6] };
    assert_eq!((whole.at_pixel(1, 0, (2, 1)), whole.at_pixel(0, 1, (2, 1))), (Some([4, 5, 6]), None));
}

#[test]
fn luma_alone_is_that_of_the_whole_image() {
    let gray = DecodeOptions { color: false, ..DecodeOptions::default() };
    for bytes in [
        jpeg(&picture(), JpegColor::Rgb, |e| e.set_sampling_factor(jpeg_encoder::SamplingFactor::F_2_2)),
        png(&picture(), ::png::ColorType::Rgb, ::png::BitDepth::Eight, None),
    ] {
        let image = decode(&bytes, &gray).unwrap();
        assert_eq!((&image.luma, image.rgb), (&open(&bytes).luma, None));
    }
}

#[test]
fn truncated_files_are_errors_wherever_they_end() {
    let files = [
        jpeg(&picture(), JpegColor::Rgb, |_| {}),
        jpeg(&picture(), JpegColor::Rgb, |e| e.set_progressive(true)),
        png(&picture(), ::png::ColorType::Rgb, ::png::BitDepth::Eight, None),
    ];
    for bytes in &files {
        for len in 1..bytes.len() {
            let error = error_of(&bytes[..len]);
            assert!(len < 8 || error.is_corrupt(), "{len} of {}: {error}", bytes.len());
            assert!(probe(&bytes[..len]).is_err());
        }
    }
}

#[test]
fn headers_that_promise_more_than_the_file_can_hold_are_refused() {
    let mut forged = jpeg(&grays(), JpegColor::Luma, |_| {});
    let frame = forged.windows(2).position(|pair| pair == [0xff, 0xc0]).unwrap();
    forged[frame + 5..frame + 9].copy_from_slice(&[0x3f, 0xff, 0x3f, 0xff]);
    let mut forged_png = png(&grays(), ::png::ColorType::Grayscale, ::png::BitDepth::Eight, None);
    forged_png[16..24].copy_from_slice(&[0, 0, 0x3f, 0xff, 0, 0, 0x3f, 0xff]);
    for bytes in [forged, forged_png] {
        let error = error_of(&bytes);
        assert!(error.is_corrupt() && error.to_string().contains("can't hold"), "{error}");
    }
}

#[test]
fn tiny_images_are_images_and_huge_ones_are_refused() {
    let mut bytes = Vec::new();
    Encoder::new(&mut bytes, 90).encode(&[200], 1, 1, JpegColor::Luma).unwrap();
    let image = decode(&bytes, &DecodeOptions::default()).unwrap();
    assert_eq!((image.luma.width, image.luma.height, image.luma.data.len()), (1, 1, 1));
    let options = DecodeOptions { max_pixels: 100, ..DecodeOptions::default() };
    let error = decode(&jpeg(&picture(), JpegColor::Rgb, |_| {}), &options).unwrap_err();
    assert!(error.is_unsupported() && error.to_string().contains("max_pixels"));
}
