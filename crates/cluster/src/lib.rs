//! Coordinator, workers, clients and launchers.
//!
//! The coordinator's mind is [`state`]: a pure function from events to effects. [`coordinator`] is the thin shell around it: it
//! receives calls, keeps time, and carries effects out. [`worker`] asks for tasks and executes them; [`local`] starts worker
//! processes of this very binary. What a task is, only an [`engine::Engine`] knows: [`engine::PipelineEngine`] for photographs,
//! toy ones in tests. Clients use [`Client`]. [`adjustment`] is the one task with a state of its own: a solve on many processes.

pub mod adjustment;
pub mod coordinator;
pub mod engine;
mod error;
pub mod local;
mod meter;
pub mod state;
#[cfg(test)]
mod tests;
pub mod worker;

pub use error::{ClusterError, with_causes};
pub use terrane_proto::types;
pub use terrane_proto::{Client, Endpoint, ProtoError, Token};
