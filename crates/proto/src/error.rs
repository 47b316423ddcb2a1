//! The crate's one error.

use std::fmt;

/// Why a message or a connection was no good. Opaque; ask it with the predicates.
#[derive(Debug, thiserror::Error)]
#[error("{message}")]
pub struct ProtoError {
    kind: Kind,
    message: String,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Invalid,
    Unreachable,
    Refused,
    Version,
    NotFound,
}

impl ProtoError {
    pub(crate) fn invalid(path: impl fmt::Display, problem: impl fmt::Display) -> Self {
        Self { kind: Kind::Invalid, message: format!("{path}: {problem}") }
    }

    pub(crate) fn unreachable(message: impl Into<String>) -> Self {
        Self { kind: Kind::Unreachable, message: message.into() }
    }

    pub(crate) fn from_status(status: &tonic::Status) -> Self {
        use tonic::Code;
        let kind = match status.code() {
            Code::Unavailable | Code::Cancelled | Code::DeadlineExceeded | Code::Unknown => Kind::Unreachable,
            Code::InvalidArgument | Code::OutOfRange | Code::ResourceExhausted => Kind::Invalid,
            Code::FailedPrecondition => Kind::Version,
            Code::NotFound => Kind::NotFound,
            _ => Kind::Refused,
        };
        let text = if status.message().is_empty() { status.code().description() } else { status.message() };
        Self { kind, message: text.to_owned() }
    }

    /// The other side can't be reached now; it may be later.
    pub fn is_unreachable(&self) -> bool {
        self.kind == Kind::Unreachable
    }

    /// The message itself is no good: sending it again will not help.
    pub fn is_invalid_input(&self) -> bool {
        self.kind == Kind::Invalid
    }

    /// The two sides have no protocol version in common.
    pub fn is_version_mismatch(&self) -> bool {
        self.kind == Kind::Version
    }

    /// What was asked for doesn't exist.
    pub fn is_not_found(&self) -> bool {
        self.kind == Kind::NotFound
    }
}
