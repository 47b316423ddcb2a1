//! Coordinator, workers, clients and launchers.
