//! A scene before its run: its first state, its bone with the pilot holes, slices, and what was measured of its plan.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Duration;

use ipc_types::clock::now_ns;
use ipc_types::messages::State;
use ipc_types::process::EndRequest;
use ipc_types::scene::Scene;
use run_log::Topic;
use serde_json::Value;
use zerocopy::IntoBytes;

use crate::board::Board;
use crate::channels::{Channels, INFO};
use crate::error::ViewerError;
use crate::info::{Origin, ToolShape, info};
use crate::live::CALL_QUEUE;
use crate::log::LogVolume;
use crate::server::{Server, ServerOptions};
use crate::services::{Call, Calls, Request};
use crate::slice::{NO_VOLUME, Slicer};
use crate::surface::Voxel;
use crate::surface::bone::{Bone, volume_box};

/// Time between two polls.
const POLL_PERIOD: Duration = Duration::from_millis(8);

/// A scene to show.
#[derive(Debug)]
pub struct Planned {
    /// Its file.
    pub path: PathBuf,
    /// The scene.
    pub scene: Scene,
    /// Its tool's shape.
    pub tool: ToolShape,
    /// Its state before the first tick.
    pub state: State,
    /// Its volume, if it has one.
    pub volume: Option<LogVolume>,
    /// Voxels of the pilot holes.
    pub predrilled: Vec<u32>,
    /// What was measured of it, for the page.
    pub plan: Value,
    /// What `scene check` finds.
    pub findings: Vec<String>,
}

/// Shows a scene until the process is asked to end.
///
/// # Errors
/// The port cannot be opened.
pub fn view(
    planned: Planned,
    options: &ServerOptions,
    ready: impl FnOnce(&Server),
    end: &EndRequest,
) -> Result<(), ViewerError> {
    let Planned { path, scene, tool, state, volume, predrilled, plan, findings } = planned;
    let board = Arc::new(Board::new(Channels::new(&scene.controller_names(), &scene.sensor)));
    let (calls, called) = mpsc::sync_channel(CALL_QUEUE);
    let over = Arc::new(AtomicBool::new(false));
    let name = path.display().to_string();
    let server = Server::bind(options, &name, Arc::clone(&board), calls, Arc::clone(&over))?;
    let grid = volume.as_ref().map(|volume| volume_box(&volume.grid));
    let mut told = info(&scene, &Origin::Plan(name), &tool, grid.as_ref());
    told["plan"] = plan;
    board.publish_json(INFO, &told);
    board.publish_cdr(Topic::State.name(), 0, &[state.as_bytes()]);
    findings.iter().for_each(|text| board.notice("warning", text));
    ready(&server);
    let serving = std::thread::spawn(move || server.serve());
    let threshold_hu = scene.volume.as_ref().map_or(0, |volume| volume.bone_threshold_hu);
    let bone = volume.map(|volume| {
        let mut bone = Bone::new(volume.grid, threshold_hu);
        predrilled.iter().for_each(|index| bone.set(*index, Voxel::Removed));
        (bone, volume.hu)
    });
    serve(&board, bone, &called, end);
    over.store(true, Ordering::Relaxed);
    serving.join().unwrap_or(Ok(()))
}

fn serve(board: &Board, mut bone: Option<(Bone, Vec<i16>)>, called: &Calls, end: &EndRequest) {
    let mut slicer = Slicer::new(now_ns());
    while !end.is_set() {
        called.try_iter().for_each(|call| dispatch(call, &mut slicer));
        let mut is_pending = false;
        match &mut bone {
            Some((bone, hu)) => {
                is_pending = bone.publish(hu, board);
                slicer.answer(bone.field(), hu, now_ns());
            }
            None => slicer.refuse(NO_VOLUME),
        }
        if !is_pending {
            std::thread::sleep(POLL_PERIOD);
        }
    }
}

fn dispatch(call: Call, slicer: &mut Slicer) {
    match call.request {
        Request::Slice(_) => slicer.add(call),
        _ => call.refuse(
            "nothing runs yet: this is a scene before its run; start it with `trabecula run SCENE --view`",
        ),
    }
}
