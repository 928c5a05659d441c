//! `trabecula calibrate SCENE`: measures how far each tendon tension or displacement bends the tip.

use std::path::PathBuf;

use clap::Args;
use controllers::{Calibration, CalibrationRow, Controller, TensionSweepController};
use hub::in_process::{Answer, InProcess};
use ipc_types::scene::{Mode, Scene};
use simulation::{CtView, Simulation};

use crate::failure::Failure;
use crate::launcher::volume_source::{self, VolumeFiles};
use crate::output::{refuse_existing, within};
use crate::report::{ReportError, calibration_figure};
use crate::say::{Figures, path_text};
use crate::scenes::{BuiltIn, SceneSource};

/// Arguments of `calibrate`.
#[derive(Debug, Args)]
pub struct CalibrateArguments {
    /// Scene whose only controller is a `tension_sweep`; default: the built-in sweep.
    scene: Option<PathBuf>,
    /// Folder for `calibration.csv`, `.png` and `.svg`; created if missing.
    #[arg(short, long, default_value = "out/calibration")]
    output: PathBuf,
    #[command(flatten)]
    volume_files: VolumeFiles,
    #[command(flatten)]
    figures: Figures,
}

/// Steps the physics through the sweep in this process, as fast as possible, and writes the measurements.
///
/// # Errors
/// A scene that is invalid or has no sweep, or an unwritable folder (2); a failed step (1).
pub fn run(arguments: &CalibrateArguments) -> Result<(), Failure> {
    let source = SceneSource::new(arguments.scene.as_deref(), BuiltIn::TensionSweep);
    let mut scene = source.load()?;
    scene.run.mode = Mode::Lockstep;
    let folder = &arguments.output;
    let files = within(folder, &["calibration.csv", "calibration.png", "calibration.svg"]);
    refuse_existing(&files)?;
    let calibration = sweep(&scene, &source, arguments.volume_files)?;
    output_file::create_folder(folder).map_err(Failure::folder(folder))?;
    let file = folder.join("calibration.csv");
    let title = format!("{}: calibration of tendon 0, {} levels", scene.name, calibration.rows.len());
    let [png, svg] = calibration_figure::draw(&title, &calibration)
        .and_then(|figure| figure.files(folder, "calibration"))
        .map_err(ReportError::from)?;
    output_file::write_all(&[(file.clone(), calibration.to_csv().into_bytes()), png, svg])?;
    arguments.figures.say(
        || {
            let summary = summary(&calibration);
            format!("{summary}\n\nwritten      {}, calibration.png, calibration.svg", file.display())
        },
        || {
            let rows: Vec<_> = calibration.rows.iter().map(json_of).collect();
            serde_json::json!({"output": path_text(&file), "rows": rows})
        },
    );
    Ok(())
}

fn sweep(scene: &Scene, source: &SceneSource, files: VolumeFiles) -> Result<Calibration, Failure> {
    let plan = match scene.controller.as_slice() {
        [entry] => entry.tension_sweep.as_ref().map(|plan| (plan, &entry.drives)),
        _ => None,
    };
    let (plan, drives) = plan.ok_or_else(|| {
        let expected = "expected one controller with a `tension_sweep`, such as `trabecula scene init --scene tension_sweep` writes";
        Failure::bad_input(format!("{source}: nothing to calibrate; {expected}"))
    })?;
    let ct = volume_source::load(scene, files).map_err(Failure::bad_input)?;
    let view = ct.as_ref().map(|ct| CtView::from(&ct.volume));
    let simulation = Simulation::new(scene, view).map_err(Failure::bad_input)?;
    let mut run = InProcess::new(scene, simulation);
    let mut controller = TensionSweepController::new(plan, drives);
    // The last level is recorded one tick later.
    let ticks = (plan.duration_s() / scene.dt_s()).ceil() as u64 + 2;
    for _ in 0..ticks {
        let latched = run.latch(|_, state, command| {
            controller.step(state, command);
            Answer::Command
        });
        let latched = latched.map_err(Failure::failed)?;
        if controller.is_done() {
            break;
        }
        run.step(&latched).map_err(Failure::failed)?;
    }
    Ok(controller.calibration().clone())
}

fn json_of(row: &CalibrationRow) -> serde_json::Value {
    serde_json::json!({
        "rising": row.rising,
        "commanded": row.commanded,
        "tension_n": row.tension_n,
        "displacement_mm": row.displacement_mm,
        "bend_deg": row.bend_deg,
        "tip_mm": row.tip_mm,
        "rate_deg_per_s": row.rate_deg_per_s,
    })
}

/// Summarises the sweep in five lines.
fn summary(calibration: &Calibration) -> String {
    let rows = &calibration.rows;
    let Some(most) = rows.iter().max_by(|a, b| a.bend_deg.total_cmp(&b.bend_deg)) else {
        return "no level was reached".to_owned();
    };
    let unsettled = rows.iter().map(|row| row.rate_deg_per_s.abs()).fold(0.0, f64::max);
    // Friction shows as hysteresis: the largest difference in bend at the same command.
    let hysteresis = rows.iter().filter(|row| row.rising).flat_map(|up| {
        let down = rows.iter().find(|row| !row.rising && row.commanded == up.commanded);
        down.map(|down| (down.bend_deg - up.bend_deg).abs())
    });
    let hysteresis = hysteresis.fold(0.0, f64::max);
    format!(
        "levels       {}\nmaximum      {:.3} N, {:.3} mm: bend {:.2} deg, tip {:.2} mm sideways\n\
         hysteresis   {hysteresis:.2} deg between loading and unloading\ndrift        {unsettled:.3} deg/s \
         at most when sampled",
        rows.len(),
        most.tension_n,
        most.displacement_mm,
        most.bend_deg,
        most.tip_mm[0],
    )
}
