//! `trabecula-lab chart stability --tools`: the map's cases with other tools, as described by their files.

use std::path::PathBuf;

use nalgebra::Isometry3;
use rayon::prelude::*;
use serde_json::{Value, json};
use simulation::manipulator::{
    AnyManipulator, BaseMotion, Integrator, ManipulatorError, ManipulatorModel, ManipulatorParameters, Rung,
};
use trabecula::failure::Failure;
use trabecula::tool::response::built;

use super::cases::{Case, Setup};
use super::{DT_MS, Progress, REFERENCE_DT_MS, Verdict, reference_of, verdict};
use crate::charts::method::Method;
use crate::effort::Effort;
use crate::sheet::Sheet;
use crate::tools::{NamedTool, tools};

/// Result of a tool at a step size.
#[derive(Debug, Clone, Copy)]
struct Run {
    case: Case,
    dt_ms: f64,
    verdict: Verdict,
    off_m: f64,
    energy_grew: bool,
}

/// A tool with one of our methods.
struct Row {
    tool: String,
    method: Method,
    refused: Option<String>,
    runs: Vec<Run>,
}

impl Row {
    fn right(&self, dt_ms: f64) -> (usize, usize) {
        let own = self.runs.iter().filter(|run| run.case.is_claimed() && run.dt_ms == dt_ms);
        let right = own.clone().filter(|run| run.verdict == Verdict::Converged).count();
        (right, own.count())
    }

    fn line(&self, steps: &[f64]) -> String {
        let head = format!("{:<16} {:<18}", self.tool, self.method.name());
        if let Some(why) = &self.refused {
            return format!("{head}  refused: {why}");
        }
        let mut line = head;
        for dt_ms in steps {
            let (right, count) = self.right(*dt_ms);
            line.push_str(&format!(" {:>8}", format!("{right} of {count}")));
        }
        let far = self.runs.iter().filter(|run| !run.case.is_claimed());
        let right = far.clone().filter(|run| run.verdict == Verdict::Converged).count();
        let blown = self.runs.iter().filter(|run| run.verdict == Verdict::Blown).count();
        let grew = self.runs.iter().filter(|run| run.case.is_claimed() && run.energy_grew).count();
        line.push_str(&format!("  {blown:>5} {grew:>11}  {right} of {}", far.count()));
        line
    }

    fn figures(&self) -> Value {
        let runs: Vec<Value> = self
            .runs
            .iter()
            .map(|run| {
                json!({
                    "case": run.case.key(), "dt_ms": run.dt_ms,
                    "verdict": format!("{:?}", run.verdict).to_lowercase(),
                    "off_mm": run.off_m * 1e3, "energy_grew": run.energy_grew,
                })
            })
            .collect();
        match &self.refused {
            Some(why) => json!({"tool": self.tool, "method": self.method.name(), "refused": why}),
            None => json!({"tool": self.tool, "method": self.method.name(), "runs": runs}),
        }
    }
}

/// Runs the cases with the tools of the files, or the shipped ones; prints how many end correctly, and which
/// do not.
///
/// # Errors
/// A file that is not a tool (2).
pub fn run(files: &[PathBuf], effort: Effort, sheet: &mut Sheet) -> Result<(), Failure> {
    let steps = if effort == Effort::Quick { vec![DT_MS[0], DT_MS[4]] } else { DT_MS.to_vec() };
    let tools = tools(files)?;
    let methods: Vec<Method> = Method::ALL.into_iter().filter(|method| method.is_ours()).collect();
    let jobs: Vec<(&NamedTool, Method)> =
        tools.iter().flat_map(|tool| methods.iter().map(move |method| (tool, *method))).collect();
    let progress = Progress::new(jobs.len() * Case::ALL.len());
    let rows = jobs.par_iter().map(|(tool, method)| row(tool, *method, &steps, &progress));
    let rows: Vec<Row> = rows
        .collect::<Result<_, ManipulatorError>>()
        .map_err(|cause| Failure::bad_input(cause.to_string()))?;
    let head: String = steps.iter().map(|dt_ms| format!(" {:>8}", format!("{dt_ms} ms"))).collect();
    sheet.line(&format!("{:<16} {:<18}{head}  blown energy grew  2.3 x Euler's load", "tool", "method"));
    for row in &rows {
        sheet.line(&row.line(&steps));
        sheet.push("rows", row.figures());
    }
    for row in &rows {
        for run in row.runs.iter().filter(|run| run.case.is_claimed() && run.verdict != Verdict::Converged) {
            let (name, method, case) = (&row.tool, row.method.name(), run.case.key());
            let what = if run.verdict == Verdict::Blown { "blown" } else { "wrong" };
            sheet.line(&format!(
                "{what}: {name}, {method}, {case}, {} ms: {:.3} mm off",
                run.dt_ms,
                run.off_m * 1e3
            ));
        }
    }
    Ok(())
}

fn row(
    tool: &NamedTool,
    method: Method,
    steps: &[f64],
    progress: &Progress,
) -> Result<Row, ManipulatorError> {
    let mut row = Row { tool: tool.name.clone(), method, refused: None, runs: Vec::new() };
    let p = quiet(&tool.parameters);
    if let Method::Rung(rung, _) = method
        && let Err(why) = built(rung, &p)
    {
        row.refused = Some(why);
        return Ok(row);
    }
    let (setup, reference_dt_ms) = (Setup::of(&p)?, reference_dt_ms(&p)?);
    for case in Case::ALL.into_iter().filter(|case| case.fits(&p)) {
        let converged = case.play(reference_of(method), &p, &setup, 1.0, reference_dt_ms)?.tip_m;
        for &dt_ms in steps {
            let ending = case.play(method, &p, &setup, 1.0, dt_ms)?;
            let off_m = (ending.tip_m - converged).norm();
            let (verdict, energy_grew) = (verdict(&ending, off_m), ending.energy_grew);
            row.runs.push(Run { case, dt_ms, verdict, off_m, energy_grew });
        }
        progress.tick();
    }
    Ok(row)
}

/// Returns the tool unchanged, but frictionless on its walls and damped as in the map, so that it comes to
/// rest in one position within a run.
fn quiet(parameters: &ManipulatorParameters) -> ManipulatorParameters {
    let mut p = parameters.clone();
    p.damping_ratio = p.damping_ratio.max(0.1);
    p.contact.friction_coefficient = 0.0;
    p
}

/// Within one radian of the tool's first mode.
fn reference_dt_ms(p: &ManipulatorParameters) -> Result<f64, ManipulatorError> {
    let base = BaseMotion::at_rest(Isometry3::identity());
    let mut p = p.clone();
    p.integrator = Integrator::LinearlyImplicitEuler;
    let hz = AnyManipulator::new(Rung::Spatial, p, &base)?.first_natural_frequency_hz();
    Ok(REFERENCE_DT_MS.min(1e3 / (std::f64::consts::TAU * hz)))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn shipped_tools_end_where_they_should_and_a_rung_that_cannot_represent_one_says_so() {
        for tool in tools(&[]).unwrap() {
            let planar = Method::Rung(Rung::Planar, Integrator::LinearlyImplicitEuler);
            let p = quiet(&tool.parameters);
            let setup = Setup::of(&p).unwrap();
            let arc = Method::Rung(Rung::ConstantCurvature, Integrator::LinearlyImplicitEuler);
            if tool.name == "two_segments" {
                let row = row(&tool, arc, &[1.0], &Progress::new(1)).unwrap();
                assert!(row.refused.unwrap().contains("tendon"));
            }
            let play = |dt_ms| Case::TensionStep.play(planar, &p, &setup, 1.0, dt_ms).unwrap();
            let off_m = (play(1.0).tip_m - play(0.25).tip_m).norm();
            assert!(off_m < 0.2e-3, "{}: {off_m}", tool.name);
        }
    }
}
