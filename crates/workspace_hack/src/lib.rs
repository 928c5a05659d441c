//! Gives every crate of the workspace the same features of its dependencies, so that every command shares one
//! build of them.
//!
//! Cargo enables for a dependency the features that the selected packages ask for. `cargo test -p hub` and
//! `cargo run` selected different ones for serde, and so built serde and everything on top of it twice. Every
//! crate of the workspace depends on this one, which has no code and asks for all of the features at once.
//! `tests/crates.rs` checks that no command is left out, and prints the line to add or change in `Cargo.toml`
//! here.
