//! The wire: generated gRPC messages, their conversion into terrane's own types, and the two ends of a connection.
//!
//! This is the only crate that names tonic and prost. A server implements [`WorkerCalls`] and [`ClientCalls`] over the types
//! of [`types`]; a client calls [`Client`]. Lengths and ranges are checked once, in the conversions, against [`limits`].

mod client;
mod convert;
mod error;
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
pub use server::{ClientCalls, Refusal, ServeOptions, WorkerCalls, serve};
pub use token::Token;

/// Lowest protocol version that this build speaks.
pub const PROTOCOL_MIN: u32 = 1;
/// Highest protocol version that this build speaks.
pub const PROTOCOL_MAX: u32 = 1;
