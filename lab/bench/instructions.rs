//! Counts the instructions of a physics step with valgrind: a figure that other load on the machine does not change.

use std::process::Command;

use serde_json::json;

use super::failed;
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::scenes::SceneSource;

/// Only instructions below this function are counted; [`super::step`] calls it for every step.
const COUNTED: &str = "*one_step*";

/// Runs `bench step SCENE --in-process` again under callgrind, and prints the mean over its ticks.
///
/// # Errors
/// valgrind is not on the path, or fails.
pub fn run(scene: &SceneSource, ticks: Option<u64>, sheet: &mut Sheet) -> Result<(), Failure> {
    let program = std::env::current_exe().map_err(failed)?;
    let folder = tempfile::tempdir().map_err(failed)?;
    let mut valgrind = Command::new("valgrind");
    valgrind
        .args(["--tool=callgrind", &format!("--toggle-collect={COUNTED}")])
        .arg(format!("--callgrind-out-file={}", folder.path().join("callgrind.out").display()))
        .arg(program)
        .args(["bench", "step"])
        .args(scene.argument())
        .arg("--in-process");
    if let Some(ticks) = ticks {
        valgrind.args(["--ticks", &ticks.to_string()]);
    }
    let output = valgrind.output().map_err(|cause| {
        Failure::failed(format!("valgrind: {cause}; --instructions needs it (Debian package `valgrind`)"))
    })?;
    let (table, report) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    let counted = number_after(&report, "Collected :");
    let steps = number_after(&table, " us   (").filter(|_| output.status.success());
    match (counted, steps) {
        (Some(counted), Some(steps)) if steps > 0 => {
            let mean = counted / steps;
            let figures = json!({"mean": mean, "steps": steps});
            sheet.row(
                "instructions a step, mean",
                &format!("{mean} ({steps} steps)"),
                "instructions",
                figures,
            );
            Ok(())
        }
        _ => Err(Failure::failed(format!("valgrind ended with {}: {}", output.status, report.trim()))),
    }
}

/// The first whole number after a word; in the table of [`super::step`] the first bracket holds the number of steps.
fn number_after(text: &str, word: &str) -> Option<u64> {
    let behind = text.split_once(word)?.1;
    behind.split(|c: char| !c.is_ascii_digit()).find(|digits| !digits.is_empty())?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_is_read_behind_its_word() {
        assert_eq!(number_after("==12== Collected : 345\n==12==", "Collected :"), Some(345));
        assert_eq!(number_after("p50 1.2  p99.9 3.4 us   (6000 samples)", " us   ("), Some(6000));
        assert_eq!(number_after("no samples", " us   ("), None);
    }
}
