//! Starts the program, and inspects its processes and what it leaves behind.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{LazyLock, Mutex, PoisonError};
use std::time::{Duration, Instant};
use test_support::limited::{COMMAND_LIMIT, Limited, Watchdog};

use ipc_types::process::descendants;
use ipc_types::session::{SessionId, places};
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

/// Long enough for any test on a loaded machine; only a hang reaches it.
pub const LIMIT: Duration = Duration::from_secs(90);
const LOOK: Duration = Duration::from_millis(5);

/// How a command ended, and its output.
#[derive(Debug)]
pub struct Done {
    /// Exit code; `None` after a signal.
    pub code: Option<i32>,
    pub out: String,
    pub err: String,
}

/// Runs the program to its end.
pub fn trabecula(arguments: &[&dyn AsRef<OsStr>]) -> Done {
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    arguments.iter().for_each(|argument| {
        command.arg(argument);
    });
    let output = command.limited_output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    Done { code: output.status.code(), out: text(&output.stdout), err: text(&output.stderr) }
}

/// Runs the program, which must succeed.
pub fn succeed(arguments: &[&dyn AsRef<OsStr>]) -> Done {
    let done = trabecula(arguments);
    assert_eq!(done.code, Some(0), "{}", done.err);
    done
}

/// The same as [`trabecula`] for words of one type.
pub fn call<W: AsRef<OsStr>>(words: &[W]) -> Done {
    trabecula(&as_words(words))
}

pub fn as_words<W: AsRef<OsStr>>(words: &[W]) -> Vec<&dyn AsRef<OsStr>> {
    words.iter().map(|word| word as &dyn AsRef<OsStr>).collect()
}

/// Returns the first line that a program prints.
pub fn first_line(program: &mut Child) -> String {
    let watchdog = Watchdog::over(program, COMMAND_LIMIT);
    let mut line = String::new();
    BufReader::new(program.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
    drop(watchdog);
    line
}

/// Returns names and contents of all files below a folder; a dangling link has no content.
pub fn files_below(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let (mut found, mut folders) = (Vec::new(), vec![folder.to_owned()]);
    while let Some(below) = folders.pop() {
        for path in fs::read_dir(below).unwrap().flatten().map(|entry| entry.path()) {
            let name = path.strip_prefix(folder).unwrap().to_owned();
            match path.is_dir() {
                true => folders.push(path),
                false => found.push((name, fs::read(path).unwrap_or_default())),
            }
        }
    }
    found.sort();
    found
}

/// Returns IDs and command lines of the processes that have one of these words in their command line.
pub fn processes_with<W: AsRef<str>>(words: &[W]) -> Vec<(u32, String)> {
    let line = |entry: fs::DirEntry| {
        let pid = entry.file_name().to_str()?.parse().ok()?;
        let line = fs::read(entry.path().join("cmdline")).ok()?;
        let line = String::from_utf8_lossy(&line).replace('\0', " ");
        words.iter().any(|word| line.contains(word.as_ref())).then_some((pid, line))
    };
    fs::read_dir("/proc").unwrap().flatten().filter_map(line).collect()
}

/// Waits until `found` returns something.
pub fn wait_for<T>(what: &str, found: impl FnMut() -> Option<T>) -> T {
    wait_or_tell(found, || {
        format!("{what} did not happen within {LIMIT:?}\n{}", threads_of(std::process::id()))
    })
}

/// The same; `tell` describes what did not happen, with details.
fn wait_or_tell<T>(mut found: impl FnMut() -> Option<T>, tell: impl FnOnce() -> String) -> T {
    let end = Instant::now() + LIMIT;
    while Instant::now() < end {
        if let Some(value) = found() {
            return value;
        }
        std::thread::sleep(LOOK);
    }
    panic!("{}", tell())
}

/// Sends a signal; the process may have ended already.
pub fn signal(pid: u32, signal: Signal) {
    let _ = kill_process(Pid::from_raw(pid as i32).unwrap(), signal);
}

/// A process that is killed when the test ends, in any way.
#[derive(Debug)]
pub struct Guarded(pub Child);

impl Drop for Guarded {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Returns the only entry of a folder.
pub fn only_entry(folder: &Path) -> PathBuf {
    fs::read_dir(folder).unwrap().next().unwrap().unwrap().path()
}

/// A test's own folder, and the test's limit.
#[derive(Debug)]
pub struct Place(TempDir, Watchdog);

impl Place {
    pub fn new() -> Place {
        Place(tempfile::tempdir().unwrap(), Watchdog::over_test())
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Writes a scene file.
    pub fn scene(&self, text: &str) -> PathBuf {
        let path = self.path("scene.toml");
        fs::write(&path, text).unwrap();
        path
    }

    /// Returns the words of a line; `@` is this folder.
    pub fn words(&self, line: &str) -> Vec<String> {
        let here = self.path("");
        line.split(' ').map(|word| word.replace('@', here.to_str().unwrap())).collect()
    }

    /// Returns the names of everything in the folder.
    pub fn entries(&self) -> Vec<String> {
        let name = |entry: fs::DirEntry| entry.file_name().to_string_lossy().into_owned();
        let mut names: Vec<String> = fs::read_dir(self.0.path()).unwrap().flatten().map(name).collect();
        names.sort();
        names
    }

    /// Starts a run of a scene.
    pub fn start(&self, scene: &str) -> Run {
        let scene = self.scene(scene);
        Run::start(&scene, self.path("out"), &[])
    }

    /// Completes a run that must succeed.
    pub fn complete(&self, scene: &str) -> Ended {
        self.start(scene).end_well()
    }
}

/// A running run.
#[derive(Debug)]
pub struct Run {
    child: Child,
    output: PathBuf,
    words: TempDir,
}

/// A run that has ended.
#[derive(Debug)]
pub struct Ended {
    /// Exit code; `None` after a signal.
    pub code: Option<i32>,
    pub out: String,
    pub err: String,
    /// Folder of the run.
    pub folder: PathBuf,
    /// Process ID of the launcher.
    pub pid: u32,
}

impl Run {
    pub fn start(scene: &Path, output: PathBuf, more: &[&str]) -> Run {
        let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
        command.arg("run").arg(scene).arg("--output").arg(&output).arg("--quiet").args(more);
        Run::of(command, output)
    }

    /// Starts a command that becomes the launcher of a run with this output.
    pub fn of(mut command: Command, output: PathBuf) -> Run {
        LazyLock::force(&BEFORE);
        let words = tempfile::tempdir().unwrap();
        let file = |name: &str| File::create(words.path().join(name)).unwrap();
        let command = command.stdin(Stdio::null()).stdout(file("out")).stderr(file("err"));
        let child = command.spawn().unwrap();
        // The process ID may have been another launcher's.
        SEEN.lock().unwrap_or_else(PoisonError::into_inner).remove(&child.id());
        Run { child, output, words }
    }

    /// What the launcher has written to standard error so far.
    pub fn said(&self) -> String {
        fs::read_to_string(self.words.path().join("err")).unwrap()
    }

    /// What the launcher has written to standard output so far.
    pub fn shown(&self) -> String {
        fs::read_to_string(self.words.path().join("out")).unwrap()
    }

    /// The log of the run, once it exists.
    pub fn log(&self) -> Option<PathBuf> {
        let folder = fs::read_dir(&self.output).ok()?.flatten().next()?.path();
        Some(folder.join("run.mcap")).filter(|log| log.exists())
    }

    /// Whether the launcher has ended.
    pub fn is_over(&mut self) -> bool {
        self.child.try_wait().unwrap().is_some()
    }

    /// Process ID of the launcher.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Folder of the session, once it is announced.
    pub fn session(&self) -> PathBuf {
        wait_for("the session's announcement", || session_of(self.pid()))
    }

    /// Process ID of a part (`physics`, `drr`, `controller`, `recorder`), once it exists.
    pub fn part(&self, name: &str) -> u32 {
        let session = self.session();
        wait_for(name, || parts_of(&session).into_iter().find(|(part, _)| part == name).map(|(_, pid)| pid))
    }

    /// Waits for the end of the launcher.
    pub fn end(mut self) -> Ended {
        let pid = self.pid();
        let over = || {
            // So that leftovers can be searched for afterwards.
            let _ = session_of(pid);
            self.child.try_wait().unwrap()
        };
        let words = self.words.path().join("err");
        let status = wait_or_tell(over, || {
            let said = fs::read_to_string(&words).unwrap_or_default();
            format!("no end of the run within {LIMIT:?}\n{said}\n{}", threads_of(pid))
        });
        let text = |name: &str| fs::read_to_string(self.words.path().join(name)).unwrap();
        let folders = fs::read_dir(&self.output).map(|entries| entries.flatten().map(|e| e.path()).collect());
        let folders: Vec<PathBuf> = folders.unwrap_or_default();
        // Of several runs of a test, the last one; a folder lists them in any order.
        let written = |folder: &PathBuf| fs::metadata(folder).and_then(|it| it.modified()).ok();
        let folder = folders.into_iter().max_by_key(written).unwrap_or_default();
        Ended { code: status.code(), out: text("out"), err: text("err"), folder, pid }
    }

    /// The same; the run must succeed.
    pub fn end_well(self) -> Ended {
        let ended = self.end();
        assert_eq!(ended.code, Some(0), "{}", ended.err);
        ended
    }
}

impl Ended {
    /// Returns the figures of `summary.json`.
    pub fn summary(&self) -> serde_json::Value {
        serde_json::from_slice(&fs::read(self.folder.join("summary.json")).unwrap()).unwrap()
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        // A failing test leaves nothing running: the parts end with the launcher.
        if matches!(self.child.try_wait(), Ok(None)) {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}

/// Sessions by their launchers.
static SEEN: Mutex<BTreeMap<u32, PathBuf>> = Mutex::new(BTreeMap::new());

/// Returns the session of a launcher, from its announcement. It is remembered, so that leftovers can be
/// searched for by its name.
fn session_of(launcher: u32) -> Option<PathBuf> {
    let mut seen = SEEN.lock().unwrap_or_else(PoisonError::into_inner);
    if let Entry::Vacant(place) = seen.entry(launcher) {
        let entries = places().into_iter().flat_map(|place| fs::read_dir(place.path()).into_iter().flatten());
        let pid = format!("\"pid\": {launcher},");
        let is_its = |folder: &PathBuf| {
            fs::read_to_string(folder.join("session.json")).is_ok_and(|text| text.contains(&pid))
        };
        let found = entries.flatten().map(|entry| entry.path()).find(is_its)?;
        place.insert(found);
    }
    seen.get(&launcher).cloned()
}

/// Returns the path of a launcher's session; before its announcement, a path where nothing exists.
pub fn session_folder(launcher: u32) -> PathBuf {
    session_of(launcher).unwrap_or_else(|| PathBuf::from(format!("/nowhere/session-of-{launcher}")))
}

/// Returns the processes that were started for a session: the part's name and the process ID.
pub fn parts_of(session: &Path) -> Vec<(String, u32)> {
    let mut parts = Vec::new();
    for entry in fs::read_dir("/proc").unwrap().flatten() {
        let Some(pid) = entry.file_name().to_str().and_then(|name| name.parse::<u32>().ok()) else {
            continue;
        };
        let line = fs::read(entry.path().join("cmdline")).unwrap_or_default();
        let words: Vec<String> =
            line.split(|byte| *byte == 0).map(|w| String::from_utf8_lossy(w).into_owned()).collect();
        if words.iter().any(|word| Path::new(word) == session)
            && let Some(at) = words.iter().position(|word| word == "proc")
        {
            parts.push((words[at + 1].clone(), pid));
        }
    }
    parts
}

/// Returns what each thread of a process and of its descendants waits for, according to the kernel.
fn threads_of(root: u32) -> String {
    let root = Pid::from_raw(root as i32).unwrap();
    let mut text = String::new();
    for pid in std::iter::once(root).chain(descendants(root)) {
        let process = PathBuf::from(format!("/proc/{}", pid.as_raw_nonzero()));
        let of = |path: PathBuf| fs::read_to_string(path).unwrap_or_default().replace('\0', " ");
        text += &format!("{}: {}\n", pid.as_raw_nonzero(), of(process.join("cmdline")));
        for thread in fs::read_dir(process.join("task")).into_iter().flatten().flatten().map(|it| it.path()) {
            let stat = of(thread.join("stat"));
            let state = stat.rsplit_once(')').map_or("", |(_, rest)| rest.get(1..2).unwrap_or(""));
            let [name, wait, call] =
                ["comm", "wchan", "syscall"].map(|file| of(thread.join(file)).trim().to_owned());
            text += &format!("  {name} {state} {wait} {call}\n{}", of(thread.join("stack")));
        }
    }
    text
}

fn names_in_shared_memory() -> impl Iterator<Item = String> {
    fs::read_dir("/dev/shm").unwrap().flatten().map(|entry| entry.file_name().to_string_lossy().into_owned())
}

/// The content of /dev/shm before the first run of these tests. A new process may get the ID of one that left
/// something there.
static BEFORE: LazyLock<BTreeSet<String>> = LazyLock::new(|| names_in_shared_memory().collect());

/// Returns the names in /dev/shm that belong to the sessions of a launcher. The transport numbers its files,
/// and bits 64 to 95 of each number are the ID of the process that created it.
pub fn shared_memory_of(launcher: u32) -> Vec<String> {
    let made_by = |number: &str| number.parse::<u128>().map(|number| (number >> 64) as u32);
    let is_its = |name: &String| {
        name.starts_with("trabecula010_") && name.split(['_', '.']).any(|part| made_by(part) == Ok(launcher))
    };
    names_in_shared_memory().filter(|name| !BEFORE.contains(name)).filter(is_its).collect()
}

/// Names of a session's segments in /dev/shm.
pub fn segments_of(session: &Path) -> Vec<String> {
    let prefix = SessionId::of(session).unwrap().shared_memory_prefix();
    names_in_shared_memory().filter(|name| name.starts_with(&prefix)).collect()
}

/// Returns the session in a run-time folder, once it is announced.
pub fn session_below(runtime: &Path) -> PathBuf {
    wait_for("a session", || {
        let folders = fs::read_dir(runtime.join("trabecula-hubs")).ok()?.flatten();
        folders.map(|entry| entry.path()).find(|folder| folder.join("session.json").exists())
    })
}

/// Kills a launcher and all its parts, so that none of them cleans up.
pub fn kill_all(launcher: u32, session: &Path) {
    signal(launcher, Signal::STOP);
    parts_of(session).iter().for_each(|(_, pid)| signal(*pid, Signal::KILL));
    signal(launcher, Signal::KILL);
}

/// No process, no session, no shared memory of a launcher.
pub fn assert_nothing_left(launcher: u32) {
    let session = session_folder(launcher);
    assert_eq!(parts_of(&session), [], "processes of {} still run", session.display());
    assert!(!session.exists(), "{} is left", session.display());
    assert_eq!(shared_memory_of(launcher), Vec::<String>::new());
}

/// Processes that keep a core busy each until dropped.
#[derive(Debug)]
pub struct BusyLoops(Vec<Child>);

impl BusyLoops {
    pub fn start(count: usize) -> BusyLoops {
        let start = |_| Command::new("sh").args(["-c", "while :; do :; done"]).spawn().unwrap();
        BusyLoops((0..count).map(start).collect())
    }
}

impl Drop for BusyLoops {
    fn drop(&mut self) {
        for child in &mut self.0 {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}
