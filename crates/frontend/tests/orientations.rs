//! Photographs taken with the camera held in each of the eight ways: the pixel grid stays that of the file, the
//! orientation is recorded, and what is found lies at the corresponding places.

use exif::experimental::Writer;
use exif::{Field, In, Tag, Value};
use jpeg_encoder::{ColorType, Encoder};
use terrane_frontend::sift::{SiftOptions, extract};
use terrane_frontend::{cameras, image, metadata};
use terrane_scene::Orientation;

const WIDTH: usize = 240;
const HEIGHT: usize = 160;

/// Blobs of many sizes.
fn scene() -> Vec<u8> {
    let mut state = 5_u32;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(state >> 8) / f64::from(1 << 24)
    };
    let mut brightness = vec![120.0; WIDTH * HEIGHT];
    for _ in 0..220 {
        let (x, y) = (random() * WIDTH as f64, random() * HEIGHT as f64);
        let (sigma, height) = (1.5 + 5.0 * random() * random(), 160.0 * random() - 80.0);
        for (k, value) in brightness.iter_mut().enumerate() {
            let (dx, dy) = ((k % WIDTH) as f64 + 0.5 - x, (k / WIDTH) as f64 + 0.5 - y);
            *value += height * (-(dx * dx + dy * dy) / (2.0 * sigma * sigma)).exp();
        }
    }
    brightness.into_iter().map(|value| value.clamp(0.0, 255.0) as u8).collect()
}

/// Where a place of the upright scene lies in the file (Exif 2.32, Orientation); lengths are those of the scene.
fn in_file(orientation: u8, x: f64, y: f64) -> (f64, f64) {
    let (w, h) = (WIDTH as f64, HEIGHT as f64);
    match orientation {
        1 => (x, y),
        2 => (w - x, y),
        3 => (w - x, h - y),
        4 => (x, h - y),
        5 => (y, x),
        6 => (y, w - x),
        7 => (h - y, w - x),
        _ => (h - y, x),
    }
}

/// The photograph of a camera held in this way.
fn photograph(scene: &[u8], orientation: u8) -> Vec<u8> {
    let (width, height) = if orientation < 5 { (WIDTH, HEIGHT) } else { (HEIGHT, WIDTH) };
    let mut pixels = vec![0; width * height];
    for (k, value) in scene.iter().enumerate() {
        let (x, y) = in_file(orientation, (k % WIDTH) as f64 + 0.5, (k / WIDTH) as f64 + 0.5);
        pixels[y as usize * width + x as usize] = *value;
    }
    let fields = [
        Field {
            tag: Tag::Orientation,
            ifd_num: In::PRIMARY,
            value: Value::Short(vec![u16::from(orientation)]),
        },
        Field { tag: Tag::Model, ifd_num: In::PRIMARY, value: Value::Ascii(vec![b"camera".to_vec()]) },
    ];
    let mut writer = Writer::new();
    fields.iter().for_each(|field| writer.push_field(field));
    let mut tags = std::io::Cursor::new(Vec::new());
    writer.write(&mut tags, false).expect("written");
    let mut segment = b"Exif\0\0".to_vec();
    segment.extend(tags.into_inner());
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, 98);
    encoder.add_app_segment(1, segment).expect("short");
    encoder.encode(&pixels, width as u16, height as u16, ColorType::Luma).expect("encoded");
    bytes
}

#[test]
fn features_lie_at_corresponding_places_of_the_file_s_own_grid() {
    let scene = scene();
    let options = SiftOptions::default();
    let keypoints = |orientation: u8| {
        let bytes = photograph(&scene, orientation);
        let decoded = image::decode(&bytes, &image::DecodeOptions::default()).expect("decoded");
        let found = metadata::read(&bytes).expect("read");
        assert_eq!(found.orientation, Orientation(orientation));
        assert_eq!(
            (found.width_px as usize, found.height_px as usize),
            (decoded.luma.width, decoded.luma.height)
        );
        assert_eq!(decoded.luma.width == WIDTH, orientation < 5, "the pixels are not turned");
        extract(&decoded.luma, decoded.rgb.as_ref(), &options).keypoints
    };
    let upright = keypoints(1);
    assert!(upright.len() > 100, "{} keypoints", upright.len());
    for orientation in 2..=8 {
        let turned = keypoints(orientation);
        let found = upright
            .iter()
            .filter(|keypoint| {
                let (x, y) = in_file(orientation, f64::from(keypoint.x_px), f64::from(keypoint.y_px));
                turned.iter().any(|other| {
                    (f64::from(other.x_px) - x).hypot(f64::from(other.y_px) - y) < 0.5
                        && (other.scale_px / keypoint.scale_px).ln().abs() < 0.1
                })
            })
            .count();
        println!(
            "orientation {orientation}: {found} of {} keypoints, {} in all",
            upright.len(),
            turned.len()
        );
        assert!(found * 100 >= upright.len() * 90, "orientation {orientation}: {found} of {}", upright.len());
        assert!(turned.len() * 100 <= upright.len() * 115, "{} and {}", turned.len(), upright.len());
    }
}

#[test]
fn cameras_are_grouped_by_the_grid_and_not_by_how_they_were_held() {
    let scene = scene();
    let images: Vec<_> = (1..=8)
        .map(|orientation| {
            let found = metadata::read(&photograph(&scene, orientation)).expect("read");
            (format!("{orientation}.jpg"), found)
        })
        .collect();
    let (groups, camera_of_image) = cameras::group(&images, None);
    // The sensor's grid is one; files that a program has turned before are another camera, of another grid.
    assert_eq!(groups.len(), 2);
    assert!(camera_of_image[..4].iter().all(|camera| *camera == camera_of_image[0]));
    assert!(camera_of_image[4..].iter().all(|camera| *camera == camera_of_image[4]));
    for (record, (_, found)) in groups.iter().zip([&images[0], &images[4]]) {
        assert_eq!((record.camera.width_px, record.camera.height_px), (found.width_px, found.height_px));
    }
}
