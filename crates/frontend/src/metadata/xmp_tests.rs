//! Packets as drones write them, and broken ones.

use terrane_scene::{AttitudeOf, AttitudePrior, FlightPrior};

use super::xmp::Packet;

fn packet(inside: &str) -> Packet {
    let text = format!(
        "\u{fffd}noise<x:xmpmeta xmlns:x=\"adobe:ns:meta/\"><rdf:RDF>{inside}</rdf:RDF></x:xmpmeta>rest"
    );
    Packet::find(text.as_bytes())
}

fn flight(height: Option<f64>, of: AttitudeOf, angles: (Option<f64>, f64, f64)) -> Option<FlightPrior> {
    let (yaw_deg, pitch_deg, roll_deg) = angles;
    let attitude = Some(AttitudePrior { of, yaw_deg, pitch_deg, roll_deg });
    Some(FlightPrior { height_above_ground_m: height, attitude })
}

#[test]
fn every_maker_is_read() {
    let dji = packet(
        r#"<rdf:Description rdf:about="DJI Meta Data" drone-dji:AbsoluteAltitude="+198.31"
           drone-dji:RelativeAltitude="+39.80" drone-dji:GimbalRollDegree="+0.00" drone-dji:GimbalYawDegree="+45.00"
           drone-dji:GimbalPitchDegree="-89.90" drone-dji:FlightYawDegree="+46.00"></rdf:Description>"#,
    );
    assert_eq!(dji.flight(), flight(Some(39.8), AttitudeOf::Gimbal, (Some(45.0), -89.9, 0.0)));
    let autel = packet(
        "<rdf:Description drone:RelativeAltitude='31.5' drone:GimbalYawDegree='-12' drone:GimbalPitchDegree='-60' />",
    );
    assert_eq!(autel.flight(), flight(Some(31.5), AttitudeOf::Gimbal, (Some(-12.0), -60.0, 0.0)));
    let parrot = packet(
        "<rdf:Description><drone-parrot:CameraRollDegree>0.5</drone-parrot:CameraRollDegree>
         <drone-parrot:CameraPitchDegree> -74.25 </drone-parrot:CameraPitchDegree>
         <drone-parrot:CameraYawDegree>101</drone-parrot:CameraYawDegree></rdf:Description>",
    );
    assert_eq!(parrot.flight(), flight(None, AttitudeOf::Gimbal, (Some(101.0), -74.25, 0.5)));
    let sensefly = packet(
        "<rdf:Description><Camera:Yaw>86.7</Camera:Yaw><Camera:Pitch>7.9</Camera:Pitch><Camera:Roll>-1.2</Camera:Roll>
         <Camera:AboveGroundAltitude>1213/10</Camera:AboveGroundAltitude></rdf:Description>",
    );
    assert_eq!(sensefly.flight(), flight(Some(121.3), AttitudeOf::Craft, (Some(86.7), 7.9, -1.2)));
    let old = r#"<drone-skydio:CameraOrientationFLU drone-skydio:Pitch="1" drone-skydio:Roll="2" drone-skydio:Yaw="3"/>
        <drone-skydio:CameraOrientationNED drone-skydio:Pitch="-45.5" drone-skydio:Roll="0.1" drone-skydio:Yaw="127.4"/>"#;
    let new = "<drone-skydio:CameraOrientationNED rdf:parseType=\"Resource\"><drone-skydio:Yaw>127.4</drone-skydio:Yaw>
        <drone-skydio:Pitch>-45.5</drone-skydio:Pitch><drone-skydio:Roll>0.1</drone-skydio:Roll></drone-skydio:CameraOrientationNED>";
    let nested =
        format!("<a:Other><b:Pitch>9</b:Pitch></a:Other>{}", new.replace(" rdf:parseType=\"Resource\"", ""));
    for inside in [old, new, &nested] {
        let skydio = packet(&format!("<rdf:Description>{inside}</rdf:Description>"));
        assert_eq!(skydio.flight(), flight(None, AttitudeOf::Gimbal, (Some(127.4), -45.5, 0.1)), "{inside}");
    }
}

#[test]
fn what_is_no_knowledge_is_left_out() {
    let gimbal = |pitch: &str, yaw: &str| {
        packet(&format!(
            "<rdf:Description drone-dji:GimbalPitchDegree=\"{pitch}\" drone-dji:GimbalYawDegree=\"{yaw}\" drone-dji:GimbalRollDegree=\"0\"/>"
        ))
        .flight()
    };
    assert_eq!(gimbal("+0.00", "0.0"), None, "three zeros are what a gimbal writes that doesn't know");
    assert!(gimbal("0.00", "12").is_some() && gimbal("-90", "0").is_some());
    for bad in ["NaN", "inf", "-9000", "", "x", "1/0"] {
        assert_eq!(gimbal(bad, "3"), None, "{bad}");
    }
    assert_eq!(packet("").flight(), None);
    assert_eq!(packet("<rdf:Description drone-dji:RelativeAltitude=\"99999\"/>").flight(), None);
    assert_eq!(Packet::find(b"").flight(), None);
    assert_eq!(Packet::find(b"drone-dji:GimbalPitchDegree=\"-90\"").flight(), None);
}

#[test]
fn damaged_packets_never_panic() {
    let whole = br#"<x:xmpmeta><rdf:RDF><rdf:Description drone-dji:RelativeAltitude="+39.80" a='b"c'><!-- > -->
        <drone-skydio:CameraOrientationNED><drone-skydio:Pitch>-3/4</drone-skydio:Pitch></drone-skydio:CameraOrientationNED>
        <?x y?><a/><b></b></rdf:Description></rdf:RDF></x:xmpmeta>"#;
    assert_eq!(Packet::find(whole).number("drone-dji:RelativeAltitude"), Some(39.8));
    let mut state = 7_u32;
    for round in 0..20_000 {
        let mut bytes = whole.to_vec();
        for _ in 0..1 + round % 4 {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let at = 11 + (state >> 8) as usize % (bytes.len() - 11);
            bytes[at] = if state & 64 == 0 { b"<>/\"'= \0"[(state >> 3) as usize % 8] } else { state as u8 };
        }
        Packet::find(&bytes).flight();
        Packet::find(&bytes[..bytes.len().saturating_sub(round % 400)]).flight();
    }
    let deep = format!("<x:xmpmeta>{}", "<a>".repeat(50_000));
    assert_eq!(Packet::find(deep.as_bytes()).flight(), None);
}
