//! The generated declarations in the repository match this build.

use std::path::Path;

use trabecula_client::bindings;

fn assert_current(file: &str, language: &str, generated: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(file);
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    let path = path.display();
    assert!(
        committed == generated,
        "{path} is not what is generated: target/release/trabecula_client_bindings {language} > {path}"
    );
}

#[test]
fn the_c_header_is_current() {
    assert_current("include/trabecula.h", "c", &bindings::c_header());
}

#[test]
fn the_python_module_is_current() {
    assert_current("../python/trabecula/_generated.py", "python", &bindings::python_module());
}
