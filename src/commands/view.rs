//! `trabecula view`: shows a running session, or logs, in the browser.

use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args;
use ipc_types::arm_meshes::ArmMeshError;
use ipc_types::process::EndRequest;
use ipc_types::scene::Scene;
use ipc_types::session::{SESSION_VARIABLE, SearchedPlaces, only_session};
use simulation::manipulator_parameters;
use viewer_proc::live;
use viewer_proc::log::{self, LogOptions, SceneCallbacks};
use viewer_proc::server::ListeningPort;
use viewer_proc::server::http::AllowedHost;
use viewer_proc::{ArmMeshes, ServerOptions, ToolShape, ViewerError};

use super::log_name;
use super::view_arm::{arm_looks, arm_parts};
use super::view_plan::OpenedScene;
use crate::failure::{EXIT_INTERRUPTED, Failure};
use crate::launcher::volume_source::{self, VolumeFiles};
use crate::redirect_file::{self, RedirectFile};

/// How long the viewer may take to shut down after a signal.
const LEAVE_LIMIT: Duration = Duration::from_secs(2);

/// Arguments of `view`.
#[derive(Debug, Args)]
pub struct ViewArguments {
    /// Log to show (a run's folder, its `run.mcap`, or `latest`), or a scene (`.toml`) to plan and run;
    /// default: a running session.
    #[arg(conflicts_with = "session", value_parser = log_name())]
    log: Option<PathBuf>,
    /// Second log, to compare with the first.
    #[arg(value_parser = log_name())]
    second: Option<PathBuf>,
    /// Folder of the session; default: this user's only running session.
    #[arg(long)]
    session: Option<PathBuf>,
    #[command(flatten)]
    volume_files: VolumeFiles,
    #[command(flatten)]
    server: ServerArguments,
}

/// How the page is served.
#[derive(Debug, Clone, Args)]
pub struct ServerArguments {
    /// Port; 0 picks a free one.
    #[arg(long, default_value_t = 8765)]
    port: u16,
    /// Address to listen on. Beyond loopback, the token is sent unencrypted.
    #[arg(long, default_value = "127.0.0.1")]
    bind: IpAddr,
    /// Allow pages from this origin to connect, for example http://localhost:8080 for a self-hosted
    /// Lichtblick.
    #[arg(long)]
    allow_origin: Vec<String>,
    /// Accept requests that name this host, as through a tunnel (`ssh -L 9000:localhost:8765`:
    /// localhost:9000), a host name of this machine or a container's published port. Can be given several
    /// times.
    #[arg(long, value_name = "NAME:PORT")]
    allow_host: Vec<AllowedHost>,
    /// Let anyone who can reach the port, such as other users of this machine, watch without the token.
    /// Commands still need it.
    #[arg(long)]
    watch_by_anyone: bool,
    /// Do not open a browser.
    #[arg(long)]
    no_open: bool,
    /// Serve the page's files from this folder, rereading them on each request (for page development).
    #[arg(long, hide = true)]
    page_folder: Option<PathBuf>,
}

impl ServerArguments {
    fn options(&self) -> ServerOptions {
        ServerOptions {
            bind: self.bind,
            port: self.port,
            allow_origin: self.allow_origin.clone(),
            allow_host: self.allow_host.clone(),
            watch_by_anyone: self.watch_by_anyone,
            page_folder: self.page_folder.clone(),
        }
    }

    /// Prints the page's address and opens it. `folder` holds the file that redirects the browser to it.
    fn ready(&self, door: &ListeningPort, folder: &Path) -> Option<RedirectFile> {
        say!("{}", door.url());
        door.other_urls().for_each(|url| say!("{url}"));
        if self.no_open { None } else { RedirectFile::open(&door.url(), folder) }
    }

    fn door(&self) -> Result<ListeningPort, Failure> {
        ListeningPort::open(&self.options()).map_err(|error| failure(&error))
    }
}

/// Runs the viewer until Ctrl-C, or until the session has ended and no client is watching its log.
///
/// # Errors
/// No session, a port in use (2); any error of the viewer (1).
pub fn run(arguments: &ViewArguments) -> Result<(), Failure> {
    // Nothing can be lost, so a viewer that is still reading a log or building its volume just exits.
    let end = EndRequest::answered(|_| {
        // Without a thread there is no limit.
        let _ = std::thread::Builder::new().spawn(|| {
            std::thread::sleep(LEAVE_LIMIT);
            std::process::exit(EXIT_INTERRUPTED.into());
        });
    })
    .map_err(Failure::signals)?;
    redirect_file::sweep(&redirect_file::folder());
    if let Some(scene) = arguments.log.as_deref().filter(|path| is_scene(path)) {
        return view_plan(scene, arguments, &end);
    }
    if let Some(log) = &arguments.log {
        return view_logs(log, arguments, &end);
    }
    let named = arguments.session.clone().or_else(|| std::env::var_os(SESSION_VARIABLE).map(PathBuf::from));
    let only = || only_session().map_err(Failure::bad_input);
    let session = match named.map_or_else(only, |folder| Ok(Some(folder)))? {
        Some(folder) => folder,
        None => return Err(failure(&ViewerError::NoSession(SearchedPlaces::places(None)))),
    };
    redirect_file::sweep(&session);
    let door = arguments.server.door()?;
    let mut _redirect_file = None;
    let ready = || _redirect_file = arguments.server.ready(&door, &session);
    let recorded = live::view(&session, &door, shapes, ready, &end).map_err(|error| failure(&error))?;
    recorded.map_or(Ok(()), |log| view_followed(log, arguments, &door, &end))
}

fn is_scene(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending == "toml")
}

/// Shows a scene before it is run, then the run started from the page, then its log.
fn view_plan(scene: &Path, arguments: &ViewArguments, end: &EndRequest) -> Result<(), Failure> {
    if arguments.second.is_some() {
        return Err(Failure::bad_input("a scene cannot be compared with another file; give only the scene"));
    }
    let opened = OpenedScene::open(scene, arguments.volume_files)?;
    let door = arguments.server.door()?;
    let folder = redirect_file::folder();
    let mut _redirect_file = None;
    let ready = || _redirect_file = arguments.server.ready(&door, &folder);
    let Some(run) = opened.view(&door, ready, end)? else { return Ok(()) };
    drop(opened);
    let Some(session) = run.session() else { return Ok(()) };
    let recorded = match live::view(session, &door, shapes, || (), end) {
        Ok(recorded) => recorded,
        // A short run can end before it is joined.
        Err(ViewerError::Session(_) | ViewerError::Message(_)) => run.log(end),
        Err(error) => return Err(failure(&error)),
    };
    recorded.map_or(Ok(()), |log| view_followed(log, arguments, &door, end))
}

/// Shows the log of a run that was being watched, until the last client leaves.
fn view_followed(
    log: PathBuf,
    arguments: &ViewArguments,
    door: &ListeningPort,
    end: &EndRequest,
) -> Result<(), Failure> {
    let options = LogOptions { log, second: None, until_left: true };
    show_logs(&options, arguments, door, || (), end)
}

fn view_logs(log: &Path, arguments: &ViewArguments, end: &EndRequest) -> Result<(), Failure> {
    let options = LogOptions { log: log.to_owned(), second: arguments.second.clone(), until_left: false };
    let door = arguments.server.door()?;
    let folder = redirect_file::folder();
    let mut _redirect_file = None;
    let ready = || _redirect_file = arguments.server.ready(&door, &folder);
    show_logs(&options, arguments, &door, ready, end)
}

fn show_logs(
    options: &LogOptions,
    arguments: &ViewArguments,
    door: &ListeningPort,
    ready: impl FnOnce(),
    end: &EndRequest,
) -> Result<(), Failure> {
    let volume =
        |scene: &Scene| volume_source::load(scene, arguments.volume_files).map_err(|error| error.to_string());
    let help = SceneCallbacks { shapes: &shapes, volume: &volume };
    log::view(options, door, &help, ready, end).map_err(|error| failure(&error))
}

/// Converts a viewer error to the command's failure.
pub(super) fn failure(error: &ViewerError) -> Failure {
    Failure::by_kind(error.is_bad_input(), error)
}

/// Returns a scene's tool and arm as the page draws them. If an arm mesh is missing, adds a note and draws
/// the arm as tubes, because a log may be viewed on a machine without the arm's files.
fn shapes(scene: &Scene) -> (ToolShape, ArmMeshes) {
    let tubes = |cause: ArmMeshError| ArmMeshes {
        meshes: Vec::new(),
        notes: vec![format!("the arm is drawn as tubes: {cause}")],
    };
    (tool_shape(scene), arm_looks(scene).unwrap_or_else(tubes))
}

/// Returns the scene's tool as the page draws it, or a bare burr if the tool is invalid.
pub fn tool_shape(scene: &Scene) -> ToolShape {
    let radii = scene.manipulator.radii();
    let mut shape = ToolShape {
        joint_positions_m: Vec::new(),
        tip_offset_m: 0.0,
        outer_radius_m: radii.tube_outer_m,
        outer_tube: radii.outer_tube,
        cutter: radii.cutter,
        holder: scene.arm.holder(),
        arm_parts: arm_parts(scene),
    };
    if let Ok(parameters) = manipulator_parameters(scene) {
        shape.joint_positions_m = parameters.joint_positions_m;
        shape.tip_offset_m = parameters.tip_offset_m;
        shape.outer_radius_m = parameters.tube_radii_m[0];
        shape.cutter = parameters.cutter;
    }
    shape
}
