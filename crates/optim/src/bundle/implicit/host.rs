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

    /// Before [`PartRequest::Accept`]: the cameras that it accepts as numbers, from which a holder that joins later goes on.
    fn accepted(&mut self, cameras: Vec<f64>) {
        let _ = cameras;
    }

    /// Whether [`PartHost::accepted`] wants to know.
    fn wants_cameras(&self) -> bool {
        false
    }
}

/// Parts in this process.
pub struct LocalHost(pub PartWorker);

impl PartHost for LocalHost {
    fn ask(&mut self, request: &PartRequest) -> Result<Vec<Vec<f64>>, BundleError> {
        self.0.begin(request)?;
        Ok(self.0.answer(request, None)?.into_iter().map(|(_, answer)| answer).collect())
    }
}
