//! Where parts are held.

use super::super::BundleError;
use super::worker::{PartRequest, PartWorker};

/// Whoever holds all parts of a problem, on this machine or on many.
pub trait PartHost {
    /// Asks every part; the answers by part, whoever gave them.
    ///
    /// # Errors
    /// When a part can't be reached and nobody else can take it over.
    fn ask(&mut self, request: &PartRequest) -> Result<Vec<Vec<f64>>, BundleError>;
}

/// Parts in this process.
pub struct LocalHost(pub PartWorker);

impl PartHost for LocalHost {
    fn ask(&mut self, request: &PartRequest) -> Result<Vec<Vec<f64>>, BundleError> {
        Ok(self.0.answer(request).into_iter().map(|(_, answer)| answer).collect())
    }
}
