//! Exit codes, and how a failure is told.

use std::process::ExitCode;

/// Why the program ends with something else than success.
#[derive(Debug)]
pub struct Failure {
    code: u8,
    message: String,
}

impl Failure {
    /// 1: it ran, and the result falls short of what was asked.
    pub fn short(message: impl Into<String>) -> Self {
        Self { code: 1, message: message.into() }
    }

    /// 2: usage or input is no good.
    pub fn input(message: impl Into<String>) -> Self {
        Self { code: 2, message: message.into() }
    }

    /// 3: storage or cluster failed.
    pub fn system(message: impl Into<String>) -> Self {
        Self { code: 3, message: message.into() }
    }

    /// 130: interrupted.
    pub fn interrupted() -> Self {
        Self { code: 130, message: "interrupted: run the same command again to go on".into() }
    }

    /// Tells the user; the code.
    pub fn tell(self, json: bool) -> u8 {
        if json {
            println!(
                "{}",
                serde_json::json!({ "event": "error", "code": self.code, "message": self.message })
            );
        } else {
            eprintln!("terrane: {}", self.message);
        }
        self.code
    }

    /// Tells the user, and gives the code to the system.
    pub fn report(self, json: bool) -> ExitCode {
        ExitCode::from(self.tell(json))
    }

    /// What is told.
    #[cfg(test)]
    pub fn message(&self) -> &str {
        &self.message
    }

    /// The code.
    #[cfg(test)]
    pub fn code(&self) -> u8 {
        self.code
    }
}

impl From<terrane_cluster::ClusterError> for Failure {
    fn from(error: terrane_cluster::ClusterError) -> Self {
        if error.is_invalid_input() {
            Self::input(error.to_string())
        } else {
            Self::system(error.to_string())
        }
    }
}

impl From<terrane_cluster::ProtoError> for Failure {
    fn from(error: terrane_cluster::ProtoError) -> Self {
        let usage = error.is_invalid_input() || error.is_not_found();
        if usage { Self::input(error.to_string()) } else { Self::system(error.to_string()) }
    }
}
