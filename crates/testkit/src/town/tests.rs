//! The photographs show what the truth says.

use super::*;

fn small() -> TownOptions {
    TownOptions {
        rows: 1,
        columns: 2,
        width_px: 320,
        height_px: 240,
        focal_px: 270.0,
        texels_per_m: 4.0,
        ..Default::default()
    }
}

#[test]
fn a_photograph_is_a_jpeg_with_position_and_detail() {
    let town = Town::new(&small());
    let photograph = town.photograph(1);
    let mut reader = std::io::Cursor::new(&photograph.jpeg);
    let tags = ::exif::Reader::new().read_from_container(&mut reader).expect("EXIF is readable");
    let latitude = tags.get_field(::exif::Tag::GPSLatitude, ::exif::In::PRIMARY).expect("has a latitude");
    let ::exif::Value::Rational(parts) = &latitude.value else { panic!("latitude is rational") };
    let degrees = parts[0].to_f64() + parts[1].to_f64() / 60.0 + parts[2].to_f64() / 3600.0;
    assert!((degrees - 47.05).abs() < 0.01, "latitude {degrees}");
    assert!(photograph.jpeg.len() > 20_000, "a flat picture compresses to {} bytes", photograph.jpeg.len());
}

#[test]
fn same_seed_same_bytes() {
    let options = small();
    assert_eq!(Town::new(&options).photograph(0).jpeg, Town::new(&options).photograph(0).jpeg);
}
