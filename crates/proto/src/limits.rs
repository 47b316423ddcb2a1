//! How large messages and their parts may be. A message beyond a limit is refused as a whole, with the field's path.

/// Bytes of one message on the wire; tonic's own default for receiving, set on both ends.
pub const MESSAGE_BYTES: usize = 4 << 20;
/// Bytes of a run's description or of a task's specification.
pub const DESCRIPTION_BYTES: usize = 3 << 20;
/// Bytes of a task's report.
pub const REPORT_BYTES: usize = 1 << 20;
/// Bytes of a name, a stage or an item.
pub const NAME_BYTES: usize = 512;
/// Bytes of a reason or a line of the log.
pub const TEXT_BYTES: usize = 16 << 10;
/// Characters of an artefact's key.
pub const KEY_CHARS: usize = 128;
/// Leases in one message.
pub const LEASES: usize = 4096;
/// Rows of a table in a reply.
pub const ROWS: usize = 100_000;
/// Threads and slots of a worker.
pub const THREADS: u32 = 65_536;
/// Bytes of one frame of a holder's message.
pub const FRAME_BYTES: usize = 1 << 20;
/// Bytes of a holder's message when its frames are put together.
pub const HOLDER_MESSAGE_BYTES: usize = 1 << 30;
