//! Cost of a step of each tool on each rung, at three step sizes: times alternating with a reference, and
//! instructions by valgrind.

use std::ffi::OsStr;
use std::hint::black_box;
use std::path::{Path, PathBuf};
use std::time::Instant;

use nalgebra::{Isometry3, Vector3};
use serde_json::{Value, json};
use simulation::manipulator::{
    AnyManipulator, BaseMotion, MAX_TENDONS, ManipulatorError, ManipulatorModel, ManipulatorParameters, Rung,
    StepInput, StepReport, TendonCommand, Wrench,
};
use trabecula::failure::Failure;
use trabecula::tool::response::built;

use super::samples::median;
use super::{callgrind, failed};
use crate::sheet::Sheet;
use crate::tools::tools;

/// Steps, ms.
const DT_MS: [f64; 3] = [0.5, 1.0, 2.0];
/// Steps before the measured ones, and measured steps.
const WARM_UP: usize = 100;
const STEPS: usize = 400;
/// Tension on tendon 0, N, and force across the burr as a fraction of the force that bends the tool by one
/// radian; both oscillate.
const TENSION_N: f64 = 3.0;
const ACROSS: f64 = 0.1;
const PERIOD_S: f64 = 0.1;

/// A tool on a rung at a step size.
struct Cell {
    tool: String,
    rung: Rung,
    dt_ms: f64,
    parameters: ManipulatorParameters,
    /// Time of a step in each round, ns.
    step_ns: Vec<f64>,
    /// Ratio to the reference in the same round.
    ratios: Vec<f64>,
    refused: Option<String>,
    instructions: Option<u64>,
}

impl Cell {
    fn new(tool: &str, rung: Rung, dt_ms: f64, parameters: &ManipulatorParameters) -> Cell {
        Cell {
            tool: tool.to_owned(),
            rung,
            dt_ms,
            parameters: parameters.clone(),
            step_ns: Vec::new(),
            ratios: Vec::new(),
            refused: None,
            instructions: None,
        }
    }

    /// Steps the tool from rest; returns the median time of a measured step, ns.
    fn play(&self) -> Result<f64, String> {
        let mut tool = built(self.rung, &self.parameters)?;
        let dt_s = self.dt_ms * 1e-3;
        let across_n = ACROSS * across_of_a_radian_n(&self.parameters);
        let mut took_ns = Vec::with_capacity(STEPS);
        for step in 0..WARM_UP + STEPS {
            let is_loaded = ((step as f64 * dt_s / PERIOD_S) as usize).is_multiple_of(2);
            let input = input(if is_loaded { 1.0 } else { 0.0 }, across_n);
            let began = Instant::now();
            let done =
                if step < WARM_UP { tool.step(dt_s, &input) } else { counted_step(&mut tool, dt_s, &input) };
            if step >= WARM_UP {
                took_ns.push(began.elapsed().as_nanos() as f64);
            }
            done.map_err(|cause| cause.to_string())?;
        }
        end_of_cell(self.dt_ms);
        Ok(median(&took_ns))
    }

    fn figures(&self) -> Value {
        let mut figures = json!({"tool": self.tool, "model": self.rung.name(), "dt_ms": self.dt_ms});
        if let Some(why) = &self.refused {
            figures["refused"] = json!(why);
        } else {
            figures["step_ns"] = json!(median(&self.step_ns));
            figures["ratio"] = json!(median(&self.ratios));
        }
        if let Some(count) = self.instructions {
            figures["instructions"] = json!(count);
        }
        figures
    }

    fn line(&self) -> String {
        let head = format!("{:<16} {:<18} {:>6}", self.tool, self.rung.name(), self.dt_ms);
        if let Some(why) = &self.refused {
            return format!("{head}  refused: {why}");
        }
        let counted = self.instructions.map_or(String::new(), |count| format!("{count:>13}"));
        format!("{head} {:>9.0} {:>7.2}{counted}", median(&self.step_ns), median(&self.ratios))
    }
}

/// The code counted by valgrind.
#[inline(never)]
fn counted_step(
    tool: &mut AnyManipulator,
    dt_s: f64,
    input: &StepInput<'_>,
) -> Result<StepReport, ManipulatorError> {
    tool.step(dt_s, input)
}

/// When it returns, valgrind dumps its counts and resets them.
#[inline(never)]
fn end_of_cell(dt_ms: f64) {
    black_box(dt_ms);
}

/// Returns the force across the burr that bends the tool by about one radian, N: linear theory of a
/// cantilever of hinges.
fn across_of_a_radian_n(p: &ManipulatorParameters) -> f64 {
    let burr_m = p.joint_positions_m.last().map_or(0.0, |last| last + p.tip_offset_m);
    let joints = p.joint_positions_m.iter().zip(&p.joint_stiffness_nm_per_rad);
    let rad_per_n: f64 = joints.map(|(at_m, k)| (burr_m - at_m) / k).sum();
    if rad_per_n > 0.0 { 1.0 / rad_per_n } else { 0.0 }
}

fn input(share: f64, across_n: f64) -> StepInput<'static> {
    let mut tensions_n = [0.0; MAX_TENDONS];
    tensions_n[0] = TENSION_N * share;
    StepInput {
        base: BaseMotion::at_rest(Isometry3::identity()),
        tendon: TendonCommand::EachForce(tensions_n),
        tip_wrench: Wrench { force_n: Vector3::x() * (across_n * share), ..Wrench::zero() },
        contacts: &[],
    }
}

/// Measures the tools of the files, or the shipped ones.
///
/// # Errors
/// A file that is not a tool (2); valgrind is not in the PATH, or fails.
pub fn run(files: &[PathBuf], rounds: usize, instructions: bool, sheet: &mut Sheet) -> Result<(), Failure> {
    let mut cells = Vec::new();
    for tool in tools(files)? {
        for rung in Rung::ALL {
            cells.extend(DT_MS.map(|dt_ms| Cell::new(&tool.name, rung, dt_ms, &tool.parameters)));
        }
    }
    let standard =
        tools(&[])?.into_iter().next().ok_or_else(|| Failure::failed("no shipped tool".to_owned()))?;
    let reference = Cell::new("reference", Rung::Planar, 1.0, &standard.parameters);
    for _ in 0..rounds {
        let reference_ns = reference.play().map_err(Failure::failed)?;
        for cell in cells.iter_mut().filter(|cell| cell.refused.is_none()) {
            match cell.play() {
                Ok(step_ns) => {
                    cell.step_ns.push(step_ns);
                    cell.ratios.push(step_ns / reference_ns);
                }
                Err(why) => cell.refused = Some(why),
            }
        }
    }
    if instructions {
        let counts = count(files)?;
        let measured = cells.iter_mut().filter(|cell| cell.refused.is_none());
        measured.zip(counts).for_each(|(cell, count)| cell.instructions = Some(count / STEPS as u64));
    }
    let counted = if instructions { " instructions" } else { "" };
    sheet.line(&format!("tool             model               dt_ms   step_ns   ratio{counted}"));
    for cell in &cells {
        sheet.line(&cell.line());
        sheet.push("cells", cell.figures());
    }
    Ok(())
}

/// Returns the instructions of all measured steps of each cell that is not refused, in order.
fn count(files: &[PathBuf]) -> Result<Vec<u64>, Failure> {
    let folder = tempfile::tempdir().map_err(failed)?;
    let options = ["--toggle-collect=*counted_step*", "--dump-after=*end_of_cell*"];
    let arguments = ["bench", "tools", "--rounds", "1", "--json"].map(OsStr::new).into_iter();
    let ran =
        callgrind::run(folder.path(), &options, arguments.chain(files.iter().map(|file| file.as_os_str())))?;
    if !ran.status.success() {
        return Err(callgrind::failure(&ran));
    }
    // The first is the reference.
    let counts: Vec<u64> =
        (2..).map_while(|part| summary(&folder.path().join(format!("callgrind.out.{part}")))).collect();
    let found: Value = serde_json::from_str(&ran.out).map_err(failed)?;
    let cells = found["cells"]
        .as_array()
        .map_or(0, |cells| cells.iter().filter(|cell| cell.get("refused").is_none()).count());
    if counts.len() == cells {
        return Ok(counts);
    }
    Err(Failure::failed(format!("valgrind counted {} of {cells} cells", counts.len())))
}

/// Returns the number of instructions in a file of callgrind, or `None` without such a file.
fn summary(file: &Path) -> Option<u64> {
    let text = std::fs::read_to_string(file).ok()?;
    let line =
        text.lines().find_map(|line| line.strip_prefix("summary:").or(line.strip_prefix("totals:")))?;
    line.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn a_rung_that_cannot_represent_a_tool_says_why_and_the_others_are_measured() {
        let two = tools(&[]).unwrap().into_iter().find(|tool| tool.name == "two_segments").unwrap();
        let cell = |rung| Cell::new(&two.name, rung, 1.0, &two.parameters);
        let why = cell(Rung::ConstantCurvature).play().unwrap_err();
        assert!(why.contains("tendon"), "{why}");
        assert!(cell(Rung::Planar).play().unwrap() > 0.0);
    }

    /// A lever of 2 m and 3 m on hinges of 5 and 7 N m/rad.
    #[test]
    fn the_force_of_a_radian_is_that_of_its_hinges() {
        let mut p = ManipulatorParameters::jhu_27();
        p.joint_positions_m = vec![1.0, 2.0];
        p.joint_stiffness_nm_per_rad = vec![7.0, 5.0];
        p.tip_offset_m = 2.0;
        assert!((across_of_a_radian_n(&p) - 1.0 / (3.0 / 7.0 + 2.0 / 5.0)).abs() < 1e-12);
    }
}
