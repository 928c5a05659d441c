//! `trabecula calibrate SCENE`: which tendon tension or displacement bends the tip to where.

use std::path::{Path, PathBuf};

use clap::Args;
use controller_proc::{Calibration, Controller, TensionSweepController};
use ipc_types::messages::Command;
use ipc_types::scene::{Mode, Scene};
use physics_proc::latch::Latch;
use physics_proc::process::ct_geometry;
use physics_proc::simulation::{CtView, Simulation};

use crate::failure::Failure;
use crate::launcher::volume_source::{self, VolumeFiles};
use crate::output::{NewFiles, refuse_existing, within};
use crate::report::calibration_figure;

/// Arguments of `calibrate`.
#[derive(Debug, Args)]
pub struct CalibrateArguments {
    /// Scene with a `tension_sweep` as its only controller.
    #[arg(default_value = "configs/tension_sweep.toml")]
    pub scene: PathBuf,
    /// Folder for `calibration.csv`, `.png` and `.svg`; made if it is not there.
    #[arg(short, long, default_value = "out/calibration")]
    pub output: PathBuf,
    #[command(flatten)]
    pub volume_files: VolumeFiles,
}

/// Steps the physics through the sweep in this process, as fast as it can, and writes what it measured.
///
/// # Errors
/// A scene that is not one, or without a sweep (2); a folder that cannot be written (2); a step that fails (1).
pub fn run(arguments: &CalibrateArguments) -> Result<(), Failure> {
    let mut scene = Scene::load(&arguments.scene).map_err(Failure::bad_input)?;
    scene.run.mode = Mode::Lockstep;
    let folder = &arguments.output;
    let files = within(folder, &["calibration.csv", "calibration.png", "calibration.svg"]);
    refuse_existing(&files)?;
    let calibration = sweep(&scene, &arguments.scene, arguments.volume_files)?;
    let unwritable = |cause: &dyn std::fmt::Display| {
        Failure::bad_input(format!("--output {}: cannot be written ({cause})", folder.display()))
    };
    output_file::create_folder(folder).map_err(|cause| unwritable(&cause))?;
    let made = NewFiles::make(&files)?;
    let file = folder.join("calibration.csv");
    output_file::write(&file, calibration.to_csv(), output_file::Existing::Replace)?;
    let title = format!("{}: calibration of tendon 0, {} levels", scene.name, calibration.rows.len());
    let figure = calibration_figure::draw(&title, &calibration);
    figure
        .and_then(|figure| figure.write(folder, "calibration"))
        .map_err(|error| Failure::failed(error.to_string()))?;
    made.keep()?;
    say!("{}", summary(&calibration));
    say!("\nwritten      {}, calibration.png, calibration.svg", file.display());
    Ok(())
}

fn sweep(scene: &Scene, file: &Path, files: VolumeFiles) -> Result<Calibration, Failure> {
    let plan = match scene.controller.as_slice() {
        [entry] => entry.tension_sweep.as_ref().map(|plan| (plan, &entry.drives)),
        _ => None,
    };
    let (plan, drives) = plan.ok_or_else(|| {
        let expected = "expected one controller with a `tension_sweep`, as in configs/tension_sweep.toml";
        Failure::bad_input(format!("{}: nothing to calibrate; {expected}", file.display()))
    })?;
    let failed = |error: &dyn std::fmt::Display| Failure::failed(error.to_string());
    let volume = volume_source::load(scene, files).map_err(Failure::bad_input)?;
    let volume = volume.map(|(volume, hash)| (volume_source::message(&volume, hash), volume.hu));
    let ct = volume.as_ref().map(|(message, hu)| CtView { geometry: ct_geometry(message), hu });
    let mut simulation = Simulation::new(scene, ct).map_err(Failure::bad_input)?;
    let mut controller = TensionSweepController::new(plan, drives);
    let mut latch = Latch::new(scene);
    // One tick more notes the last level.
    let ticks = (controller.duration_s() / scene.dt_s()).ceil() as u64 + 2;
    for tick in 0..ticks {
        let mut command = Command { sequence: tick + 1, state_tick: tick, ..Command::zeroed() };
        controller.step(simulation.state(), &mut command);
        if controller.is_done() {
            break;
        }
        latch.offer(0, &command, tick).map_err(|refusal| failed(&refusal))?;
        simulation.step(&latch.latch(tick, false)).map_err(|error| failed(&error))?;
    }
    Ok(controller.calibration().clone())
}

/// The sweep in five lines.
fn summary(calibration: &Calibration) -> String {
    let rows = &calibration.rows;
    let Some(most) = rows.iter().max_by(|a, b| a.bend_deg.total_cmp(&b.bend_deg)) else {
        return "no level was reached".to_owned();
    };
    let unsettled = rows.iter().map(|row| row.rate_deg_per_s.abs()).fold(0.0, f64::max);
    // Friction: the greatest difference of the bend at the same command.
    let hysteresis = rows.iter().filter(|row| row.rising).flat_map(|up| {
        let down = rows.iter().find(|row| !row.rising && row.commanded == up.commanded);
        down.map(|down| (down.bend_deg - up.bend_deg).abs())
    });
    let hysteresis = hysteresis.fold(0.0, f64::max);
    format!(
        "levels       {}\nat most      {:.3} N, {:.3} mm: bend {:.2} deg, tip {:.2} mm sideways\n\
         hysteresis   {hysteresis:.2} deg between up and down\nunsettled    {unsettled:.3} deg/s at most",
        rows.len(),
        most.tension_n,
        most.displacement_mm,
        most.bend_deg,
        most.tip_mm[0],
    )
}
