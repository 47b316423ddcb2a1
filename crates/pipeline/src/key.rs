//! Names of artefacts: the hash of everything that decides their bytes.

use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::{PipelineError, Stage};

/// The name of an artefact: its stage and the BLAKE3 hash of (stage, stage version, options read, input keys).
///
/// Written as `stage/64 hexadecimal digits`.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct ArtefactKey {
    stage: Stage,
    hash: [u8; 32],
}

impl ArtefactKey {
    /// The stage that makes it.
    pub fn stage(&self) -> Stage {
        self.stage
    }

    /// The hash in hexadecimal.
    pub fn hex(&self) -> String {
        hex(&self.hash)
    }

    /// Where it lies in a store: `artefacts/<stage>/<hash>`.
    pub fn path(&self) -> String {
        format!("artefacts/{self}")
    }

    /// The key of a path as [`ArtefactKey::path`] gives it, or `None` for any other path.
    pub fn from_path(path: &str) -> Option<Self> {
        path.strip_prefix("artefacts/")?.parse().ok()
    }
}

impl std::fmt::Display for ArtefactKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.stage, self.hex())
    }
}

impl std::fmt::Debug for ArtefactKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{self}")
    }
}

impl FromStr for ArtefactKey {
    type Err = PipelineError;

    fn from_str(text: &str) -> Result<Self, PipelineError> {
        let bad =
            || PipelineError::invalid_input(format!("`{text}` is no artefact key: expected stage/hash"));
        let (stage, digits) = text.split_once('/').ok_or_else(bad)?;
        let stage = Stage::from_name(stage).ok_or_else(bad)?;
        if digits.len() != 64 || !digits.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b)) {
            return Err(bad());
        }
        let mut hash = [0u8; 32];
        for (byte, pair) in hash.iter_mut().zip(digits.as_bytes().chunks_exact(2)) {
            let pair = std::str::from_utf8(pair).map_err(|_| bad())?;
            *byte = u8::from_str_radix(pair, 16).map_err(|_| bad())?;
        }
        Ok(Self { stage, hash })
    }
}

impl Serialize for ArtefactKey {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for ArtefactKey {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

/// Collects what decides an artefact's bytes. Every part is preceded by its length, so that parts never run together.
pub struct KeyBuilder {
    stage: Stage,
    hasher: blake3::Hasher,
}

impl KeyBuilder {
    /// Begins the key of an artefact of a stage, at the stage's version.
    pub fn new(stage: Stage) -> Self {
        let mut hasher = blake3::Hasher::new();
        hasher.update(b"terrane artefact 1");
        let builder = Self { stage, hasher };
        builder.bytes(stage.name().as_bytes()).number(u64::from(stage.version()))
    }

    /// Adds bytes.
    pub fn bytes(mut self, bytes: &[u8]) -> Self {
        self.hasher.update(&(bytes.len() as u64).to_le_bytes());
        self.hasher.update(bytes);
        self
    }

    /// Adds a number.
    pub fn number(self, number: u64) -> Self {
        self.bytes(&number.to_le_bytes())
    }

    /// Adds options or another value in its canonical encoding: JSON with fields in the order of their declaration.
    ///
    /// # Errors
    /// When the value can't be written as JSON: a bug of its type.
    pub fn value<T: Serialize + ?Sized>(self, value: &T) -> Result<Self, PipelineError> {
        let json = serde_json::to_vec(value).map_err(|error| {
            PipelineError::bug(format!("the options of {} can't be encoded: {error}", self.stage))
        })?;
        Ok(self.bytes(&json))
    }

    /// Adds the key of an input.
    pub fn input(self, key: &ArtefactKey) -> Self {
        self.bytes(key.stage.name().as_bytes()).bytes(&key.hash)
    }

    /// Adds the keys of inputs, in order.
    pub fn inputs<'a>(self, keys: impl IntoIterator<Item = &'a ArtefactKey>) -> Self {
        keys.into_iter().fold(self, KeyBuilder::input)
    }

    /// The key.
    pub fn finish(self) -> ArtefactKey {
        ArtefactKey { stage: self.stage, hash: *self.hasher.finalize().as_bytes() }
    }
}

/// Bytes in hexadecimal, lower case.
pub(crate) fn hex(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 16] = b"0123456789abcdef";
    bytes
        .iter()
        .flat_map(|b| [DIGITS[usize::from(b >> 4)], DIGITS[usize::from(b & 15)]])
        .map(char::from)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_survives_its_text_and_its_path() {
        let key = KeyBuilder::new(Stage::Submap).number(7).finish();
        assert_eq!(key.to_string().parse::<ArtefactKey>().unwrap(), key);
        assert_eq!(ArtefactKey::from_path(&key.path()), Some(key));
        let json = serde_json::to_string(&key).unwrap();
        assert_eq!(serde_json::from_str::<ArtefactKey>(&json).unwrap(), key);
    }

    #[test]
    fn parts_do_not_run_together() {
        let a = KeyBuilder::new(Stage::Pairs).bytes(b"ab").bytes(b"c").finish();
        let b = KeyBuilder::new(Stage::Pairs).bytes(b"a").bytes(b"bc").finish();
        let c = KeyBuilder::new(Stage::Match).bytes(b"ab").bytes(b"c").finish();
        assert!(a != b && a.hex() != c.hex());
    }

    #[test]
    fn texts_that_are_no_keys_are_refused() {
        for text in ["", "submap", "submap/", "nothing/00", "../etc", &format!("submap/{}", "G".repeat(64))] {
            assert!(text.parse::<ArtefactKey>().is_err(), "{text}");
        }
    }
}
