//! Prints the generated declarations: `trabecula_client_bindings c|python`.

use std::io::Write;
use std::process::ExitCode;

use trabecula_client::bindings;

fn main() -> ExitCode {
    let text = match std::env::args().nth(1).as_deref() {
        Some("c") => bindings::c_header(),
        Some("python") => bindings::python_module(),
        _ => {
            eprintln!("usage: trabecula_client_bindings c|python");
            return ExitCode::from(2);
        }
    };
    #[allow(clippy::disallowed_methods, reason = "standalone program")]
    let mut out = std::io::stdout();
    match out.write_all(text.as_bytes()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(cause) => {
            eprintln!("standard output: {cause}");
            ExitCode::FAILURE
        }
    }
}
