//! Camera positions for maps: GeoJSON (RFC 7946) and KML 2.3.

use std::io::Write;

use serde_json::json;

use crate::SceneError;

/// Where a camera is, for a map.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraPosition {
    /// Path of the photograph.
    pub name: String,
    /// Component that it is in.
    pub component: u32,
    /// Position in the model's frame.
    pub x_in_world: [f64; 3],
    /// Longitude and latitude in degrees on WGS 84 and height in metres, when the model is geo-referenced.
    pub lon_lat_height: Option<[f64; 3]>,
    /// Camera minus satellite position in metres (east, north, up), when the photograph has one.
    pub gps_residual_m: Option<[f64; 3]>,
}

/// Writes positions as GeoJSON, a feature a line. Heights are in the datum that `height_datum` names. Without a
/// geo-reference the features have no geometry, which the format allows, and `frame` of the collection says `local`:
/// local metres are never passed off as degrees.
///
/// # Errors
/// When the file can't be written.
pub fn write_geojson<W: Write>(
    positions: &[CameraPosition],
    height_datum: &str,
    mut out: W,
) -> Result<(), SceneError> {
    let geographic = positions.iter().any(|position| position.lon_lat_height.is_some());
    let frame = if geographic { "WGS 84 longitude, latitude" } else { "local" };
    writeln!(out, "{{\"type\": \"FeatureCollection\",")?;
    writeln!(out, "\"terrane\": {},", json!({ "frame": frame, "height_datum": height_datum }))?;
    writeln!(out, "\"features\": [")?;
    for (at, position) in positions.iter().enumerate() {
        let geometry = position.lon_lat_height.map(|at| json!({ "type": "Point", "coordinates": at }));
        let feature = json!({
            "type": "Feature",
            "geometry": geometry,
            "properties": {
                "image": position.name,
                "component": position.component,
                "x_in_world": position.x_in_world,
                "gps_residual_m": position.gps_residual_m,
            },
        });
        writeln!(out, "{feature}{}", if at + 1 < positions.len() { "," } else { "" })?;
    }
    writeln!(out, "]}}")?;
    Ok(out.flush()?)
}

/// Writes the positions that are on the globe as KML placemarks.
///
/// # Errors
/// When no position is geo-referenced (KML has no local frames), or the file can't be written.
pub fn write_kml<W: Write>(positions: &[CameraPosition], mut out: W) -> Result<(), SceneError> {
    if !positions.iter().any(|position| position.lon_lat_height.is_some()) {
        return Err(SceneError::invalid(
            "kml needs a geo-referenced run: these photographs have no usable positions; choose geojson or ply",
        ));
    }
    writeln!(out, "<?xml version=\"1.0\" encoding=\"UTF-8\"?>")?;
    writeln!(out, "<kml xmlns=\"http://www.opengis.net/kml/2.2\"><Document><name>cameras</name>")?;
    for position in positions {
        let Some([longitude, latitude, height_m]) = position.lon_lat_height else { continue };
        writeln!(
            out,
            "<Placemark><name>{}</name><Point><altitudeMode>absolute</altitudeMode><coordinates>{longitude},{latitude},{height_m}</coordinates></Point></Placemark>",
            escape_xml(&position.name)
        )?;
    }
    writeln!(out, "</Document></kml>")?;
    Ok(out.flush()?)
}

fn escape_xml(text: &str) -> String {
    let allowed = |c: &char| !c.is_control() || matches!(c, '\t' | '\n' | '\r');
    text.chars().filter(allowed).fold(String::new(), |mut escaped, c| {
        match c {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            _ => escaped.push(c),
        }
        escaped
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn position(lon_lat_height: Option<[f64; 3]>) -> CameraPosition {
        CameraPosition {
            name: "a & \"b\" <c>.jpg".to_owned(),
            component: 0,
            x_in_world: [1.0, 2.0, 3.0],
            lon_lat_height,
            gps_residual_m: Some([0.1, 0.2, 0.3]),
        }
    }

    #[test]
    fn geojson_is_json_with_and_without_a_globe() {
        for place in [Some([-83.5, 41.25, 200.0]), None] {
            let mut bytes = Vec::new();
            write_geojson(&[position(place), position(place)], "unknown", &mut bytes).unwrap();
            let value: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
            assert_eq!(value["features"].as_array().unwrap().len(), 2);
            assert_eq!(value["features"][0]["geometry"].is_null(), place.is_none());
        }
        let mut empty = Vec::new();
        write_geojson(&[], "unknown", &mut empty).unwrap();
        serde_json::from_slice::<serde_json::Value>(&empty).unwrap();
    }

    #[test]
    fn kml_escapes_names_and_needs_a_globe() {
        let mut bytes = Vec::new();
        write_kml(&[position(Some([1.0, 2.0, 3.0]))], &mut bytes).unwrap();
        let text = String::from_utf8(bytes).unwrap();
        assert!(text.contains("a &amp; &quot;b&quot; &lt;c&gt;.jpg") && text.contains("1,2,3"));
        assert!(write_kml(&[position(None)], Vec::new()).is_err());
    }
}
