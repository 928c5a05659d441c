//! The DRR process: receives every state and every removed voxel, renders the frames that are due, and
//! publishes them.
//!
//! One thread talks to the other processes while another renders (with the scene's number of worker threads),
//! so that no message is lost however long a frame takes. In lockstep every scheduled tick is rendered, and
//! the physics waits when the renderer falls behind. In real time, a frame that falls due during a render
//! shows the newest state once the renderer is free. The process publishes which tick a frame will show
//! (`DrrReply`) before it renders it.

mod ports;
mod service;

use std::path::Path;
use std::sync::Arc;

use delivery::x_ray::RemovalLoss;
use ipc_types::arm_meshes::ArmMeshError;
use ipc_types::messages::Part;
use ipc_types::messages::services;
use ipc_types::ports::PortError;
use ipc_types::process::{EndRequest, Role, await_volume, prioritise, session_scene};
use ipc_types::scene::SceneError;
use ipc_types::session::{Session, SessionError};
use thiserror::Error;
use xray::from_scene::{renderer_parameters, scene_c_arm};
use xray::message::volume_view;
use xray::surroundings::Surroundings;
use xray::{DrrError, DrrRenderer};

use crate::machine::ThisMachine;

/// Why the DRR process ends early.
#[derive(Debug, Error)]
pub enum DrrProcessError {
    /// The session cannot be joined.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The session's scene cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A message cannot be sent or received.
    #[error(transparent)]
    Port(#[from] PortError),
    /// The renderer refuses the volume or the C-arm.
    #[error(transparent)]
    Renderer(#[from] DrrError),
    /// A mesh of the arm shown in frames cannot be used.
    #[error(transparent)]
    ArmMesh(#[from] ArmMeshError),
    /// The scene has no X-ray.
    #[error("the scene has no `[drr]`: there is nothing to render")]
    NoDrr,
    /// Messages with removed voxels were lost, so frames would show bone that is gone.
    #[error(transparent)]
    RemovedLost(#[from] RemovalLoss),
    /// The rendering thread cannot be started.
    #[error("the rendering thread cannot be started: {0}")]
    Worker(std::io::Error),
    /// The rendering thread died.
    #[error("the rendering thread ended early")]
    WorkerGone,
    /// Signals cannot be handled.
    #[error("cannot install signal handlers: {0}")]
    Signals(std::io::Error),
}

/// Runs the DRR process of a session until the session ends.
///
/// # Errors
/// Any [`DrrProcessError`].
pub fn run(session_folder: &Path) -> Result<(), DrrProcessError> {
    let end = EndRequest::install().map_err(DrrProcessError::Signals)?;
    let scene = session_scene(session_folder)?;
    let drr = scene.drr.clone().ok_or(DrrProcessError::NoDrr)?;
    let around = Arc::new(Surroundings::new(&scene, crate::arm_model(&scene.arm)?)?);
    // Frames can wait, ticks cannot.
    prioritise(Role::Drr, scene.run.policy);
    let session = Session::join(session_folder)?;
    session.claim(Part::Drr)?;
    let ports = ports::Ports::open(&session)?;
    let volume = await_volume(&session.subscriber(&services::VOLUME)?, &end)?;
    let view = volume_view(volume.message(), volume.tail())?;
    let parameters = renderer_parameters(&drr, scene.tolerance.as_ref());
    let mut renderer = DrrRenderer::new(&view, parameters, &ThisMachine)?;
    let c_arm = scene_c_arm(&drr)?;
    renderer.prepare(&view, &c_arm)?;
    service::serve(&scene, ports, &view, renderer, &c_arm, around, &end)
}
