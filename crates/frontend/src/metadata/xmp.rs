//! What drones write into XMP: height above ground, the camera's attitude, the receiver's deviations.
//!
//! Properties stand as attributes (DJI, Autel) or as elements (Parrot, senseFly, MicaSense), some inside another one
//! (Skydio). Only numbers are kept, under the names that makers document; a packet that is no XML gives what it holds
//! up to the fault.

use terrane_scene::{AttitudeOf, AttitudePrior, FlightPrior};

/// XMP stands in front of the pixels: a packet is at most 64 KiB, and a few segments may come before it.
const SEARCHED_BYTES: usize = 512 * 1024;
/// What is read of a packet.
const PACKET_BYTES: usize = 128 * 1024;
/// Properties kept, and elements inside each other, at most: makers write about a hundred and four.
const MAX_PROPERTIES: usize = 1024;
const MAX_DEPTH: usize = 16;

/// The numbers of a file's XMP packet.
#[derive(Debug, Default)]
pub(super) struct Packet {
    /// Name, with that of the element around it and a slash in front, and value.
    numbers: Vec<(String, f64)>,
}

impl Packet {
    /// The packet of a file; without one it has no numbers.
    pub(super) fn find(bytes: &[u8]) -> Self {
        let head = &bytes[..bytes.len().min(SEARCHED_BYTES)];
        let Some(start) = position(head, b"<x:xmpmeta").or_else(|| position(head, b"<rdf")) else {
            return Self::default();
        };
        let rest = &bytes[start..bytes.len().min(start + PACKET_BYTES)];
        let end = position(rest, b"</x:xmpmeta").unwrap_or(rest.len());
        let mut packet = Self::default();
        packet.scan(&rest[..end]);
        packet
    }

    /// The first number of a property, whatever stands around it.
    pub(super) fn number(&self, name: &str) -> Option<f64> {
        let is_named = |full: &str| full.rsplit_once('/').is_some_and(|(_, last)| last == name);
        self.numbers.iter().find(|(full, _)| is_named(full)).map(|(_, value)| *value)
    }

    /// The first number of a property inside an element.
    fn number_in(&self, element: &str, name: &str) -> Option<f64> {
        let is_named =
            |full: &str| full.strip_prefix(element).and_then(|f| f.strip_prefix('/')) == Some(name);
        self.numbers.iter().find(|(full, _)| is_named(full)).map(|(_, value)| *value)
    }

    fn push(&mut self, element: &str, name: &str, value: &[u8]) {
        if let Some(value) = parse(value).filter(|_| self.numbers.len() < MAX_PROPERTIES) {
            self.numbers.push((format!("{element}/{name}"), value));
        }
    }

    /// Goes through tags and the text between them.
    fn scan(&mut self, packet: &[u8]) {
        let mut open: Vec<String> = Vec::new();
        let mut rest = packet;
        while let Some(at) = rest.iter().position(|&b| b == b'<') {
            let text = &rest[..at];
            rest = &rest[at + 1..];
            let Some(end) = tag_end(rest) else { return };
            let (tag, after) = (&rest[..end], &rest[end + 1..]);
            match tag.first() {
                Some(b'/') => {
                    if let Some(name) = open.pop() {
                        self.push(around(&open), &name, text);
                    }
                }
                Some(b'?' | b'!') | None => {}
                Some(_) => {
                    let name = self.attributes(tag);
                    if tag.last() != Some(&b'/') {
                        open.push(name);
                        if open.len() > MAX_DEPTH {
                            return;
                        }
                    }
                }
            }
            rest = after;
        }
    }

    /// Takes the attributes of a tag; returns its name.
    fn attributes(&mut self, tag: &[u8]) -> String {
        let name_len = tag.iter().position(|b| b.is_ascii_whitespace() || *b == b'/').unwrap_or(tag.len());
        let name = String::from_utf8_lossy(&tag[..name_len]).into_owned();
        let mut rest = &tag[name_len..];
        while let Some(equals) = rest.iter().position(|&b| b == b'=') {
            let attribute = String::from_utf8_lossy(rest[..equals].trim_ascii()).into_owned();
            let value = rest[equals + 1..].trim_ascii_start();
            let Some((&quote, value)) = value.split_first().filter(|(q, _)| matches!(q, b'"' | b'\'')) else {
                break;
            };
            let Some(end) = value.iter().position(|&b| b == quote) else { break };
            self.push(&name, &attribute, &value[..end]);
            rest = &value[end + 1..];
        }
        name
    }

    /// Height above ground and attitude, when the packet has either.
    pub(super) fn flight(&self) -> Option<FlightPrior> {
        let height =
            ["drone-dji:RelativeAltitude", "drone:RelativeAltitude", "drone-skydio:RelativeAltitude"];
        let above_ground = self.number("Camera:AboveGroundAltitude");
        let height_above_ground_m = above_ground
            .or_else(|| height.iter().find_map(|name| self.number(name)))
            .filter(|height| (-1_000.0..=20_000.0).contains(height));
        let attitude = self.gimbal().or_else(|| self.craft()).filter(is_plausible);
        let flight = FlightPrior { height_above_ground_m, attitude };
        (flight != FlightPrior::default()).then_some(flight)
    }

    /// The attitude of a camera on a gimbal; three zeros are what a gimbal writes that doesn't know.
    fn gimbal(&self) -> Option<AttitudePrior> {
        let skydio = "drone-skydio:CameraOrientationNED";
        let angles = |of: &dyn Fn(&str) -> Option<f64>| Some((of("Yaw"), of("Pitch")?, of("Roll")));
        let plain = |prefix: &'static str, suffix: &'static str| {
            move |axis: &str| self.number(&format!("{prefix}{axis}{suffix}"))
        };
        let (yaw_deg, pitch_deg, roll_deg) = angles(&plain("drone-dji:Gimbal", "Degree"))
            .or_else(|| angles(&plain("drone:Gimbal", "Degree")))
            .or_else(|| angles(&plain("drone-parrot:Camera", "Degree")))
            .or_else(|| angles(&|axis| self.number_in(skydio, &format!("drone-skydio:{axis}"))))?;
        let roll_deg = roll_deg.unwrap_or(0.0);
        let is_known = [yaw_deg.unwrap_or(0.0), pitch_deg, roll_deg] != [0.0; 3];
        is_known.then_some(AttitudePrior { of: AttitudeOf::Gimbal, yaw_deg, pitch_deg, roll_deg })
    }

    /// The attitude of a craft that its camera is fixed to.
    fn craft(&self) -> Option<AttitudePrior> {
        let pitch_deg = self.number("Camera:Pitch")?;
        let roll_deg = self.number("Camera:Roll").unwrap_or(0.0);
        Some(AttitudePrior { of: AttitudeOf::Craft, yaw_deg: self.number("Camera:Yaw"), pitch_deg, roll_deg })
    }
}

/// Angles beyond a turn are no angles.
fn is_plausible(attitude: &AttitudePrior) -> bool {
    let is_angle = |degrees: f64| degrees.abs() <= 360.0;
    is_angle(attitude.pitch_deg) && is_angle(attitude.roll_deg) && attitude.yaw_deg.is_none_or(is_angle)
}

/// The element that properties belong to: the innermost that is no mere `rdf:Description`.
fn around(open: &[String]) -> &str {
    open.iter().rev().find(|name| *name != "rdf:Description").map_or("", String::as_str)
}

/// Where a tag ends, quotes respected.
fn tag_end(bytes: &[u8]) -> Option<usize> {
    let mut quote = None;
    bytes.iter().position(|&b| match quote {
        Some(open) => {
            if b == open {
                quote = None;
            }
            false
        }
        None => {
            if matches!(b, b'"' | b'\'') {
                quote = Some(b);
            }
            b == b'>'
        }
    })
}

/// A number or a fraction.
fn parse(text: &[u8]) -> Option<f64> {
    if text.len() > 64 {
        return None;
    }
    let text = std::str::from_utf8(text).ok()?.trim();
    let value = match text.split_once('/') {
        Some((above, below)) => above.trim().parse::<f64>().ok()? / below.trim().parse::<f64>().ok()?,
        None => text.parse::<f64>().ok()?,
    };
    value.is_finite().then_some(value)
}

fn position(bytes: &[u8], wanted: &[u8]) -> Option<usize> {
    bytes.windows(wanted.len()).position(|window| window == wanted)
}
