//! Logs on a time line: play, seek, step, plot, and compare two of them.
//!
//! A log opens from its index. Everything that needs the complete log (marks, drilled voxels, fields for
//! plots) is read in the background, so that a log of an hour opens as quickly as one of a second.

mod background;
mod bone;
mod compare;
pub mod file;
pub mod marks;
mod playback;
pub mod player;
pub mod series;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Sender};

use ipc_types::process::EndRequest;
use ipc_types::scene::Scene;
use recorder_proc::log_file::{LogFile as LogSource, log_path};
use run_log::{LogHeader, MessageStream, ReadOptions};
use voxel_grid::Ct;

use crate::board::Board;
use crate::calls::call_queue;
use crate::channels::{Channels, INFO};
use crate::error::ViewerError;
use crate::info::{ArmMeshes, Origin, ToolShape, info};
use crate::left::IdleTimer;
use crate::live::CALL_QUEUE;
use crate::scene_update::Drawer;
use crate::server::{ListeningPort, Server};
use crate::structure_meshes;
use crate::threads;
use background::{BackgroundResult, Reader, divergence};
use file::LogFile;
use playback::{LogPlayback, Logs, Scenery, ShownLog};
use series::LogSeries;

/// The logs to view.
#[derive(Debug, Clone)]
pub struct LogOptions {
    /// `run.mcap`, or its folder.
    pub log: PathBuf,
    /// A second log to compare with.
    pub second: Option<PathBuf>,
    /// Whether to end once no client has been connected for a while.
    pub until_left: bool,
}

/// Loads the volume of a scene, or returns an error text; runs on its own thread.
pub type VolumeSource<'a> = dyn Fn(&Scene) -> Result<Option<Ct>, String> + Sync + 'a;

/// Callbacks into the command line program.
pub struct SceneCallbacks<'a> {
    /// Returns the shapes of tool and arm.
    pub shapes: &'a dyn Fn(&Scene) -> (ToolShape, ArmMeshes),
    /// Loads the volume.
    pub volume: &'a VolumeSource<'a>,
}

/// A log whose header and index have been read.
struct OpenLog {
    path: PathBuf,
    header: LogHeader,
    shown: ShownLog,
}

impl OpenLog {
    fn open(given: &Path) -> Result<OpenLog, ViewerError> {
        let path = log_path(given);
        let header = MessageStream::open(&LogSource::at(&path), ReadOptions::default())?.header().clone();
        let run = LogFile::open(&path)?;
        // A truncated timing lane is still read for marks but cannot be played.
        let timing = Some(timing_of(&path)).filter(|path| path.exists());
        let timing = timing.and_then(|path| LogFile::open(&path).ok());
        let series = Arc::new(LogSeries::new(run.bounds_ns(), header.dt_ns));
        Ok(OpenLog { path, header, shown: ShownLog { run, timing, series } })
    }

    fn reader(&self, over: &Arc<AtomicBool>, found: Option<Sender<BackgroundResult>>) -> Reader {
        Reader {
            header: self.header.clone(),
            run: self.path.clone(),
            timing: timing_of(&self.path),
            series: Arc::clone(&self.shown.series),
            over: Arc::clone(over),
            found,
        }
    }
}

/// Returns the timing lane next to a run lane.
fn timing_of(run: &Path) -> PathBuf {
    run.with_file_name("timing.mcap")
}

/// Shows logs until the process is asked to end.
///
/// # Errors
/// A log cannot be played, or a thread cannot be started.
pub fn view(
    options: &LogOptions,
    door: &ListeningPort,
    help: &SceneCallbacks<'_>,
    ready: impl FnOnce(),
    end: &EndRequest,
) -> Result<(), ViewerError> {
    let first = OpenLog::open(&options.log)?;
    let second = options.second.as_deref().map(OpenLog::open).transpose()?;
    let scene = Scene::parse(&first.header.scene_toml, &first.path)?;
    let mut channels = Channels::new(&first.header.controllers, scene.has_readings());
    channels.add_log(second.is_some());
    let board = Arc::new(Board::new(channels));
    let (calls, called) = call_queue(CALL_QUEUE);
    let over = Arc::new(AtomicBool::new(false));
    let name = first.path.display().to_string();
    let server = Server::behind(door, &name, Arc::clone(&board), calls, Arc::clone(&over))?;
    let (found, finding) = mpsc::channel();
    let readers: Vec<Reader> = core::iter::once(first.reader(&over, Some(found.clone())))
        .chain(second.as_ref().map(|second| second.reader(&over, None)))
        .collect();
    let (tool, looks) = (help.shapes)(&scene);
    let origin = Origin::Log(name);
    board.publish_json(INFO, &info(&scene, &origin, &tool, None));
    looks.publish(&board);
    structure_meshes::publish(&scene, &board);
    let both = second.as_ref().map(|second| (first.path.clone(), second.path.clone()));
    let header = first.header.clone();
    let logs: Logs = Arc::new((first.shown, second.map(|second| second.shown)));
    let scenery = Scenery {
        threshold_hu: scene.volume.as_ref().map_or(0, |volume| volume.bone_threshold_hu),
        drawer: Drawer::new(&tool),
        info: {
            let scene = scene.clone();
            Box::new(move |grid| info(&scene, &origin, &tool, Some(grid)))
        },
    };
    let mut playback = LogPlayback::new(board, logs, header.dt_ns, scenery, finding);
    let left = options.until_left.then(IdleTimer::default);
    std::thread::scope(|scope| {
        let serving = threads::start_in(scope, "server", || server.serve())?;
        let show = || {
            for reader in &readers {
                threads::start_in(scope, "log", || reader.run())?;
            }
            let volume = help.volume;
            threads::start_in(scope, "volume", || find_volume(&scene, &header, volume, &found))?;
            threads::start_in(scope, "comparison", || find_divergence(both, &found, &over))?;
            ready();
            playback.run(&called, end, &over, left)
        };
        let shown = show();
        over.store(true, Ordering::Relaxed);
        let served = serving.join().unwrap_or(Ok(()));
        shown.and(served)
    })
}

/// Loads the volume of the log's scene and checks that it is the run's.
fn find_volume(
    scene: &Scene,
    header: &LogHeader,
    volume: &VolumeSource<'_>,
    found: &Sender<BackgroundResult>,
) {
    let refused = match volume(scene) {
        Ok(Some(ct)) if header.volume_sha256.is_none_or(|sha256| sha256 == ct.sha256) => {
            // The viewer may be ending.
            let _ = found.send(BackgroundResult::Volume(Box::new(ct.volume)));
            return;
        }
        Ok(Some(_)) => Some("the scene's volume is not that of the run: the SHA-256 differs".to_owned()),
        Ok(None) => None,
        Err(text) => Some(text),
    };
    let _ = found.send(BackgroundResult::NoVolume(refused));
}

fn find_divergence(both: Option<(PathBuf, PathBuf)>, found: &Sender<BackgroundResult>, over: &AtomicBool) {
    let Some((first, second)) = both else { return };
    let _ = found.send(match divergence(&first, &second, over) {
        Ok(Some(mark)) => BackgroundResult::Divergence(mark),
        Ok(None) => return,
        Err(error) => BackgroundResult::Notice(format!("the two logs cannot be compared: {error}")),
    });
}
