//! From `exec` to the first tick and from the last tick to the exit: runs of the program itself, phase by
//! phase.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};

use ipc_types::clock::now_ns;
use serde_json::{Value, json};

use super::failed;
use super::samples::median;
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::machine::Machine;

/// Simulated length of each run.
const DURATION_S: &str = "0.2";
/// Whether the program finds its volume in the cache.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CacheState {
    /// Unchanged: the volume is there after the first round.
    AsItIs,
    /// Empty in each round.
    Empty,
}

/// Times of one run in seconds, with their names.
type Phases = Vec<(&'static str, f64)>;

/// Runs a scene in lockstep `rounds` times and prints each phase's minimum and median time.
///
/// # Errors
/// A run that fails.
pub fn run(scene: Option<&Path>, rounds: usize, cache: CacheState, sheet: &mut Sheet) -> Result<(), Failure> {
    let machine = Machine::watch();
    let all: Vec<Phases> = (0..rounds).map(|_| one(scene, cache)).collect::<Result<_, _>>()?;
    let state = if cache == CacheState::Empty { ", empty cache" } else { "" };
    sheet.line(&format!("{rounds} runs of {DURATION_S} s in lockstep, recorded{state}; ms, min (median)\n"));
    let names: Vec<&'static str> = all.first().into_iter().flatten().map(|(name, _)| *name).collect();
    for (index, name) in names.iter().enumerate() {
        let times_ms: Vec<f64> = all.iter().map(|phases| phases[index].1 * 1e3).collect();
        let least = times_ms.iter().copied().fold(f64::INFINITY, f64::min);
        let figures = json!({"least_ms": least, "median_ms": median(&times_ms), "rounds_ms": times_ms});
        sheet.row(name, &format!("{least:8.1} ({:.1})", median(&times_ms)), name, figures);
    }
    sheet.machine(&machine);
    Ok(())
}

fn one(scene: Option<&Path>, cache: CacheState) -> Result<Phases, Failure> {
    let folder = tempfile::tempdir().map_err(failed)?;
    // `trabecula` is next to this program; the parts are processes of the started program.
    let program = std::env::current_exe().map_err(failed)?.with_file_name("trabecula");
    let mut command = Command::new(program);
    command.arg("run").args(scene).args(["--mode", "lockstep", "--duration-s", DURATION_S, "--json", "-o"]);
    command.arg(folder.path().join("out")).stdin(Stdio::null()).stdout(Stdio::piped());
    if cache == CacheState::Empty {
        command.env("XDG_CACHE_HOME", folder.path().join("cache"));
    }
    let exec_ns = now_ns();
    let mut child = command.spawn().map_err(failed)?;
    let mut ended = None;
    for line in child.stdout.take().map(BufReader::new).into_iter().flat_map(BufRead::lines) {
        let line: Value = serde_json::from_str(&line.map_err(failed)?).map_err(failed)?;
        if line["phase"] == "ended" {
            ended = Some((now_ns(), line));
        }
    }
    let status = child.wait().map_err(failed)?;
    let exit_ns = now_ns();
    let (ended_ns, line) = ended.filter(|_| status.success()).ok_or_else(|| failed("the run failed"))?;
    let s = |from: u64, to: u64| to.saturating_sub(from) as f64 * 1e-9;
    let phase = |name: &str| line["summary"]["phases_s"][name].as_f64().unwrap_or(0.0);
    let began_ns = line["began_ns"].as_u64().unwrap_or(exec_ns);
    let inside_s: f64 = ["volume", "session", "connect", "ticks", "parts_end"].map(phase).iter().sum();
    let program_s = s(exec_ns, began_ns);
    let report_s = s(began_ns, ended_ns) - inside_s;
    let start_s = program_s + phase("volume") + phase("session") + phase("connect");
    let end_s = phase("parts_end") + report_s + s(ended_ns, exit_ns);
    Ok(vec![
        ("program, scene, folder", program_s),
        ("volume, check of the scene", phase("volume")),
        ("session, parts started", phase("session")),
        ("parts connected", phase("connect")),
        ("= from exec to the first tick", start_s),
        ("ticks, to the end of the physics", phase("ticks")),
        ("end of the other parts", phase("parts_end")),
        ("report", report_s),
        ("exit", s(ended_ns, exit_ns)),
        ("= from the end of the physics to the exit", end_s),
    ])
}
