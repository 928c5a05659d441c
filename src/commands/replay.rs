//! `trabecula replay LOG`: steps the physics through a log's latched commands again.

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use ipc_types::layout::hex;
use ipc_types::messages::{Latched, State};
use ipc_types::scene::Scene;
use physics_proc::process::ct_geometry;
use physics_proc::simulation::{CtView, Simulation};
use recorder_proc::{BuildInfo, LogReader, ReadOptions, ReplayReport, VerifyOptions, verify};

use crate::failure::Failure;
use crate::launcher::volume_source;

/// Arguments of `replay`.
#[derive(Debug, Args)]
pub struct ReplayArguments {
    /// `run.mcap`, or the folder of a run.
    pub log: PathBuf,
    /// Compare hash, state and removed voxels at every tick; the first difference ends the replay with exit code 1.
    #[arg(long)]
    pub verify: bool,
    /// Ticks to replay at most.
    #[arg(long)]
    pub ticks: Option<u64>,
    /// Replay though the log is of another build or volume; the result is labelled so.
    #[arg(long)]
    pub allow_mismatch: bool,
}

/// Replays a log.
///
/// # Errors
/// Bad input (2): not a log, another build, layout or volume. A difference (1).
pub fn run(arguments: &ReplayArguments) -> Result<(), Failure> {
    let path = log_path(&arguments.log);
    let options = ReadOptions { allow_other_layouts: arguments.allow_mismatch };
    let mut reader = LogReader::open_with(&path, options).map_err(Failure::bad_input)?;
    let mut mismatches = build_mismatch(&reader);
    let scene = Scene::parse(&reader.header().scene_toml, &path).map_err(Failure::bad_input)?;
    let volume = volume_source::load(&scene).map_err(Failure::bad_input)?;
    mismatches.extend(volume_mismatch(&reader, volume.as_ref().map(|(_, hash)| hash)));
    if !mismatches.is_empty() && !arguments.allow_mismatch {
        let list = mismatches.join("\n  ");
        return Err(Failure::bad_input(format!(
            "{}: this log cannot be replayed here:\n  {list}\nuse what made it, or --allow-mismatch",
            path.display()
        )));
    }
    let ct = volume.as_ref().map(|(volume, hash)| {
        let message = volume_source::message(volume, *hash);
        CtView { geometry: ct_geometry(&message), hu: &volume.hu }
    });
    let simulation = Simulation::new(&scene, ct).map_err(|cause| Failure::failed(cause.to_string()))?;
    let began = Instant::now();
    let mut world = World { simulation };
    let report = if arguments.verify {
        verify(&mut reader, &mut world, VerifyOptions { max_ticks: arguments.ticks })
    } else {
        step_only(&mut reader, &mut world, arguments.ticks)?
    };
    let wall_s = began.elapsed().as_secs_f64();
    let label = if mismatches.is_empty() { "" } else { " (MISMATCH ALLOWED)" };
    let stopped_early = arguments.ticks.is_some_and(|most| report.identical_ticks >= most);
    tell(&report, wall_s, (arguments.verify, stopped_early), label)
}

/// `run.mcap` of a folder, or the file itself.
pub fn log_path(given: &Path) -> PathBuf {
    if given.is_dir() { given.join("run.mcap") } else { given.to_owned() }
}

fn build_mismatch(reader: &LogReader) -> Vec<String> {
    let (theirs, ours) = (&reader.header().build, BuildInfo::current());
    if *theirs == ours {
        return Vec::new();
    }
    let name = |build: &BuildInfo| {
        format!(
            "{} for {} by {}",
            build.version,
            build.target,
            build.rustc.as_deref().unwrap_or("an unknown compiler")
        )
    };
    vec![format!("build: the log was written by {}, this is {}", name(theirs), name(&ours))]
}

fn volume_mismatch(reader: &LogReader, ours: Option<&[u8; 32]>) -> Vec<String> {
    let theirs = reader.header().volume_sha256;
    if theirs.as_ref() == ours {
        return Vec::new();
    }
    let name = |hash: Option<&[u8; 32]>| hash.map_or("none".to_owned(), |hash| hex(hash));
    vec![format!("volume: the log's has SHA-256 {}, the scene's now {}", name(theirs.as_ref()), name(ours))]
}

/// The physics as the log library wants it.
struct World<'v> {
    simulation: Simulation<'v>,
}

impl recorder_proc::Simulation for World<'_> {
    fn state(&self) -> &State {
        self.simulation.state()
    }

    fn step(&mut self, latched: &Latched) -> Result<(), String> {
        self.simulation.step(latched).map_err(|cause| cause.to_string())
    }

    fn removed(&self) -> &[u32] {
        self.simulation.removed()
    }
}

/// Steps without comparing, and says where it came out.
fn step_only(reader: &mut LogReader, world: &mut World, ticks: Option<u64>) -> Result<ReplayReport, Failure> {
    use recorder_proc::Simulation as _;
    // A replay of no tick gives an empty report to fill.
    let mut report = verify(reader, world, VerifyOptions { max_ticks: Some(0) });
    report.divergence = None;
    while ticks.is_none_or(|most| report.identical_ticks < most) {
        let Some(record) = reader.next() else {
            report.ending = reader.ending().clone();
            break;
        };
        let record = record.map_err(|cause| Failure::failed(cause.to_string()))?;
        world.step(&record.latched).map_err(Failure::failed)?;
        report.identical_ticks += 1;
        report.last_tick = world.state().tick;
        report.hash = world.state().hash;
        report.simulated_ns += reader.header().dt_ns;
    }
    Ok(report)
}

fn tell(
    report: &ReplayReport,
    wall_s: f64,
    (verified, stopped_early): (bool, bool),
    label: &str,
) -> Result<(), Failure> {
    let simulated_s = report.simulated_ns as f64 * 1e-9;
    let hash = recorder_proc::end::hash_text(report.hash);
    if let Some(error) = &report.log_error {
        return Err(Failure::failed(format!(
            "the log cannot be read further than tick {}: {error}",
            report.last_tick
        )));
    }
    if let Some((tick, cause)) = &report.simulation_error {
        return Err(Failure::failed(format!("tick {tick} cannot be made: {cause}")));
    }
    if let Some(divergence) = &report.divergence {
        return Err(Failure::failed(format!("{divergence}{label}")));
    }
    let what = if verified { "ticks, all identical" } else { "ticks" };
    say!(
        "replayed {} {what}{label}; last tick {}, hash {hash}; {simulated_s:.3} s simulated in {wall_s:.3} s, {:.1} times real time",
        report.identical_ticks,
        report.last_tick,
        simulated_s / wall_s.max(1e-9)
    );
    // A replay that was told to stop early has not read how the log ends.
    if !stopped_early {
        say!("{}", report.ending.describe());
    }
    Ok(())
}
