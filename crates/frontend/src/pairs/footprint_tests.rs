//! Footprints against points of the ground seen through the camera, and neighbours against flights with known overlap.

use nalgebra::{Matrix3, Vector3};
use rand::RngExt;
use terrane_geometry::geodesy::{EnuFrame, Geodetic};
use terrane_geometry::{Camera, CameraModel, Seed};
use terrane_scene::{AttitudeOf, AttitudePrior, FlightPrior, ImagePair, ImageTable};

use super::footprint::{Footprint, View, enu_from_cam, tilt_rad};
use super::tests::{as_numbers, grid, options};
use super::{PairMode, PairOptions, PairSelection, select, views};

fn camera() -> Camera {
    Camera::centered(CameraModel::SimpleRadial, 400, 300, 300.0)
}

fn gimbal(yaw_deg: f64, pitch_deg: f64) -> AttitudePrior {
    AttitudePrior { of: AttitudeOf::Gimbal, yaw_deg: Some(yaw_deg), pitch_deg, roll_deg: 0.0 }
}

fn view(height_m: f64, attitude: AttitudePrior) -> View {
    View { height_m, attitude, on_its_side: false }
}

/// Columns are right, down and ahead of a camera that looks somewhere, its right side level.
fn level_axes(yaw_deg: f64, pitch_deg: f64) -> Matrix3<f64> {
    let (yaw, pitch) = (yaw_deg.to_radians(), pitch_deg.to_radians());
    let ahead = Vector3::new(yaw.sin() * pitch.cos(), yaw.cos() * pitch.cos(), pitch.sin());
    let right = Vector3::new(yaw.cos(), -yaw.sin(), 0.0);
    Matrix3::from_columns(&[right, ahead.cross(&right), ahead])
}

#[test]
fn attitudes_follow_their_conventions() {
    for (yaw, pitch) in [(0.0, -90.0), (0.0, 0.0), (90.0, -45.0), (200.0, -10.0), (-30.0, -89.0)] {
        let axes = enu_from_cam(&gimbal(yaw, pitch));
        assert!((axes - level_axes(yaw, pitch)).norm() < 1e-12, "{yaw} {pitch}: {axes}");
        // A camera in the floor, the craft's nose up by the rest of the quarter turn, looks the same way.
        let craft = AttitudePrior {
            of: AttitudeOf::Craft,
            yaw_deg: Some(yaw),
            pitch_deg: pitch + 90.0,
            roll_deg: 0.0,
        };
        assert!((enu_from_cam(&craft) - axes).norm() < 1e-12);
        assert!((tilt_rad(&craft).to_degrees() - (pitch + 90.0)).abs() < 1e-6);
    }
    // The right side down: what is on the left of the image rises.
    let rolled = AttitudePrior { roll_deg: 30.0, ..gimbal(0.0, 0.0) };
    assert!((enu_from_cam(&rolled).column(0).z + 0.5).abs() < 1e-12);
}

/// Shared ground by counting points that both cameras see.
fn counted_m2(places: &[(f64, f64); 2], views: &[View; 2]) -> f64 {
    const STEP_M: f64 = 2.0;
    let camera = camera();
    let sees = |at: usize, east: f64, north: f64| {
        let View { height_m, attitude, .. } = views[at];
        let axes = level_axes(attitude.yaw_deg.unwrap_or(0.0), attitude.pitch_deg);
        let x = Vector3::new(east - places[at].0, north - places[at].1, -height_m);
        let x_in_cam = axes.transpose() * x;
        camera
            .project(&x_in_cam)
            .is_some_and(|px| (0.0..=400.0).contains(&px.x) && (0.0..=300.0).contains(&px.y))
    };
    let points = (-250..250).flat_map(|i| (-250..250).map(move |j| (f64::from(i), f64::from(j))));
    let seen = points.filter(|&(i, j)| sees(0, i * STEP_M, j * STEP_M) && sees(1, i * STEP_M, j * STEP_M));
    seen.count() as f64 * STEP_M * STEP_M
}

#[test]
fn shared_ground_is_that_of_points_seen_twice_anywhere_on_earth() {
    let mut rng = Seed(1).rng();
    let corners = [(47.0, 8.0), (-33.0, 180.0), (89.9999, 20.0), (0.0, 0.001), (-90.0, 0.0)];
    for (latitude_deg, longitude_deg) in corners {
        let origin = Geodetic::from_degrees(latitude_deg, longitude_deg, 0.0);
        let frame = EnuFrame::new(origin);
        for _ in 0..3 {
            let places = [(0.0, 0.0), (rng.random_range(-60.0..60.0), rng.random_range(-60.0..60.0))];
            let views = [0, 1].map(|_| {
                let attitude = gimbal(rng.random_range(0.0..360.0), rng.random_range(-90.0..-60.0));
                view(rng.random_range(80.0..120.0), attitude)
            });
            let made: Vec<Footprint> = (0..2)
                .map(|at| {
                    let (east, north) = places[at];
                    let place = frame.geodetic_from_enu(&Vector3::new(east, north, 0.0));
                    // North turns with the longitude near a pole: yaw is counted from that of the place.
                    let local = EnuFrame::new(Geodetic { height_m: 0.0, ..place });
                    let zero = local.ecef_from_enu(&Vector3::zeros());
                    let north = frame.enu_from_ecef(&(local.ecef_from_enu(&Vector3::y())))
                        - frame.enu_from_ecef(&zero);
                    let turn = north.x.atan2(north.y).to_degrees();
                    let mut held = views[at];
                    held.attitude.yaw_deg = held.attitude.yaw_deg.map(|yaw| yaw - turn);
                    Footprint::new(place.latitude_deg(), place.longitude_deg(), &camera(), &held)
                        .expect("the ground is seen")
                })
                .collect();
            let (shared, together) = made[0].overlap_m2(&made[1]);
            let counted = counted_m2(&places, &views);
            assert!(
                (shared - counted).abs() < 0.04 * counted + 120.0,
                "{shared} m² for {counted} at {origin:?}"
            );
            assert!(together >= shared && (made[1].overlap_m2(&made[0]).0 - shared).abs() < 1.0);
        }
    }
}

#[test]
fn footprints_end_before_the_horizon_and_circles_stand_for_unknown_headings() {
    let area = |height: f64, attitude| {
        let made = Footprint::new(47.0, 8.0, &camera(), &view(height, attitude))?;
        Some(made.overlap_m2(&made).0)
    };
    let down = area(90.0, gimbal(30.0, -90.0)).expect("ground");
    assert!((down - 120.0 * 90.0).abs() < 1.0, "{down}");
    let unknown = AttitudePrior { yaw_deg: None, ..gimbal(0.0, -85.0) };
    let circle = area(90.0, unknown).expect("ground");
    assert!((circle - down).abs() < 1.0, "{circle}");
    assert_eq!(area(90.0, AttitudePrior { pitch_deg: -45.0, ..unknown }), None);
    let flat = area(90.0, gimbal(30.0, -5.0)).expect("its lower half sees ground");
    assert!(flat > down && flat < 1e6, "{flat}");
    assert_eq!(area(90.0, gimbal(30.0, 40.0)), None, "it sees the sky");
    assert_eq!(area(f64::NAN, gimbal(30.0, -90.0)), None);
    let on_its_side = View { on_its_side: true, ..view(90.0, gimbal(0.0, -90.0)) };
    let upright = view(90.0, gimbal(90.0, -90.0));
    let made = [on_its_side, upright].map(|v| Footprint::new(47.0, 8.0, &camera(), &v).expect("ground"));
    assert!((made[0].overlap_m2(&made[1]).0 - down).abs() < 1.0);
}

/// A square of photographs 20 m apart, as [`grid`], each with a flight.
fn flown(side: usize, flight: impl Fn(usize) -> Option<FlightPrior>) -> ImageTable {
    let mut table = grid(side, 20.0);
    table.cameras[0].camera = camera();
    for (at, image) in table.images.iter_mut().enumerate() {
        image.flight = flight(at);
    }
    table
}

fn flight(height_m: f64, attitude: AttitudePrior) -> Option<FlightPrior> {
    Some(FlightPrior { height_above_ground_m: Some(height_m), attitude: Some(attitude) })
}

fn chosen(table: &ImageTable, neighbours: u32) -> PairSelection {
    let wanted = PairOptions { spatial_neighbours: neighbours, ..options(PairMode::Gps) };
    select(table, None, &wanted)
}

fn has(selection: &PairSelection, a: usize, b: usize) -> bool {
    let wanted = ImagePair::new(terrane_scene::ImageId::from_index(a), terrane_scene::ImageId::from_index(b));
    wanted.is_some_and(|wanted| selection.pairs.binary_search(&wanted).is_ok())
}

#[test]
fn obliques_are_paired_with_those_that_see_their_ground() {
    // Number 65 looks east at 45 degrees from 60 m: at ground 60 m, three columns, ahead of it.
    let table = flown(12, |at| flight(60.0, if at == 65 { gimbal(90.0, -45.0) } else { gimbal(0.0, -90.0) }));
    let selection = chosen(&table, 6);
    assert_eq!(selection.report.with_footprint, 144);
    assert!(has(&selection, 65, 68) && has(&selection, 65, 69), "{:?}", as_numbers(&selection.pairs));
    assert!(!has(&selection, 64, 65) && !has(&selection, 63, 65), "what lies behind it is not seen");
    // Two that look at each other from afar see one ground from opposite sides: nothing would match.
    let table = flown(12, |at| match at {
        63 => flight(60.0, gimbal(90.0, -45.0)),
        69 => flight(60.0, gimbal(-90.0, -45.0)),
        _ => flight(60.0, gimbal(0.0, -90.0)),
    });
    let selection = chosen(&table, 8);
    assert!(!has(&selection, 63, 69) && has(&selection, 63, 66) && has(&selection, 66, 69));
}

#[test]
fn directions_of_an_oblique_flight_are_tied_together() {
    // At every place one looks down, one ahead; there are more than enough of each to fill the lists.
    let attitude = |at: usize| if at.is_multiple_of(2) { gimbal(90.0, -90.0) } else { gimbal(90.0, -60.0) };
    let table = flown(14, |at| flight(120.0, attitude(at)));
    let selection = chosen(&table, 10);
    let mixed = as_numbers(&selection.pairs).iter().filter(|pair| (pair.0 + pair.1) % 2 == 1).count();
    let share = mixed as f64 / selection.pairs.len() as f64;
    assert!((0.15..0.6).contains(&share), "{share}");
}

#[test]
fn wrong_or_missing_heights_and_attitudes_fall_back_to_distance() {
    let down = gimbal(0.0, -90.0);
    let by_distance = chosen(&flown(12, |_| None), 8);
    let same = |table: &ImageTable| {
        let selection = chosen(table, 8);
        assert_eq!(selection.report.with_footprint, 0);
        assert_eq!(selection.pairs, by_distance.pairs);
    };
    same(&flown(12, |_| flight(0.3, down)));
    same(&flown(12, |_| flight(f64::NAN, down)));
    same(&flown(12, |_| flight(60.0, AttitudePrior { pitch_deg: f64::NAN, ..down })));
    same(&flown(12, |_| Some(FlightPrior { height_above_ground_m: Some(60.0), attitude: None })));
    same(&flown(12, |_| Some(FlightPrior { height_above_ground_m: None, attitude: Some(down) })));
    // A height ten times too small: footprints of 8 by 6 m never meet, which no flight is meant to be.
    same(&flown(12, |_| flight(6.0, down)));
    // Twice too great or too small changes little.
    for height in [30.0, 120.0] {
        let selection = chosen(&flown(12, |_| flight(height, down)), 8);
        let kept = by_distance.pairs.iter().filter(|pair| selection.pairs.contains(pair)).count();
        assert!(10 * kept >= 7 * by_distance.pairs.len(), "{kept} of {}", by_distance.pairs.len());
        assert!(selection.report.images_without_pair.is_empty());
    }
}

#[test]
fn what_is_missing_is_taken_from_the_rest_of_the_run() {
    let down = gimbal(0.0, -90.0);
    let mut table = flown(4, |at| match at {
        0 => None,
        1 => Some(FlightPrior { height_above_ground_m: Some(75.0), attitude: None }),
        _ => flight(80.0, down),
    });
    for (at, image) in table.images.iter_mut().enumerate() {
        // Altitudes in a datum that is off by a kilometre.
        image.gps.as_mut().expect("set by grid").altitude_m = Some(if at == 0 { 1_495.0 } else { 1_480.0 });
    }
    let seen = views::views(&table);
    assert_eq!(seen[0].map(|v| (v.height_m, v.attitude.yaw_deg)), Some((95.0, None)));
    assert_eq!(seen[1].map(|v| (v.height_m, v.attitude.pitch_deg)), Some((75.0, -90.0)));
    // Where others of the camera look aside, nothing is known of those that don't say.
    table.images[5].flight = flight(80.0, gimbal(0.0, -30.0));
    table.images[6].flight = flight(80.0, gimbal(0.0, -30.0));
    let seen = views::views(&table);
    assert!(seen[0].is_none() && seen[1].is_none() && seen[5].is_some());
}

#[test]
fn crowds_at_one_place_stay_cheap() {
    let mut table = flown(100, |_| flight(60.0, gimbal(0.0, -90.0)));
    let first = table.images[0].gps;
    table.images.iter_mut().for_each(|image| image.gps = first);
    let selection = chosen(&table, 6);
    assert!(selection.report.images_without_pair.is_empty());
    assert!(selection.pairs.len() <= 60_000);
}
