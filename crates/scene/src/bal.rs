//! Problems in the text format of "Bundle Adjustment in the Large" (Agarwal, Snavely, Seitz & Szeliski 2010).
//!
//! A header `cameras points observations`; lines `camera point x y`; nine numbers a camera (rotation vector, translation,
//! focal length, k1, k2); three a point. A camera looks down −z with y up, and the principal point is the origin of image
//! coordinates.

use std::io::{BufRead, Write};

use crate::SceneError;

/// One image point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BalObservation {
    /// Index of the camera.
    pub camera: u32,
    /// Index of the point.
    pub point: u32,
    /// Where it was seen: x to the right, y up, in pixels from the principal point.
    pub xy_px: [f32; 2],
}

/// The parameters of a problem.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BalProblem {
    /// Rotation vector, translation, focal length in pixels, k1, k2.
    pub cameras: Vec<[f64; 9]>,
    /// Points in the world's frame.
    pub points: Vec<[f64; 3]>,
    /// In the order of the file.
    pub observations: Vec<BalObservation>,
}

/// Entries that are made room for before they are seen: a header alone must not take memory.
const ROOM: usize = 1 << 20;

/// Reads a problem.
///
/// # Errors
/// Corrupt when the file is cut short, holds something else than finite numbers, or names a camera or point that is not
/// there; says which number of the file it was.
pub fn read(file: impl BufRead) -> Result<BalProblem, SceneError> {
    let mut words = Words { file, line: Vec::new(), at: 0, line_number: 0 };
    let cameras = words.count("number of cameras")?;
    let points = words.count("number of points")?;
    let observations = words.count("number of observations")?;
    let mut problem = BalProblem::default();
    problem.observations.reserve(observations.min(ROOM));
    for _ in 0..observations {
        let camera = words.index("camera of an observation", cameras)?;
        let point = words.index("point of an observation", points)?;
        let xy_px =
            [words.number("x of an observation")? as f32, words.number("y of an observation")? as f32];
        problem.observations.push(BalObservation { camera, point, xy_px });
    }
    problem.cameras.reserve(cameras.min(ROOM));
    for _ in 0..cameras {
        let mut camera = [0.0; 9];
        for value in &mut camera {
            *value = words.number("parameter of a camera")?;
        }
        problem.cameras.push(camera);
    }
    problem.points.reserve(points.min(ROOM));
    for _ in 0..points {
        let mut point = [0.0; 3];
        for value in &mut point {
            *value = words.number("coordinate of a point")?;
        }
        problem.points.push(point);
    }
    Ok(problem)
}

/// Writes new parameters under the header and observations of the file that they were read from, which stay as they are
/// to the last digit.
///
/// # Errors
/// When the original can't be read again or is cut short, or the new file can't be written.
pub fn write(
    original: impl BufRead,
    mut file: impl Write,
    cameras: &[[f64; 9]],
    points: &[[f64; 3]],
) -> Result<(), SceneError> {
    let mut words = Words { file: original, line: Vec::new(), at: 0, line_number: 0 };
    let counts = ["number of cameras", "number of points", "number of observations"];
    let mut observations = 0;
    for (at, what) in counts.into_iter().enumerate() {
        observations = words.count(what)?;
        write!(file, "{observations}{}", if at < 2 { " " } else { "\n" })?;
    }
    for _ in 0..observations {
        for at in 0..4 {
            let word = words.next("an observation")?;
            file.write_all(word)?;
            file.write_all(if at < 3 { b" " } else { b"\n" })?;
        }
    }
    for value in cameras.iter().flatten().chain(points.iter().flatten()) {
        writeln!(file, "{value:?}")?;
    }
    file.flush()?;
    Ok(())
}

/// The words of a text file, one after another.
struct Words<R> {
    file: R,
    line: Vec<u8>,
    at: usize,
    line_number: u64,
}

/// Bytes of a line at most.
const LINE_BYTES: u64 = 1 << 20;

impl<R: BufRead> Words<R> {
    fn next(&mut self, what: &str) -> Result<&[u8], SceneError> {
        loop {
            let rest = &self.line[self.at..];
            if let Some(start) = rest.iter().position(|byte| !byte.is_ascii_whitespace()) {
                let word = &rest[start..];
                let len = word.iter().position(u8::is_ascii_whitespace).unwrap_or(word.len());
                let first = self.at + start;
                self.at = first + len;
                return Ok(&self.line[first..first + len]);
            }
            self.line.clear();
            self.at = 0;
            self.line_number += 1;
            let read = std::io::Read::take(&mut self.file, LINE_BYTES).read_until(b'\n', &mut self.line)?;
            if read == 0 {
                return Err(SceneError::corrupt(format!(
                    "the file ends in line {} where the {what} should be: it was cut short, or its header counts more than it holds",
                    self.line_number
                )));
            }
        }
    }

    fn parse<T: std::str::FromStr>(&mut self, what: &str) -> Result<T, SceneError> {
        let word = self.next(what)?;
        let parsed = std::str::from_utf8(word).ok().and_then(|text| text.parse().ok());
        parsed.ok_or_else(|| self.wrong(what))
    }

    fn wrong(&self, what: &str) -> SceneError {
        let word = self.line[..self.at].split(u8::is_ascii_whitespace).next_back().unwrap_or_default();
        let shown: String = String::from_utf8_lossy(word).chars().take(40).collect();
        let hint = if shown.starts_with("BZh") { "; unpack it first (bunzip2)" } else { "" };
        SceneError::corrupt(format!("line {}: `{shown}` can't be the {what}{hint}", self.line_number))
    }

    fn count(&mut self, what: &str) -> Result<usize, SceneError> {
        Ok(self.parse::<u32>(what)? as usize)
    }

    fn index(&mut self, what: &str, count: usize) -> Result<u32, SceneError> {
        let index: u32 = self.parse(what)?;
        if (index as usize) < count {
            return Ok(index);
        }
        Err(SceneError::corrupt(format!(
            "line {}: {index} can't be the {what}: there are {count}",
            self.line_number
        )))
    }

    fn number(&mut self, what: &str) -> Result<f64, SceneError> {
        let value: f64 = self.parse(what)?;
        if value.is_finite() { Ok(value) } else { Err(self.wrong(what)) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "2 1 2\n0 0 1.5 -2.25\n1 0 3e0 4\n0.1\n0.2\n0.3\n1\n2\n3\n500\n-1e-7\n1e-13\n0 0 0 0 0 -1 400 0 0\n7\n8\n9.5\n";

    #[test]
    fn problems_are_read_and_written_back() {
        let problem = read(TEXT.as_bytes()).unwrap();
        assert_eq!(problem.observations[1], BalObservation { camera: 1, point: 0, xy_px: [3.0, 4.0] });
        assert_eq!(problem.cameras[0], [0.1, 0.2, 0.3, 1.0, 2.0, 3.0, 500.0, -1e-7, 1e-13]);
        assert_eq!(problem.points, [[7.0, 8.0, 9.5]]);
        let mut written = Vec::new();
        write(TEXT.as_bytes(), &mut written, &problem.cameras, &problem.points).unwrap();
        assert!(
            String::from_utf8(written.clone()).unwrap().starts_with("2 1 2\n0 0 1.5 -2.25\n1 0 3e0 4\n0.1\n")
        );
        assert_eq!(read(written.as_slice()).unwrap(), problem);
    }

    #[test]
    fn bad_files_are_named() {
        let cases = [
            ("", "line 1"),
            ("2 1\n", "number of observations"),
            ("2 1 99\n0 0 1 2\n", "cut short"),
            ("1 1 1\n1 0 1 2\n", "there are 1"),
            ("1 1 1\n0 7 1 2\n", "there are 1"),
            ("1 1 1\n0 0 nan 2\n", "line 2: `nan`"),
            ("1 1 1\n0 -1 1 2\n", "`-1`"),
            ("4294967295 4294967295 4294967295\n", "cut short"),
            ("BZh91AY&SY\u{1} x", "bunzip2"),
        ];
        for (text, expected) in cases {
            let message = read(text.as_bytes()).unwrap_err().to_string();
            assert!(message.contains(expected), "{text:?}: {message}");
        }
        for end in 0..TEXT.len() - 4 {
            let _ = read(&TEXT.as_bytes()[..end]).map(|_| panic!("cut at {end} is read"));
        }
    }

    #[test]
    fn flipped_bytes_never_panic() {
        for at in 0..TEXT.len() {
            for flip in [1, 8, 0x10, 0x80, 0xff] {
                let mut bytes = TEXT.as_bytes().to_vec();
                bytes[at] ^= flip;
                if let Ok(problem) = read(bytes.as_slice()) {
                    let finite = problem.cameras.iter().flatten().chain(problem.points.iter().flatten());
                    assert!(finite.into_iter().all(|v| v.is_finite()));
                }
            }
        }
    }
}
