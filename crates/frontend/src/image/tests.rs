//! Decoding of whole and of broken files.

use jpeg_encoder::{ColorType as JpegColor, Encoder};

use super::*;

const SIZE: (usize, usize) = (37, 21);

/// A smooth picture in red, green and blue.
fn picture() -> Vec<u8> {
    let (width, height) = SIZE;
    (0..width * height).flat_map(|k| [(k % width * 6) as u8, (k / width * 11) as u8, 128]).collect()
}

fn grays() -> Vec<u8> {
    picture().chunks(3).map(|p| luma_of([p[0], p[1], p[2]])).collect()
}

fn jpeg(data: &[u8], color: JpegColor, progressive: bool) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, 95);
    encoder.set_progressive(progressive);
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

fn tiff<C>(data: &[C::Inner]) -> Vec<u8>
where
    C: ::tiff::encoder::colortype::ColorType,
    [C::Inner]: ::tiff::encoder::TiffValue,
{
    let mut bytes = std::io::Cursor::new(Vec::new());
    let mut encoder = ::tiff::encoder::TiffEncoder::new(&mut bytes).unwrap();
    encoder.write_image::<C>(SIZE.0 as u32, SIZE.1 as u32, data).unwrap();
    bytes.into_inner()
}

fn open(bytes: &[u8]) -> DecodedImage {
    let image = decode(bytes, &DecodeOptions::default()).unwrap();
    assert_eq!((image.luma.width, image.luma.height), SIZE);
    image
}

fn assert_near(found: &[u8], wanted: &[u8], bound: f64) {
    assert_eq!(found.len(), wanted.len());
    let sum: f64 = found.iter().zip(wanted).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
    assert!(sum <= bound * found.len() as f64, "mean difference {}", sum / found.len() as f64);
}

fn doubled_to_16_bits(data: &[u8]) -> Vec<u8> {
    data.iter().flat_map(|v| [*v, 77]).collect()
}

#[test]
fn jpeg_of_every_kind_is_decoded() {
    for progressive in [false, true] {
        let color = open(&jpeg(&picture(), JpegColor::Rgb, progressive));
        assert_near(&color.luma.data, &grays(), 2.0);
        assert_near(&color.rgb.unwrap().data, &picture(), 4.0);
        let gray = open(&jpeg(&grays(), JpegColor::Luma, progressive));
        assert_near(&gray.luma.data, &grays(), 2.0);
        assert_eq!(gray.rgb, None);
    }
    let cmyk: Vec<u8> = picture().chunks(3).flat_map(|p| [255 - p[0], 255 - p[1], 255 - p[2], 0]).collect();
    for kind in [JpegColor::Cmyk, JpegColor::CmykAsYcck] {
        let image = open(&jpeg(&cmyk, kind, false));
        assert_near(&image.rgb.unwrap().data, &picture(), 6.0);
        assert_near(&image.luma.data, &grays(), 4.0);
    }
    let luma_only = DecodeOptions { color: false, ..DecodeOptions::default() };
    let image = decode(&jpeg(&picture(), JpegColor::Rgb, false), &luma_only).unwrap();
    assert_eq!(image.rgb, None);
    assert_eq!(image.luma, open(&jpeg(&picture(), JpegColor::Rgb, false)).luma);
}

#[test]
fn png_of_every_kind_is_decoded_exactly() {
    use ::png::{BitDepth, ColorType};
    let with_alpha: Vec<u8> = picture().chunks(3).flat_map(|p| [p[0], p[1], p[2], 9]).collect();
    let gray_alpha: Vec<u8> = grays().into_iter().flat_map(|v| [v, 9]).collect();
    let indices: Vec<u8> = (0..SIZE.0 * SIZE.1).map(|k| (k % 200) as u8).collect();
    let palette: Vec<u8> = (0..200).flat_map(|k| [k, 255 - k, 7]).collect();
    let looked_up: Vec<u8> = indices.iter().flat_map(|k| [*k, 255 - *k, 7]).collect();
    for (bytes, wanted) in [
        (png(&picture(), ColorType::Rgb, BitDepth::Eight, None), Some(picture())),
        (png(&doubled_to_16_bits(&picture()), ColorType::Rgb, BitDepth::Sixteen, None), Some(picture())),
        (png(&with_alpha, ColorType::Rgba, BitDepth::Eight, None), Some(picture())),
        (png(&indices, ColorType::Indexed, BitDepth::Eight, Some(palette)), Some(looked_up)),
        (png(&grays(), ColorType::Grayscale, BitDepth::Eight, None), None),
        (png(&doubled_to_16_bits(&grays()), ColorType::Grayscale, BitDepth::Sixteen, None), None),
        (png(&gray_alpha, ColorType::GrayscaleAlpha, BitDepth::Eight, None), None),
    ] {
        let image = open(&bytes);
        let luma = match &wanted {
            Some(rgb) => rgb.chunks(3).map(|p| luma_of([p[0], p[1], p[2]])).collect(),
            None => grays(),
        };
        assert_eq!(image.luma.data, luma);
        assert_eq!(image.rgb.map(|rgb| rgb.data), wanted);
    }
}

#[test]
fn tiff_of_8_and_16_bits_is_decoded_exactly() {
    use ::tiff::encoder::colortype::{Gray8, Gray16, RGB8, RGB16, RGBA8};
    let wide = |data: Vec<u8>| data.into_iter().map(|v| u16::from(v) << 8 | 5).collect::<Vec<u16>>();
    let with_alpha: Vec<u8> = picture().chunks(3).flat_map(|p| [p[0], p[1], p[2], 9]).collect();
    for bytes in [tiff::<RGB8>(&picture()), tiff::<RGB16>(&wide(picture())), tiff::<RGBA8>(&with_alpha)] {
        let image = open(&bytes);
        assert_eq!(image.luma.data, grays());
        assert_eq!(image.rgb.unwrap().data, picture());
    }
    for bytes in [tiff::<Gray8>(&grays()), tiff::<Gray16>(&wide(grays()))] {
        assert_eq!(open(&bytes).luma.data, grays());
    }
}

#[test]
fn truncated_files_are_errors_wherever_they_end() {
    let files = [
        jpeg(&picture(), JpegColor::Rgb, false),
        jpeg(&picture(), JpegColor::Rgb, true),
        png(&picture(), ::png::ColorType::Rgb, ::png::BitDepth::Eight, None),
    ];
    for bytes in &files {
        for len in 1..bytes.len() {
            let error = decode(&bytes[..len], &DecodeOptions::default()).unwrap_err();
            assert!(len < 8 || error.is_corrupt(), "{len} of {}: {error}", bytes.len());
            assert!(probe(&bytes[..len]).is_err());
        }
    }
    let whole = tiff::<::tiff::encoder::colortype::RGB8>(&picture());
    for len in (8..whole.len()).step_by(97) {
        assert!(decode(&whole[..len], &DecodeOptions::default()).is_err(), "{len}");
    }
}

#[test]
fn bytes_behind_the_end_of_a_jpeg_are_no_harm() {
    let mut bytes = jpeg(&picture(), JpegColor::Rgb, false);
    let clean = open(&bytes);
    bytes.extend(b"a maker's trailer");
    assert_eq!(open(&bytes), clean);
}

#[test]
fn damaged_pixels_and_headers_never_panic() {
    for whole in [
        jpeg(&picture(), JpegColor::Rgb, false),
        jpeg(&picture(), JpegColor::Rgb, true),
        png(&picture(), ::png::ColorType::Rgb, ::png::BitDepth::Eight, None),
        tiff::<::tiff::encoder::colortype::RGB8>(&picture()),
    ] {
        let mut state = 1_u32;
        for _ in 0..300 {
            let mut bytes = whole.clone();
            for _ in 0..3 {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let at = (state >> 8) as usize % bytes.len();
                bytes[at] ^= (state >> 3) as u8 | 1;
            }
            let options = DecodeOptions { max_pixels: 1_000_000, ..DecodeOptions::default() };
            if let Ok(image) = decode(&bytes, &options) {
                assert_eq!(image.luma.data.len(), image.luma.width * image.luma.height);
            }
        }
    }
}

#[test]
fn what_is_no_image_is_refused_with_the_remedy() {
    for (bytes, says) in [
        (b"".as_slice(), "0 bytes"),
        (b"Dear all, the photographs are on the other drive.\n", "text"),
        (b"\x00\x01\x02\x03\x04\x05\x06\x07\x08\x09\x0a\x0b", "convert it"),
        (b"\x00\x00\x00\x18ftypheic\x00\x00\x00\x00", "HEIC"),
        (b"\x00\x00\x00\x18ftypcrx \x00\x00\x00\x00", "CR3"),
        (b"II\x2a\x00\x10\x00\x00\x00CR\x02\x00", "CR2"),
        (b"FUJIFILMCCD-RAW 0201", "RAF"),
        (b"RIFF\x00\x00\x00\x00WEBPVP8 ", "WebP"),
    ] {
        let error = decode(bytes, &DecodeOptions::default()).unwrap_err();
        assert!(error.to_string().contains(says), "{error}");
        assert!(error.is_unsupported() || bytes.is_empty());
    }
}

#[test]
fn tiny_images_are_images_and_huge_ones_are_refused() {
    let mut bytes = Vec::new();
    Encoder::new(&mut bytes, 90).encode(&[200], 1, 1, JpegColor::Luma).unwrap();
    let image = decode(&bytes, &DecodeOptions::default()).unwrap();
    assert_eq!((image.luma.width, image.luma.height, image.luma.data.len()), (1, 1, 1));
    let options = DecodeOptions { max_pixels: 100, ..DecodeOptions::default() };
    let error = decode(&jpeg(&picture(), JpegColor::Rgb, false), &options).unwrap_err();
    assert!(error.is_unsupported() && error.to_string().contains("max_pixels"));
}
