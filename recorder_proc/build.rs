//! Tells the crate which target and compiler it is built with: both go into every log's header.

use std::process::Command;

fn main() {
    let target = std::env::var("TARGET").unwrap_or_default();
    let compiler = std::env::var("RUSTC").unwrap_or_else(|_| "rustc".to_string());
    let version = Command::new(compiler).arg("--version").output();
    let version = version.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_string());
    println!("cargo::rustc-env=TRABECULA_TARGET={target}");
    println!("cargo::rustc-env=TRABECULA_RUSTC={}", version.unwrap_or_default());
    println!("cargo::rerun-if-changed=build.rs");
}
