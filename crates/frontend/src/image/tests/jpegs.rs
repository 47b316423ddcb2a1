//! JPEG of every kind that cameras and scanners write, and those that are named and refused.

use jpeg_encoder::SamplingFactor;

use super::*;

const SAMPLINGS: [(SamplingFactor, f64); 4] = [
    (SamplingFactor::F_1_1, 4.0),
    (SamplingFactor::F_2_1, 4.0),
    (SamplingFactor::F_1_2, 6.0),
    (SamplingFactor::F_2_2, 6.0),
];

#[test]
fn every_subsampling_is_decoded_baseline_progressive_and_with_restarts() {
    for (sampling, bound) in SAMPLINGS {
        for progressive in [false, true] {
            for restarts in [0, 2] {
                let bytes = jpeg(&picture(), JpegColor::Rgb, |encoder| {
                    encoder.set_sampling_factor(sampling);
                    encoder.set_progressive(progressive);
                    encoder.set_restart_interval(restarts);
                });
                let what = format!("{sampling:?}, progressive {progressive}, restarts {restarts}");
                let image = decode(&bytes, &DecodeOptions::default()).expect(&what);
                assert_near(&image.luma.data, &grays(), 2.0);
                assert_near(&image.rgb.unwrap().data, &halved(&picture()), bound);
                let gray = DecodeOptions { color: false, ..DecodeOptions::default() };
                assert_eq!(decode(&bytes, &gray).unwrap().luma, image.luma);
            }
        }
    }
}

#[test]
fn every_small_size_is_decoded() {
    for (width, height) in
        [(1, 1), (1, 9), (7, 3), (8, 8), (9, 16), (15, 17), (16, 16), (17, 31), (64, 5), (33, 64)]
    {
        let data: Vec<u8> = (0..width * height).flat_map(|k| [(k % width * 3) as u8 + 40, 90, 90]).collect();
        for (sampling, _) in SAMPLINGS {
            for progressive in [false, true] {
                let mut bytes = Vec::new();
                let mut encoder = Encoder::new(&mut bytes, 98);
                encoder.set_sampling_factor(sampling);
                encoder.set_progressive(progressive);
                encoder.encode(&data, width as u16, height as u16, JpegColor::Rgb).unwrap();
                let image = decode(&bytes, &DecodeOptions::default())
                    .unwrap_or_else(|e| panic!("{width} x {height} {sampling:?} {progressive}: {e}"));
                let wanted: Vec<u8> = data.chunks(3).map(luma_of).collect();
                assert_near(&image.luma.data, &wanted, 3.0);
            }
        }
    }
}

#[test]
fn greys_and_inks_are_decoded() {
    for progressive in [false, true] {
        let gray = open(&jpeg(&grays(), JpegColor::Luma, |e| e.set_progressive(progressive)));
        assert_near(&gray.luma.data, &grays(), 2.0);
        assert_eq!(gray.rgb, None);
    }
    let cmyk: Vec<u8> = picture().chunks(3).flat_map(|p| [255 - p[0], 255 - p[1], 255 - p[2], 0]).collect();
    for kind in [JpegColor::Cmyk, JpegColor::CmykAsYcck] {
        for progressive in [false, true] {
            let image = open(&jpeg(&cmyk, kind, |e| e.set_progressive(progressive)));
            assert_near(&image.rgb.unwrap().data, &halved(&picture()), 6.0);
            assert_near(&image.luma.data, &grays(), 4.0);
        }
    }
}

/// The same picture as libjpeg-turbo's cjpeg writes it; the library of these tests does not interleave such samplings.
#[test]
fn a_quarter_of_the_colors_across_is_decoded() {
    let image = open(include_bytes!("sampled_4x1.jpg"));
    assert_near(&image.luma.data, &grays(), 2.0);
    assert_eq!(image.rgb.map(|rgb| (rgb.width, rgb.height)), Some((19, 11)));
}

#[test]
fn files_that_the_decoder_would_get_wrong_are_refused() {
    let separate = error_of(include_bytes!("separate_scans.jpg"));
    assert!(separate.is_unsupported() && separate.to_string().contains("separate scans"), "{separate}");
    let mut coarse = jpeg(&picture(), JpegColor::Rgb, |_| {});
    let at = frame_header(&coarse);
    // Twice as many samples of the second component.
    coarse[at + 14] = 0x22;
    assert!(error_of(&coarse).to_string().contains("more coarsely"), "{}", error_of(&coarse));
}

/// The frame header's place in a file.
fn frame_header(bytes: &[u8]) -> usize {
    bytes.windows(2).position(|pair| matches!(pair, [0xff, 0xc0 | 0xc2])).unwrap()
}

#[test]
fn processes_and_depths_that_are_not_read_are_named() {
    let arithmetic = error_of(include_bytes!("arithmetic.jpg"));
    assert!(arithmetic.is_unsupported() && arithmetic.to_string().contains("arithmetic"), "{arithmetic}");
    let whole = jpeg(&picture(), JpegColor::Rgb, |_| {});
    let at = frame_header(&whole);
    for (marker, says) in [
        (0xc9, "arithmetic"),
        (0xca, "arithmetic"),
        (0xc3, "lossless"),
        (0xc5, "hierarchical"),
        (0xf7, "JPEG-LS"),
    ] {
        let mut bytes = whole.clone();
        bytes[at + 1] = marker;
        let error = error_of(&bytes);
        assert!(error.is_unsupported() && error.to_string().contains(says), "{error}");
        assert!(probe(&bytes).is_err(), "{says} is found when photographs are listed");
    }
    let mut twelve = whole.clone();
    twelve[at + 4] = 12;
    assert!(error_of(&twelve).is_unsupported() && error_of(&twelve).to_string().contains("12 bits"));
}

#[test]
fn bytes_around_the_image_are_no_harm() {
    let mut bytes = jpeg(&picture(), JpegColor::Rgb, |_| {});
    let clean = open(&bytes);
    bytes.extend(b"a maker's trailer");
    assert_eq!(open(&bytes), clean);
    // A second image behind the first, as in Ultra HDR and multi-picture files.
    let second = jpeg(&grays(), JpegColor::Luma, |_| {});
    bytes.extend(second);
    assert_eq!(open(&bytes), clean);
    // A thumbnail inside a segment, and fill bytes before it.
    let thumbnail = jpeg(&grays(), JpegColor::Luma, |_| {});
    let mut segment = vec![0xff, 0xff, 0xe2];
    segment.extend(((thumbnail.len() + 2) as u16).to_be_bytes());
    segment.extend(thumbnail);
    bytes.splice(2..2, segment);
    assert_eq!(open(&bytes), clean);
}
