//! TIFF of every kind, and as another library writes it.

use terrane_testkit::files::{Compression, TiffWriter};

use super::*;

fn written_by_the_library<C>(data: &[C::Inner]) -> Vec<u8>
where
    C: ::tiff::encoder::colortype::ColorType,
    [C::Inner]: ::tiff::encoder::TiffValue,
{
    let mut bytes = std::io::Cursor::new(Vec::new());
    let mut encoder = ::tiff::encoder::TiffEncoder::new(&mut bytes).unwrap();
    encoder.write_image::<C>(SIZE.0 as u32, SIZE.1 as u32, data).unwrap();
    bytes.into_inner()
}

fn writer(samples: usize, bits: usize) -> TiffWriter {
    TiffWriter::new(SIZE.0, SIZE.1, samples, bits)
}

fn values(data: &[u8], bits: usize) -> Vec<u64> {
    data.iter().map(|v| if bits > 8 { u64::from(*v) << (bits - 8) | 1 } else { u64::from(*v) }).collect()
}

/// All ways to lay out and pack the same pixels.
fn layouts(base: &TiffWriter) -> Vec<TiffWriter> {
    let mut all = Vec::new();
    for compression in [Compression::None, Compression::PackBits, Compression::Lzw, Compression::Deflate] {
        for (tile, planar) in [(None, false), (None, true), (Some((16, 16)), false), (Some((16, 32)), true)] {
            for (big_endian, big) in [(false, false), (true, false), (false, true), (true, true)] {
                for predictor in [1, 2] {
                    all.push(TiffWriter {
                        compression,
                        tile,
                        planar,
                        big_endian,
                        big,
                        predictor,
                        ..base.clone()
                    });
                }
            }
        }
    }
    all
}

#[test]
fn every_layout_packing_and_byte_order_gives_the_same_pixels() {
    for bits in [8, 16] {
        for tiff in layouts(&writer(3, bits)) {
            let image = open(&tiff.write(&values(&picture(), bits)));
            assert_near(&image.luma.data, &grays(), 0.51);
            assert_near(&image.rgb.unwrap().data, &halved(&picture()), 0.51);
        }
        for tiff in layouts(&writer(1, bits)) {
            let image = open(&tiff.write(&values(&grays(), bits)));
            assert_eq!((image.luma.data, image.rgb), (grays(), None), "{tiff:?}");
        }
    }
}

#[test]
fn files_of_another_library_are_decoded() {
    use ::tiff::encoder::colortype::{Gray8, Gray16, RGB8, RGB16, RGBA8};
    let wide = |data: Vec<u8>| data.into_iter().map(|v| u16::from(v) << 8 | 5).collect::<Vec<u16>>();
    let with_alpha: Vec<u8> = picture().chunks(3).flat_map(|p| [p[0], p[1], p[2], 9]).collect();
    for bytes in [
        written_by_the_library::<RGB8>(&picture()),
        written_by_the_library::<RGB16>(&wide(picture())),
        written_by_the_library::<RGBA8>(&with_alpha),
    ] {
        let image = open(&bytes);
        assert_near(&image.luma.data, &grays(), 0.51);
        assert_near(&image.rgb.unwrap().data, &halved(&picture()), 0.51);
    }
    for bytes in [written_by_the_library::<Gray8>(&grays()), written_by_the_library::<Gray16>(&wide(grays()))]
    {
        assert_eq!(open(&bytes).luma.data, grays());
    }
}

#[test]
fn greys_of_few_and_many_bits_white_as_zero_and_alpha_are_decoded() {
    for bits in [1, 2, 4, 8] {
        let max = (1_u64 << bits) - 1;
        let levels: Vec<u64> = grays().iter().map(|v| u64::from(*v) * max / 255).collect();
        let wanted: Vec<u8> = levels.iter().map(|v| (v * 255 / max) as u8).collect();
        assert_eq!(open(&writer(1, bits).write(&levels)).luma.data, wanted);
        let inverted = TiffWriter { photometric: 0, ..writer(1, bits) };
        let flipped: Vec<u64> = levels.iter().map(|v| max - v).collect();
        assert_eq!(open(&inverted.write(&flipped)).luma.data, wanted);
    }
    for bits in [10, 12, 14, 16] {
        let image = open(&TiffWriter { big_endian: true, ..writer(1, bits) }.write(&values(&grays(), bits)));
        assert_eq!(image.luma.data, grays(), "{bits}");
    }
    let with_alpha: Vec<u64> = grays().iter().flat_map(|v| [u64::from(*v), 9]).collect();
    assert_eq!(open(&writer(2, 8).write(&with_alpha)).luma.data, grays());
    let five_bands: Vec<u64> = grays().iter().flat_map(|v| [u64::from(*v), 1, 2, 3, 4]).collect();
    let bands = TiffWriter { photometric: 1, planar: true, ..writer(5, 8) };
    assert_eq!(open(&bands.write(&five_bands)).luma.data, grays());
}

#[test]
fn palettes_and_inks_are_decoded() {
    let indices: Vec<u64> = (0..(SIZE.0 * SIZE.1) as u64).map(|k| k % 16).collect();
    let rgb: Vec<u8> = indices.iter().flat_map(|k| [*k as u8 * 16, 255 - *k as u8 * 8, 7]).collect();
    let channel = |f: fn(u64) -> u64| (0..16).flat_map(move |k| ((f(k) << 8) as u16).to_le_bytes());
    let map = channel(|k| k * 16).chain(channel(|k| 255 - k * 8)).chain(channel(|_| 7)).collect();
    let tiff = TiffWriter { photometric: 3, extra: vec![(320, 3, 48, map)], ..writer(1, 4) };
    let image = open(&tiff.write(&indices));
    assert_near(&image.rgb.unwrap().data, &halved(&rgb), 0.51);
    let inks: Vec<u64> =
        picture().chunks(3).flat_map(|p| [255 - p[0], 255 - p[1], 255 - p[2], 0]).map(u64::from).collect();
    let image = open(&TiffWriter { photometric: 5, ..writer(4, 8) }.write(&inks));
    assert_near(&image.luma.data, &grays(), 0.51);
}

#[test]
fn floats_and_wide_integers_are_stretched() {
    let ramp = |k: usize| (k % SIZE.0) as f64 * 0.01 + 290.0;
    let check = |bytes: &[u8], what: &str| {
        let luma = open(bytes).luma.data;
        let row = &luma[..SIZE.0];
        assert!(row.windows(2).all(|pair| pair[1] > pair[0]), "{what}: {row:?}");
        assert!(row[0] <= 20 && row[SIZE.0 - 1] >= 235, "{what}: {row:?}");
    };
    let all = 0..SIZE.0 * SIZE.1;
    for predictor in [1, 3] {
        for big_endian in [false, true] {
            let base = TiffWriter {
                format: 3,
                predictor,
                big_endian,
                compression: Compression::Deflate,
                ..writer(1, 32)
            };
            let mut singles: Vec<u64> = all.clone().map(|k| u64::from((ramp(k) as f32).to_bits())).collect();
            check(&base.write(&singles), "32 bits");
            // What is no number is black and moves nothing else.
            singles[SIZE.0 * 7] = u64::from(f32::NAN.to_bits());
            check(&base.write(&singles), "32 bits with a hole");
            let doubles: Vec<u64> = all.clone().map(|k| ramp(k).to_bits()).collect();
            check(&TiffWriter { bits: 64, ..base.clone() }.write(&doubles), "64 bits");
            let halves: Vec<u64> = all.clone().map(|k| 0x3c00 + (k % SIZE.0) as u64).collect();
            check(&TiffWriter { bits: 16, ..base }.write(&halves), "16 bits");
        }
    }
    let signed: Vec<u64> = all.clone().map(|k| ((k % SIZE.0) as i64 * 40 - 500) as u64 & 0xffff).collect();
    check(&TiffWriter { format: 2, ..writer(1, 16) }.write(&signed), "signed");
    let long: Vec<u64> = all.map(|k| (k % SIZE.0) as u64 * 90_000).collect();
    check(&writer(1, 32).write(&long), "32-bit integers");
}

#[test]
fn jpeg_in_strips_is_decoded() {
    // One strip that is a JPEG of greys, whole with its tables.
    let inner = jpeg(&grays(), JpegColor::Luma, |_| {});
    let mut tiff =
        TiffWriter { rows_per_strip: SIZE.1, extra: vec![(259, 3, 1, vec![7, 0])], ..writer(1, 8) };
    let mut bytes = tiff.write(&values(&grays(), 8));
    let start = bytes.len() as u32;
    bytes.extend(&inner);
    tiff.extra.push((273, 4, 1, start.to_le_bytes().to_vec()));
    tiff.extra.push((279, 4, 1, (inner.len() as u32).to_le_bytes().to_vec()));
    let mut bytes = tiff.write(&values(&grays(), 8));
    bytes.resize(start as usize, 0);
    bytes.extend(&inner);
    assert_near(&open(&bytes).luma.data, &grays(), 2.0);
}

#[test]
fn what_is_not_read_is_named() {
    let with = |tag: u16, value: u16| {
        let tiff = TiffWriter { extra: vec![(tag, 3, 1, value.to_le_bytes().to_vec())], ..writer(1, 8) };
        error_of(&tiff.write(&values(&grays(), 8)))
    };
    for (tag, value, says) in [
        (259, 4, "CCITT"),
        (259, 6, "old style"),
        (259, 50_000, "Zstandard"),
        (254, 1, "camera raw"),
        (262, 32_803, "camera raw"),
        (50_706, 1, "camera raw"),
        (262, 4, "mask"),
        (266, 2, "reversed"),
    ] {
        let error = with(tag, value);
        assert!(error.is_unsupported() && error.to_string().contains(says), "{error}");
    }
    for (tag, value, says) in [(277, 0, "0 samples"), (339, 5, "complex"), (258, 7, "7 bits")] {
        assert!(with(tag, value).to_string().contains(says), "{}", with(tag, value));
    }
}

#[test]
fn truncated_and_forged_files_are_errors_when_they_are_listed() {
    for tiff in [writer(3, 8), TiffWriter { big: true, compression: Compression::Lzw, ..writer(3, 8) }] {
        let whole = tiff.write(&values(&picture(), 8));
        // The last value of the directory is not needed to know where the pixels are.
        for len in 1..whole.len() - 6 {
            assert!(probe(&whole[..len]).is_err(), "{len} of {}", whole.len());
        }
    }
    let mut forged = writer(1, 8);
    forged.extra.push((256, 4, 1, 60_000_u32.to_le_bytes().to_vec()));
    let error = error_of(&forged.write(&values(&grays(), 8)));
    assert!(error.is_corrupt() && error.to_string().contains("can't hold"), "{error}");
    for (tag, value) in [(273, 0xffff_ff00_u32), (278, 0), (279, 0), (257, 0)] {
        let broken = TiffWriter { extra: vec![(tag, 4, 1, value.to_le_bytes().to_vec())], ..writer(1, 8) };
        assert!(error_of(&broken.write(&values(&grays(), 8))).is_corrupt(), "{tag}");
    }
}
