//! Counts the instructions of a physics step with valgrind: a figure unaffected by other load on the machine.

use std::ffi::OsString;

use serde_json::json;

use super::{callgrind, failed};
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::scenes::SceneSource;

/// Only instructions below this function are counted; [`super::step`] calls it for every step.
const COUNTED: &str = "*one_step*";

/// Runs `bench step SCENE --in-process` again under callgrind, and prints the mean over its ticks.
///
/// # Errors
/// valgrind is not in the PATH, or fails.
pub fn run(scene: &SceneSource, ticks: Option<u64>, sheet: &mut Sheet) -> Result<(), Failure> {
    let folder = tempfile::tempdir().map_err(failed)?;
    let mut arguments: Vec<OsString> = ["bench", "step"].map(OsString::from).into();
    arguments.extend(scene.argument().into_iter().map(OsString::from));
    arguments.push("--in-process".into());
    if let Some(ticks) = ticks {
        arguments.extend(["--ticks".to_owned(), ticks.to_string()].map(OsString::from));
    }
    let ran = callgrind::run(folder.path(), &[&format!("--toggle-collect={COUNTED}")], arguments)?;
    let counted = number_after(&ran.report, "Collected :");
    let steps = number_after(&ran.out, " us   (").filter(|_| ran.status.success());
    match (counted, steps) {
        (Some(counted), Some(steps)) if steps > 0 => {
            let mean = counted / steps;
            let figures = json!({"mean": mean, "steps": steps});
            sheet.row(
                "instructions per step, mean",
                &format!("{mean} ({steps} steps)"),
                "instructions",
                figures,
            );
            Ok(())
        }
        _ => Err(callgrind::failure(&ran)),
    }
}

/// Returns the first integer after a word; in the table of [`super::step`] the first bracket contains the
/// number of steps.
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
