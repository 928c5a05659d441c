//! A run started from the page.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::time::{Duration, Instant};

use ipc_types::process::EndRequest;
use serde_json::Value;

use crate::launcher::volume_source::VolumeFiles;

/// Interval at which the end of a run is polled.
const LOOK: Duration = Duration::from_millis(50);
/// Timeout for the remaining output of a run that has ended.
const WORDS_LIMIT: Duration = Duration::from_secs(2);
/// Maximum length of the kept error output, in bytes.
const LONGEST_WORDS: usize = 4096;

/// `trabecula run FILE` as a child process. It records to the same folder as that command in this terminal
/// would, and continues if the viewer ends.
#[derive(Debug)]
pub struct StartedRun {
    child: Child,
    /// JSON lines from its standard output.
    lines: Receiver<Value>,
    /// Lines from its standard error.
    words: Receiver<String>,
    session: Option<PathBuf>,
    folder: Option<PathBuf>,
}

impl StartedRun {
    /// Starts the run.
    pub fn start(scene: &Path, files: VolumeFiles) -> Result<StartedRun, String> {
        let refused = |cause: std::io::Error| format!("`trabecula run` cannot be started: {cause}");
        let mut command = Command::new(std::env::current_exe().map_err(refused)?);
        command.arg("run").arg(scene).arg("--json");
        if files.allow_elsewhere {
            command.arg("--allow-elsewhere");
        }
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().map_err(refused)?;
        let (line, lines) = mpsc::channel();
        let (word, words) = mpsc::channel();
        let (out, err) = (child.stdout.take(), child.stderr.take());
        let read_out = move || {
            let is_wanted = |value: &Value| value["phase"] == "announced" || value["phase"] == "ended";
            // Read to the end, so that the run never blocks on a full pipe.
            each_line(out, |text| {
                let value = serde_json::from_str(text).ok().filter(is_wanted);
                value.into_iter().for_each(|value| drop(line.send(value)));
            });
        };
        let read_err = move || {
            each_line(err, |text| {
                tell!("{text}");
                // The receiver is not read once the run has started.
                let _ = word.send(text.to_owned());
            });
        };
        let thread = || std::thread::Builder::new().name("run output".to_owned());
        if let Err(cause) = thread().spawn(read_out).and_then(|_| thread().spawn(read_err)) {
            // Unread, it would wait for room in its pipes; its parts end with it.
            let _ = child.kill().and_then(|()| child.wait());
            return Err(refused(cause));
        }
        say!("running      {}", scene.display());
        Ok(StartedRun { child, lines, words, session: None, folder: None })
    }

    /// Returns, once, the session when it can be joined, or why the run failed before that.
    pub fn begun(&mut self) -> Option<Result<PathBuf, String>> {
        if self.session.is_some() {
            return None;
        }
        self.read();
        if let Some(session) = &self.session {
            return Some(Ok(session.clone()));
        }
        self.child.try_wait().ok().flatten()?;
        // Its error output may still be in transit.
        let began = Instant::now();
        let mut said = String::new();
        while let Ok(line) = self.words.recv_timeout(WORDS_LIMIT.saturating_sub(began.elapsed())) {
            if said.len() < LONGEST_WORDS {
                said += &line;
                said.push('\n');
            }
        }
        self.read();
        match &self.session {
            Some(session) => Some(Ok(session.clone())),
            None => Some(Err(format!("the run did not start: {}", said.trim()))),
        }
    }

    fn read(&mut self) {
        for line in self.lines.try_iter() {
            let text = |key: &str| line.get(key).and_then(Value::as_str).map(PathBuf::from);
            self.session = self.session.take().or_else(|| text("session"));
            self.folder = text("folder").or_else(|| self.folder.take());
        }
    }

    /// Returns the session of the run.
    pub fn session(&self) -> Option<&Path> {
        self.session.as_deref()
    }

    /// Waits until the run ends or the user ends the viewer, and returns the run's log if it recorded one.
    pub fn log(mut self, end: &EndRequest) -> Option<PathBuf> {
        while !end.is_set() && self.child.try_wait().is_ok_and(|ended| ended.is_none()) {
            std::thread::sleep(LOOK);
        }
        let began = Instant::now();
        while self.folder.is_none()
            && let Ok(line) = self.lines.recv_timeout(WORDS_LIMIT.saturating_sub(began.elapsed()))
        {
            self.folder = line.get("folder").and_then(Value::as_str).map(PathBuf::from);
        }
        self.folder
    }
}

fn each_line(source: Option<impl Read>, mut take: impl FnMut(&str)) {
    let Some(source) = source else { return };
    let mut source = BufReader::new(source);
    let mut bytes = Vec::new();
    while source.read_until(b'\n', &mut bytes).is_ok_and(|count| count > 0) {
        take(String::from_utf8_lossy(&bytes).trim_end());
        bytes.clear();
    }
}
