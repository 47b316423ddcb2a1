//! The stage graph, artefacts on an object store, and the execution of tasks.
