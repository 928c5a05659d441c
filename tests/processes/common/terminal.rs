//! A run in its own terminal.

use std::io::{BufRead, BufReader, Lines, Write};
use std::path::{Path, PathBuf};
use std::process::{ChildStdout, Command, Stdio};

use test_support::limited::{COMMAND_LIMIT, Watchdog};

use super::program::{Guarded, session_folder, wait_for};

/// Action on the terminal at the test's request, in Python.
#[derive(Debug, Clone, Copy)]
pub enum Act {
    /// Stops it as by Ctrl-S; then the script prints `stopped`.
    Stop,
    /// Closes it.
    Close,
}

impl Act {
    fn lines(self) -> &'static str {
        match self {
            Act::Stop => "sys.stdin.readline()\nos.write(terminal, b'\\x13')\nprint('stopped', flush=True)",
            Act::Close => "os.close(terminal)",
        }
    }
}

/// Returns a script that starts its arguments in a new terminal (with Python's standard library), prints
/// their process ID, reads their output, acts at a line from standard input, and then prints how they ended.
fn script(act: Act) -> String {
    format!(
        "
import os, pty, select, sys
pid, terminal = pty.fork()
if pid == 0:
    os.execv(sys.argv[1], sys.argv[1:])
print(pid, flush=True)
while sys.stdin not in (ready := select.select([terminal, sys.stdin], [], [])[0]):
    os.read(terminal, 65536)
{}
_, status = os.waitpid(pid, 0)
print(os.waitstatus_to_exitcode(status), flush=True)
",
        act.lines()
    )
}

/// A run in a terminal, on which one action is performed.
pub struct Terminal {
    script: Guarded,
    said: Lines<BufReader<ChildStdout>>,
    /// The launcher's process ID.
    pub launcher: u32,
    /// Its session's folder.
    pub session: PathBuf,
    _watchdog: Watchdog,
}

impl Terminal {
    /// Runs a scene there, until its session exists.
    pub fn new(act: Act, scene: &Path, output: &Path) -> Terminal {
        let mut command = Command::new("python3");
        command.args(["-c", &script(act), env!("CARGO_BIN_EXE_trabecula"), "run"]);
        command.arg(scene).arg("--output").arg(output).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut script = Guarded(command.spawn().unwrap());
        let watchdog = Watchdog::over(&script.0, COMMAND_LIMIT);
        let mut said = BufReader::new(script.0.stdout.take().unwrap()).lines();
        let launcher: u32 = said.next().unwrap().unwrap().parse().unwrap();
        let session =
            wait_for("the session", || Some(session_folder(launcher)).filter(|folder| folder.exists()));
        Terminal { script, said, launcher, session, _watchdog: watchdog }
    }

    /// Makes the script act, once.
    pub fn tell(&mut self, what: &str) {
        writeln!(self.script.0.stdin.take().unwrap(), "{what}").unwrap();
    }

    /// Returns the next line that the script prints.
    pub fn next_line(&mut self) -> String {
        self.said.next().unwrap().unwrap()
    }
}
