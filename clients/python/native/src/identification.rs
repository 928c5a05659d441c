//! Identification of a study; results as JSON.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use ::sim::SimError;
use ::sim::identification::OpenedStudy;
use pyo3::prelude::*;

use crate::failing::raised;

/// Time between two checks for Ctrl-C.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// Fits, checks or ranks a study and returns the result as JSON.
#[pyfunction]
pub(crate) fn identify(py: Python<'_>, study: PathBuf, task: &str) -> PyResult<String> {
    let ended = AtomicBool::new(false);
    let is_to_end = || ended.load(Ordering::Relaxed);
    let text = |error: serde_json::Error| SimError::SceneText(error.to_string());
    let work = || -> Result<String, SimError> {
        let study = OpenedStudy::open(&study)?;
        match task {
            "check" => serde_json::to_string(&study.check(&is_to_end)?).map_err(text),
            "design" => serde_json::to_string(&study.plan(&is_to_end)?).map_err(text),
            _ => serde_json::to_string(&study.identify(&is_to_end)?).map_err(text),
        }
    };
    py.detach(|| {
        std::thread::scope(|scope| {
            let thread = std::thread::Builder::new().name("identify".to_owned());
            let working = thread.spawn_scoped(scope, work)?;
            while !working.is_finished() {
                std::thread::sleep(LOOK_EVERY);
                if let Err(interrupt) = Python::attach(|py| py.check_signals()) {
                    ended.store(true, Ordering::Relaxed);
                    let _ = working.join();
                    return Err(interrupt);
                }
            }
            let done = working.join().unwrap_or(Err(SimError::Gone));
            done.map_err(|error| Python::attach(|py| raised(py, &error)))
        })
    })
}
