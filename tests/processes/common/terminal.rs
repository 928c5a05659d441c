//! A run in a terminal of its own.

use std::io::{BufRead, BufReader, Lines, Write};
use std::path::{Path, PathBuf};
use std::process::{ChildStdout, Command, Stdio};

use test_support::limited::{COMMAND_LIMIT, Watchdog};

use super::program::{Guarded, session_folder, wait_for};

/// A script of Python that starts its arguments in a new terminal, says their process, and does to the terminal what it is told.
pub struct Terminal {
    script: Guarded,
    said: Lines<BufReader<ChildStdout>>,
    /// The launcher's process.
    pub launcher: u32,
    /// Its session's folder.
    pub session: PathBuf,
    _watchdog: Watchdog,
}

impl Terminal {
    /// Runs a scene there, until its session is there.
    pub fn new(script: &str, scene: &Path, output: &Path) -> Terminal {
        let mut command = Command::new("python3");
        command.args(["-c", script, env!("CARGO_BIN_EXE_trabecula"), "run"]);
        command.arg(scene).arg("--output").arg(output).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut script = Guarded(command.spawn().unwrap());
        let watchdog = Watchdog::over(&script.0, COMMAND_LIMIT);
        let mut said = BufReader::new(script.0.stdout.take().unwrap()).lines();
        let launcher: u32 = said.next().unwrap().unwrap().parse().unwrap();
        let session =
            wait_for("the session", || Some(session_folder(launcher)).filter(|folder| folder.exists()));
        Terminal { script, said, launcher, session, _watchdog: watchdog }
    }

    /// Tells the script to act, once.
    pub fn tell(&mut self, what: &str) {
        writeln!(self.script.0.stdin.take().unwrap(), "{what}").unwrap();
    }

    /// The next line that the script says.
    pub fn next_line(&mut self) -> String {
        self.said.next().unwrap().unwrap()
    }
}
