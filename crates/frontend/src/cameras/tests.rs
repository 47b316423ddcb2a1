//! Grouping and focal lengths.

use super::*;

fn photo(path: &str, width_px: u32, height_px: u32) -> (String, ImageMetadata) {
    (path.to_owned(), ImageMetadata { width_px, height_px, ..ImageMetadata::default() })
}

fn named(path: &str, model: &str, focal_mm: f64) -> (String, ImageMetadata) {
    let (path, metadata) = photo(path, 4000, 3000);
    let model = Some(model.to_owned());
    (path, ImageMetadata { make: Some("DJI".into()), model, focal_mm: Some(focal_mm), ..metadata })
}

#[test]
fn photographs_without_exif_share_a_camera_by_folder_and_size() {
    let images = [
        photo("a/1.jpg", 30, 20),
        photo("a/2.jpg", 30, 20),
        photo("a/3.jpg", 20, 30),
        photo("b/1.jpg", 30, 20),
    ];
    let (cameras, of_image) = group(&images, None);
    assert_eq!(of_image.iter().map(|id| id.0).collect::<Vec<_>>(), [0, 0, 1, 2]);
    assert_eq!(cameras.len(), 3);
    assert_eq!(cameras[0].focal_source, FocalSource::Guess);
    assert_eq!(cameras[0].camera.params(), [36.0, 15.0, 10.0, 0.0]);
}

#[test]
fn one_body_is_one_camera_across_folders_and_last_digits() {
    let images = [
        named("a/1.jpg", "FC6310", 8.8),
        named("b/1.jpg", "FC6310", 8.801),
        named("b/2.jpg", "FC6310", 24.0),
    ];
    let (cameras, of_image) = group(&images, None);
    assert_eq!(of_image.iter().map(|id| id.0).collect::<Vec<_>>(), [0, 0, 1]);
    assert_eq!(cameras[0].focal_source, FocalSource::Exif);
    assert!((cameras[0].camera.mean_focal_px() - 8.8 / 13.2 * 4000.0).abs() < 1e-9);
    assert_eq!(cameras[0].name, "DJI FC6310");
}

#[test]
fn a_given_camera_holds_for_every_photograph_of_a_size() {
    let given: GivenCamera = "PINHOLE:2759.48,2764.16,1520.69,1006.81".parse().unwrap();
    let images = [photo("a/1.jpg", 30, 20), named("b/2.jpg", "FC6310", 8.8), photo("b/3.jpg", 30, 20)];
    let (cameras, of_image) = group(&images, Some(&given));
    assert_eq!(of_image.iter().map(|id| id.0).collect::<Vec<_>>(), [0, 1, 0]);
    assert_eq!(cameras[0].focal_source, FocalSource::Given);
    assert_eq!(cameras[0].camera.params(), [2759.48, 2764.16, 1520.69, 1006.81]);
    let text = String::from(given.clone());
    assert_eq!(text.parse::<GivenCamera>().unwrap(), given);
}

#[test]
fn given_cameras_that_make_no_sense_are_refused_with_the_remedy() {
    for (text, says) in [
        ("PINHOLE", "MODEL:params"),
        ("FANCY:1,2", "SIMPLE_RADIAL"),
        ("PINHOLE:1,2,3", "takes 4 parameters"),
        ("PINHOLE:1,x,3,4", "'x' is not a number"),
        ("PINHOLE:0,1,3,4", "above 0"),
        ("PINHOLE:NaN,1,3,4", "finite"),
    ] {
        let error = text.parse::<GivenCamera>().unwrap_err();
        assert!(error.is_invalid_option());
        assert!(error.to_string().contains(says), "{text}: {error}");
    }
}

#[test]
fn focal_length_follows_the_best_evidence() {
    let base = ImageMetadata { width_px: 4000, height_px: 3000, ..ImageMetadata::default() };
    let estimate = estimate_focal(&base);
    assert_eq!((estimate.focal_px, estimate.evidence), (4800.0, FocalEvidence::ImageSize));
    // Across the diagonal: 5,000 pixels for the 43.27 mm of film.
    let equivalent = ImageMetadata { focal_35mm: Some(24.0), ..base };
    let estimate = estimate_focal(&equivalent);
    assert_eq!(estimate.evidence, FocalEvidence::Equivalent35mm);
    assert!((estimate.focal_px - 24.0 * 5000.0 / 43.2666).abs() < 0.01);
    let plane = ImageMetadata { focal_mm: Some(5.0), focal_plane_px_per_mm: Some(600.0), ..equivalent };
    assert_eq!(
        estimate_focal(&plane),
        FocalEstimate { focal_px: 3000.0, evidence: FocalEvidence::FocalPlane }
    );
    let sensor = ImageMetadata { make: Some("DJI".into()), model: Some("FC330".into()), ..plane };
    assert_eq!(estimate_focal(&sensor).evidence, FocalEvidence::KnownSensor);
    let absurd = ImageMetadata { focal_35mm: Some(1.0), ..ImageMetadata { focal_mm: None, ..sensor } };
    assert_eq!(estimate_focal(&absurd).evidence, FocalEvidence::ImageSize);
}
