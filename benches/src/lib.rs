//! Helpers shared by the benches: tables, JSON rows, peers.
