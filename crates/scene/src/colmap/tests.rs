//! What is written is read, whatever the shards and however little is gathered at a time.

use std::borrow::Cow;

use terrane_geometry::{CameraModel, so3};

use super::*;
use crate::{Observation, Reconstruction, RegisteredImage};

fn sample() -> Reconstruction {
    let camera = |focal_px| Camera::centered(CameraModel::SimpleRadial, 640, 480, focal_px);
    let mut sample = Reconstruction {
        cameras: vec![(CameraId(0), camera(500.0)), (CameraId(3), camera(700.0))],
        ..Default::default()
    };
    for image in [0u32, 2, 5] {
        let rotation = so3::exp(&Vector3::new(0.1, 0.02 * f64::from(image), -0.05));
        let center = Vector3::new(f64::from(image), 0.5, -4.0);
        sample.images.push(RegisteredImage {
            image: ImageId(image),
            camera: CameraId(if image == 5 { 3 } else { 0 }),
            cam_from_world: Rigid3::from_rotation_and_center(rotation, &center),
        });
    }
    for number in 0..40u32 {
        let x_in_world = Vector3::new(f64::from(number % 7) * 0.3, f64::from(number / 7) * 0.2, 1.0);
        let seen = |image: u32| Observation {
            image: ImageId(image),
            feature: (number * 37 + image) % 101,
            x_px: number as f32 + 0.25,
            y_px: image as f32,
        };
        let track: Vec<_> =
            [0, 2, 5].into_iter().filter(|image| (number + image) % 3 != 0).map(seen).collect();
        sample.push_point(x_in_world, [number as u8, 2, 3], &track);
    }
    sample
}

/// The same points in shards of five.
struct Sharded(Reconstruction);

impl Model for Sharded {
    fn cameras(&self) -> &[(CameraId, Camera)] {
        &self.0.cameras
    }

    fn images(&self) -> &[RegisteredImage] {
        &self.0.images
    }

    fn num_shards(&self) -> usize {
        self.0.points.len().div_ceil(5)
    }

    fn shard(&self, shard: usize) -> Result<Cow<'_, Reconstruction>, SceneError> {
        let mut part = Reconstruction::default();
        for point in self.0.points.iter().skip(5 * shard).take(5) {
            part.push_point(point.x_in_world, point.color, self.0.track(point));
        }
        Ok(Cow::Owned(part))
    }
}

fn files() -> ModelFiles<Vec<u8>> {
    ModelFiles { cameras: Vec::new(), images: Vec::new(), points: Vec::new() }
}

fn binary_of(model: &dyn Model, gathered: u64) -> [Vec<u8>; 3] {
    let mut sink = binary::Binary(files());
    write(model, &|image| format!("folder/{image}.jpg"), &mut sink, gathered).unwrap();
    [sink.0.cameras, sink.0.images, sink.0.points]
}

#[test]
fn shards_and_batches_do_not_change_a_byte() {
    let whole = binary_of(&sample(), u64::MAX);
    for gathered in [1, 30, 60] {
        assert_eq!(binary_of(&sample(), gathered), whole);
        assert_eq!(binary_of(&Sharded(sample()), gathered), whole);
    }
}

#[test]
fn what_is_written_is_read() {
    let [cameras, images, points] = binary_of(&sample(), u64::MAX);
    let read = |cut: usize| {
        read_binary(ModelFiles {
            cameras: &cameras[..],
            images: &images[..],
            points: &points[..points.len() - cut],
        })
    };
    let model = read(0).unwrap();
    let sample = sample();
    assert_eq!(model.reconstruction.cameras, sample.cameras);
    assert_eq!(model.reconstruction.images, sample.images);
    assert_eq!(model.name(ImageId(5)), Some("folder/5.jpg"));
    for (a, b) in model.reconstruction.points.iter().zip(&sample.points) {
        assert_eq!((a.x_in_world, a.color), (b.x_in_world, b.color));
        for (x, y) in model.reconstruction.track(a).iter().zip(sample.track(b)) {
            assert_eq!((x.image, x.xy_px()), (y.image, y.xy_px()));
        }
    }
    // Written again, with places for features, it is the same model byte for byte.
    let again = binary_of(&model.reconstruction, u64::MAX);
    assert_eq!(again, [cameras.clone(), images.clone(), points.clone()]);
    for cut in [1, 7, 50] {
        assert!(read(cut).unwrap_err().is_corrupt());
    }
}

#[test]
fn text_has_a_line_for_everything() {
    let mut sink = text::Text(files());
    write(&sample(), &|image| format!("{image}.jpg"), &mut sink, 10).unwrap();
    let lines =
        |bytes: &[u8]| std::str::from_utf8(bytes).unwrap().lines().filter(|l| !l.starts_with('#')).count();
    assert_eq!([&sink.0.cameras, &sink.0.images, &sink.0.points].map(|file| lines(file)), [2, 6, 40]);
    let points = String::from_utf8(sink.0.points).unwrap();
    let first = points.lines().find(|line| !line.starts_with('#')).unwrap();
    assert_eq!(first.split(' ').count(), 8 + 2 * 2, "{first}");
}

#[test]
fn points_seen_by_unknown_images_are_refused() {
    let mut bad = sample();
    bad.images.pop();
    assert!(write_binary(&bad, &|_| String::new(), files()).is_err());
}
