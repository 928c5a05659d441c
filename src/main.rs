//! `trabecula`: launches, watches, records and replays image-guided bone drilling across processes.

use std::process::ExitCode;

fn main() -> ExitCode {
    trabecula::cli::main()
}
