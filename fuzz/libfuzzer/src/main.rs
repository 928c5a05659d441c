//! Runs one target of `trabecula_fuzz` under libFuzzer. `FUZZ_TARGET` selects it; `fuzz/run` sets that and
//! the limits.
#![no_main]

use std::path::PathBuf;
use std::sync::OnceLock;

use trabecula_fuzz::{TARGETS, Target};

static TARGET: OnceLock<&Target> = OnceLock::new();

libfuzzer_sys::fuzz_target!(
    init: {
        let wanted = std::env::var("FUZZ_TARGET").unwrap_or_default();
        let Some(target) = TARGETS.iter().find(|target| target.name == wanted) else {
            let names: Vec<&str> = TARGETS.iter().map(|target| target.name).collect();
            eprintln!("FUZZ_TARGET is `{wanted}`, expected one of: {}", names.join(", "));
            std::process::exit(2);
        };
        // Write the seeds before libFuzzer reads its folders, because this may be one of them.
        if let Some(folder) = std::env::var_os("FUZZ_SEEDS").map(PathBuf::from) {
            for (number, seed) in (target.seeds)().iter().enumerate() {
                let path = folder.join(format!("seed_{number:02}"));
                if let Err(cause) = std::fs::write(&path, seed) {
                    eprintln!("{}: cannot be written ({cause})", path.display());
                    std::process::exit(2);
                }
            }
        }
        let _ = TARGET.set(target);
    },
    |data: &[u8]| {
        if let Some(target) = TARGET.get() {
            (target.run)(data);
        }
    }
);
