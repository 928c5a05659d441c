//! The answering sides: how to start each, and those that this program itself implements.

use std::path::{Path, PathBuf};
use std::process::{Command as Program, Stdio};
use std::time::Duration;

use clap::ValueEnum;
use ipc_types::messages::TendonMode;
use ipc_types::process::end_with_parent;
use trabecula::fmu_controller::{self, OPTIONS, Setup};
use trabecula_client::{Client, ClientError, Connection};
use trabecula_fmu::Archive;

use super::super::failed;
use super::super::ping_pong::Wait;
use super::{Peer, sockets};
use trabecula::failure::Failure;

const LIMIT: Duration = Duration::from_secs(20);

/// The programs of other languages, or the reason why one is missing.
#[derive(Debug)]
pub(super) struct Programs {
    /// Deleted with its contents when the measurement is over.
    _folder: Option<tempfile::TempDir>,
    library: Result<PathBuf, String>,
    c: Result<PathBuf, String>,
    fmu: Result<PathBuf, String>,
    python: PathBuf,
}

/// Returns the source folder that this program was built from.
fn sources() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../clients"))
}

/// Returns the client library next to this program.
fn library() -> Result<PathBuf, String> {
    let program = std::env::current_exe().map_err(|cause| cause.to_string())?;
    let folder = program.parent().unwrap_or(Path::new("."));
    // Cargo copies it out of `deps` only when its package is built by name.
    let places = ["deps/libtrabecula_client.so", "libtrabecula_client.so"].map(|name| folder.join(name));
    let missing = || format!("no libtrabecula_client.so next to {}", program.display());
    places.into_iter().find(|path| path.exists()).ok_or_else(missing)
}

fn compile(arguments: &mut Program) -> Result<(), String> {
    let output = arguments.output().map_err(|cause| format!("cc: {cause}"))?;
    if output.status.success() {
        return Ok(());
    }
    Err(String::from_utf8_lossy(&output.stderr).lines().next().unwrap_or("cc failed").to_owned())
}

fn compile_c(folder: &Path, library: &Path) -> Result<PathBuf, String> {
    let program = folder.join("echo");
    let libraries = library.parent().unwrap_or(Path::new("."));
    let mut compiler = Program::new("cc");
    compiler.args(["-O2", "-ffp-contract=off"]).arg("-I").arg(sources().join("c/include"));
    compiler.arg(sources().join("c/bench/echo.c")).arg("-o").arg(&program);
    compiler.arg("-L").arg(libraries).arg("-ltrabecula_client");
    compile(compiler.arg(format!("-Wl,-rpath,{}", libraries.display())))?;
    Ok(program)
}

/// Builds the FMU whose output is a gain times its input, as the other programs' command is the bend.
fn build_fmu(folder: &Path) -> Result<PathBuf, String> {
    let (library, fmu) = (folder.join("gain.so"), folder.join("gain.fmu"));
    let of_source = |name: &str| sources().join("fmu/bench").join(name);
    let mut compiler = Program::new("cc");
    compiler.args(["-std=c11", "-O2", "-ffp-contract=off", "-shared", "-fPIC"]);
    compile(compiler.arg(of_source("gain.c")).arg("-o").arg(&library))?;
    let mut archive = Archive::default();
    let place = format!("binaries/{}-linux/gain.so", std::env::consts::ARCH);
    for (name, file) in [("modelDescription.xml", of_source("gain.xml")), (&place, library)] {
        archive.add(name, &std::fs::read(file).map_err(|cause| cause.to_string())?);
    }
    let bytes = archive.finish().ok_or("the FMU is too large")?;
    std::fs::write(&fmu, bytes).map_err(|cause| cause.to_string())?;
    Ok(fmu)
}

impl Programs {
    /// Compiles the C program and the FMU, and locates what the others need.
    pub(super) fn prepare(python: PathBuf) -> Programs {
        let library = library();
        let folder = tempfile::tempdir().map_err(|cause| cause.to_string());
        let c = match (&folder, &library) {
            (Ok(folder), Ok(library)) => compile_c(folder.path(), library),
            (Err(reason), _) | (_, Err(reason)) => Err(reason.clone()),
        };
        let fmu = folder.as_ref().map_err(Clone::clone).and_then(|folder| build_fmu(folder.path()));
        Programs { _folder: folder.ok(), library, c, fmu, python }
    }

    /// Returns the command line of a language's answering side, or why it is missing.
    pub(super) fn command(&self, peer: Peer, wait: Wait, rounds: usize) -> Result<Program, String> {
        let how = if wait == Wait::Spin { "spin" } else { "event" };
        let mut command = match peer {
            Peer::C => Program::new(self.c.as_ref().map_err(Clone::clone)?),
            Peer::Python => {
                let library = self.library.as_ref().map_err(Clone::clone)?;
                let mut command = Program::new(&self.python);
                command.env("TRABECULA_CLIENT_LIBRARY", library).env("PYTHONPATH", sources().join("python"));
                let mut probe = Program::new(&self.python);
                let found = probe.args(["-c", "import numpy"]).stderr(Stdio::null()).status();
                if !found.is_ok_and(|status| status.success()) {
                    let name = self.python.display();
                    return Err(format!(
                        "{name} has no NumPy; choose another interpreter with --python PATH"
                    ));
                }
                command.arg(sources().join("python/bench/echo.py"));
                command
            }
            Peer::Fmu if wait == Wait::Spin => return Err("an FMU's process waits by event".to_owned()),
            Peer::Fmu => {
                let fmu = self.fmu.as_ref().map_err(Clone::clone)?.to_string_lossy();
                return echo_command(peer, wait, rounds, &fmu).map_err(|failure| failure.message);
            }
            other => return echo_command(other, wait, rounds, "").map_err(|failure| failure.message),
        };
        command.args([how, &rounds.to_string()]);
        Ok(command)
    }
}

/// Returns the command line that starts this program as an answering side.
///
/// # Errors
/// This program cannot find its own path.
pub(super) fn echo_command(peer: Peer, wait: Wait, rounds: usize, address: &str) -> Result<Program, Failure> {
    let name = |value: Option<clap::builder::PossibleValue>| {
        value.map_or_else(String::new, |value| value.get_name().to_owned())
    };
    let mut command = Program::new(std::env::current_exe().map_err(failed)?);
    command.args(["bench", "echo", "--peer", &name(peer.to_possible_value())]);
    command.args(["--wait", &name(wait.to_possible_value()), "--rounds", &rounds.to_string()]);
    command.args(["--address", address]);
    Ok(command)
}

/// Runs as one of the answering sides implemented by this program.
///
/// # Errors
/// Any error of the transport.
pub fn answer(peer: Peer, wait: Wait, rounds: usize, address: &str) -> Result<(), Failure> {
    end_with_parent();
    match peer {
        Peer::Rust => answer_as_client(wait, rounds).map_err(failed),
        Peer::Fmu => answer_by_fmu(Path::new(address)),
        Peer::Unix | Peer::Udp => sockets::answer(peer, wait, rounds, address),
        Peer::Iceoryx2 | Peer::C | Peer::Python => Err(Failure::bad_input("this side is another program")),
    }
}

fn answer_as_client(wait: Wait, rounds: usize) -> Result<(), ClientError> {
    let mut client = Client::connect(&Connection::default())?;
    for _ in 0..rounds {
        if wait == Wait::Spin {
            while client.poll_state()?.is_none() {
                std::hint::spin_loop();
            }
        } else {
            client.wait_state(LIMIT)?;
        }
        let bend_rad = client.state().map_or(0.0, |state| state.bend_rad);
        let command = client.command()?;
        command.tendon_mode = TendonMode::ServoJf.code();
        command.tendon_force_n[0] = bend_rad;
        client.send()?;
    }
    Ok(())
}

/// Answers until the run ends.
fn answer_by_fmu(fmu: &Path) -> Result<(), Failure> {
    let pair = |name: &str, value: &str| vec![(name.to_owned(), value.to_owned())];
    let setup = Setup {
        fmu: fmu.to_owned(),
        inputs: pair("y", "bend_rad"),
        outputs: pair("tendon_force_n[0]", "u"),
        constants: vec![("tendon_mode".to_owned(), f64::from(TendonMode::ServoJf.code()))],
        parameters: Vec::new(),
        step_ms: None,
        preload: None,
        labels: OPTIONS,
    };
    fmu_controller::drive(&setup, Client::connect(&Connection::default()).map_err(failed)?)
}
