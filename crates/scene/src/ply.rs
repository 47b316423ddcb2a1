//! Points with colour as PLY (Turk 1994), binary little-endian.

use std::io::Write;

use crate::{Model, SceneError};

/// Writes the points of a model: x, y, z as doubles, in the model's frame, and red, green, blue. `comment` says which
/// frame that is; line breaks in it become spaces.
///
/// # Errors
/// When a shard can't be read or the file can't be written.
pub fn write<W: Write>(model: &dyn Model, comment: &str, mut out: W) -> Result<(), SceneError> {
    let mut num_points = 0u64;
    for shard in 0..model.num_shards() {
        num_points += model.shard(shard)?.points.len() as u64;
    }
    let comment = comment.replace(['\n', '\r'], " ");
    write!(out, "ply\nformat binary_little_endian 1.0\ncomment {comment}\nelement vertex {num_points}\n")?;
    write!(out, "property double x\nproperty double y\nproperty double z\n")?;
    write!(out, "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n")?;
    for shard in 0..model.num_shards() {
        for point in &model.shard(shard)?.points {
            for value in point.x_in_world.iter() {
                out.write_all(&value.to_le_bytes())?;
            }
            out.write_all(&point.color)?;
        }
    }
    Ok(out.flush()?)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use crate::Reconstruction;

    #[test]
    fn a_point_is_27_bytes_after_the_header() {
        let mut model = Reconstruction::default();
        model.push_point(Vector3::new(1.0, 2.0, 3.5), [9, 8, 7], &[]);
        let mut bytes = Vec::new();
        super::write(&model, "local\nframe", &mut bytes).unwrap();
        let header_len = bytes.len() - 27;
        let header = std::str::from_utf8(&bytes[..header_len]).unwrap();
        assert!(header.ends_with("end_header\n") && header.contains("element vertex 1\n"));
        assert!(header.contains("comment local frame\n"));
        assert_eq!(bytes[header_len + 16..header_len + 24], 3.5f64.to_le_bytes());
        assert_eq!(bytes[header_len + 24..], [9, 8, 7]);
    }
}
