//! The secret that lets a peer in.

use std::fmt;
use std::io::Read;

use crate::ProtoError;

/// A shared secret, compared in constant time and never printed.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

impl Token {
    /// A token of 32 random bytes from the operating system, as hexadecimal digits.
    pub fn random() -> std::io::Result<Self> {
        let mut bytes = [0u8; 32];
        std::fs::File::open("/dev/urandom")?.read_exact(&mut bytes)?;
        Ok(Self(bytes.iter().map(|byte| format!("{byte:02x}")).collect()))
    }

    /// A token given by a person; 16 to 256 letters, digits, `-`, `_` or `.`.
    pub fn parse(text: &str) -> Result<Self, ProtoError> {
        let text = text.trim();
        if !(16..=256).contains(&text.len()) {
            return Err(ProtoError::invalid("token", "must have 16 to 256 characters"));
        }
        if !text.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte)) {
            return Err(ProtoError::invalid("token", "may hold letters, digits, '-', '_' and '.' only"));
        }
        Ok(Self(text.to_owned()))
    }

    /// The secret itself, to hand it to a child process.
    pub fn secret(&self) -> &str {
        &self.0
    }

    /// Whether `given` is this token; the time taken says nothing about where they differ.
    pub fn admits(&self, given: &[u8]) -> bool {
        let own = self.0.as_bytes();
        own.len() == given.len() && own.iter().zip(given).fold(0, |differs, (a, b)| differs | (a ^ b)) == 0
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(..)")
    }
}
