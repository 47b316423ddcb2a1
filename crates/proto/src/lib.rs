//! Generated gRPC messages and their conversion into terrane's own types.
