//! The wire: generated gRPC messages, their conversion into terrane's own types, and the two ends of a connection.
//!
//! This is the only crate that names tonic and prost. A server implements [`WorkerCalls`] and [`ClientCalls`] over the types
//! of [`types`]; a client calls [`Client`]. The holders of an adjustment's parts have a [`Link`] of whole messages to its solver. Lengths and ranges are checked once, in the conversions, against [`limits`].

mod client;
mod convert;
mod error;
mod holders;
pub mod limits;
mod server;
#[cfg(test)]
mod tests;
mod token;
pub mod types;

#[rustfmt::skip]
#[path = "generated/v1.rs"]
#[allow(missing_docs, clippy::all)]
mod v1;

pub use client::{Client, Endpoint};
pub use error::ProtoError;
pub use holders::{Link, LinkReceiver, LinkSender, hold, serve_holders};
pub use server::{ClientCalls, Refusal, ServeOptions, WorkerCalls, serve};
pub use token::Token;

/// Lowest protocol version that this build speaks.
pub const PROTOCOL_MIN: u32 = 1;
/// Highest protocol version that this build speaks.
pub const PROTOCOL_MAX: u32 = 1;
