//! The library is where `tests/processes/python.rs` installs it from, and is the module that Python looks
//! for.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

#[test]
fn the_library_exports_the_module() {
    let test = std::env::current_exe().unwrap();
    let library = test.parent().unwrap().join("libtrabecula_sim.so");
    let bytes = std::fs::read(&library).unwrap();
    let name = b"PyInit__sim\0";
    assert!(bytes.windows(name.len()).any(|window| window == name), "{}", library.display());
}
