//! Output files are complete under their names, or absent, when the command is killed, when the disk is full,
//! and when another program takes the name in the meantime.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use output_file::DRAFT_PREFIX;
use rustix::process::Signal;
use test_support::limited::{Limited, end_within, limited_output_of};

use crate::common::program::{LIMIT, Place, files_below, signal, succeed, wait_for};
use crate::common::scenes;

/// Content of a file that exists before a command or appears meanwhile.
const MINE: &[u8] = b"a user's own work";

/// A log with a volume and frames, a file of two runs, a volume and a sweep, in their own folder.
struct Inputs(Place);

impl Inputs {
    fn new(duration_s: f64) -> Inputs {
        let place = Place::new();
        let sweep = "tension_sweep = { most_n = 2.0, step_n = 1.0, settle_s = 0.05 }";
        let scene = scenes::hold("lockstep", 60.0).replace("hold = { tension_n = 2.0 }", sweep);
        fs::write(place.path("sweep.toml"), scene).unwrap();
        let folder = place.complete(&scenes::drill("lockstep", duration_s)).folder;
        fs::rename(folder, place.path("log")).unwrap();
        let (log, ball, two) = (place.path("log"), place.path("ball.nrrd"), place.path("two.mcap"));
        succeed(&[&"phantom", &"sphere", &"-o", &ball, &"--spacing-mm", &"2"]);
        succeed(&[&"log", &"cat-files", &log, &log, &"-o", &two]);
        Inputs(place)
    }

    /// Returns a command's arguments: `@` is replaced by the inputs' folder, `#` by the outputs'.
    fn command(&self, words: &str, outputs: &Path) -> Vec<String> {
        let inputs = self.0.path("");
        let place = |word: &str| {
            word.replace('@', inputs.to_str().unwrap()).replace('#', &format!("{}/", outputs.display()))
        };
        words.split(' ').map(place).collect()
    }
}

/// Commands that leave files behind, and a name that appears in the error for one that cannot be written.
const COMMANDS: [(&str, &str); 18] = [
    ("log export @log -o #t.csv", "t.csv"),
    ("log export @log -o #t.parquet", "t.parquet"),
    ("log export @log --frames -o #pictures", "frame_000001"),
    ("log export @log --dataset coco -o #set", "frame_000001"),
    ("log compress @log -o #c.mcap", "c.mcap"),
    ("log repair @log -o #r.mcap", "r.mcap"),
    ("log cat-files @log @log -o #both.mcap", "both.mcap"),
    ("log split @two.mcap -o #runs", "runs/run1.mcap"),
    ("replay @log --output #again", "again/run.mcap"),
    ("plot @log t_world_tip.position_m --output #f", "f.png"),
    ("drr @ball.nrrd -o #x.png", "x.png"),
    ("drr @ball.nrrd -o #x.nrrd", "x.nrrd"),
    ("drr @ball.nrrd -o #x.dcm", "x.dcm"),
    ("drr @ball.nrrd -o #x.png --sweep 90 --frames 6 --animate --columns 256 --rows 256", "x.png"),
    ("drr @ball.nrrd -o #s.png --sweep 90 --frames 3", "s_0000.png"),
    ("phantom sphere -o #p.nrrd --spacing-mm 0.5", "p.nrrd"),
    ("volume drilled @log -o #d.nrrd", "d.nrrd"),
    ("calibrate @sweep.toml -o #cal", "calibration.csv"),
];

fn is_draft(path: &Path) -> bool {
    path.file_name().unwrap().to_str().unwrap().starts_with(DRAFT_PREFIX)
}

fn start(words: &[String]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    let command = command.args(words).stdin(Stdio::null()).stdout(Stdio::null());
    command.stderr(Stdio::piped()).spawn().unwrap()
}

/// Regression: `log export`, `log compress`, `replay --output`, `drr --animate` and `plot` left an incomplete
/// or empty file under its name.
#[test]
fn a_killed_command_leaves_no_half_file_under_its_name() {
    const KILLS: u64 = 4;
    let inputs = Inputs::new(2.0);
    let mut random = fastrand::Rng::with_seed(17);
    let (mut killed, mut drafts) = (0, 0);
    // Those that take a tenth of a second or more: the others end before they can be killed, and use the same
    // code.
    for number in [0, 1, 2, 3, 4, 6, 7, 8, 12, 15] {
        let (words, _) = COMMANDS[number];
        let whole = Place::new();
        let began = std::time::Instant::now();
        let mut child = start(&inputs.command(words, &whole.path("")));
        assert!(end_within(&mut child, LIMIT, words).success(), "{words}");
        let took = began.elapsed();
        let whole = files_below(&whole.path(""));
        assert!(!whole.is_empty() && whole.iter().all(|(_, bytes)| !bytes.is_empty()), "{words}");
        for kill in 0..KILLS {
            let place = Place::new();
            let mut child = start(&inputs.command(words, &place.path("")));
            // The later moments, in which files are written, more often.
            let share = (kill as f64 + random.f64()) / KILLS as f64;
            std::thread::sleep(took.mul_f64(0.2 + 0.8 * share));
            let _ = child.kill();
            killed += usize::from(!end_within(&mut child, LIMIT, words).success());
            for (path, bytes) in files_below(&place.path("")) {
                if is_draft(&path) {
                    drafts += 1;
                    continue;
                }
                let known = whole.iter().find(|(name, _)| *name == path);
                let (_, expected) = known.unwrap_or_else(|| panic!("{words}: {} is left", path.display()));
                let (left, all) = (bytes.len(), expected.len());
                assert!(bytes == *expected, "{words}: {} of {left} bytes, not {all}", path.display());
            }
        }
    }
    println!(
        "{killed} commands were killed before their end; {drafts} left a draft, on a file system where drafts need names"
    );
    assert!(killed > 0);
}

/// Asserts the error for outputs on a full disk, or in a process whose files are limited to half a kilobyte.
fn assert_told(inputs: &Inputs, outputs: &Path, mut command: impl FnMut() -> Command, cause: &str) {
    let before = files_below(outputs);
    for (words, name) in COMMANDS {
        let output = command().args(inputs.command(words, outputs)).limited_output().unwrap();
        let err = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{words}: {:?} {err}", output.status);
        assert!(err.contains(name) && err.contains(cause) && !err.contains(DRAFT_PREFIX), "{words}: {err}");
        let left: Vec<PathBuf> = files_below(outputs).into_iter().map(|(path, _)| path).collect();
        assert_eq!(left.len(), before.len(), "{words} leaves {left:?}");
    }
}

/// Regression: `log export` and `phantom` ended with 2 and named no file; any command that reached the file
/// size limit was killed by the system without a message.
#[test]
fn a_file_that_cannot_grow_is_told_by_name_with_1_and_is_not_left() {
    let (inputs, place) = (Inputs::new(0.3), Place::new());
    let limited = || {
        let mut command = Command::new("sh");
        command.args(["-c", "ulimit -c 0; ulimit -f 1; exec \"$@\"", "sh", env!("CARGO_BIN_EXE_trabecula")]);
        command
    };
    assert_told(&inputs, &place.path(""), limited, "File too large");
}

/// Regression: with some 130 open files the run hung, with fewer it blamed a log or `/dev/shm`.
#[test]
fn too_few_open_files_are_raised_where_they_may_be_and_told_otherwise() {
    let place = Place::new();
    let scene = place.scene(&scenes::drill("lockstep", 0.1));
    let run = |limit: &str| {
        let mut command = Command::new("sh");
        command.args(["-c", &format!("{limit}; exec \"$@\""), "sh", env!("CARGO_BIN_EXE_trabecula")]);
        command.arg("run").arg(&scene).args(["--quiet", "--output"]).arg(place.path("out"));
        let output = command.limited_output().unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    let (code, said) = run("ulimit -S -n 64");
    assert_eq!(code, Some(0), "{said}");
    for most in [64, 132, 255] {
        let (code, said) = run(&format!("ulimit -n {most}"));
        let expected =
            format!("open file limit is {most}, a session needs 256: raise it with `ulimit -n 256`");
        assert!(code == Some(1) && said.contains(&expected), "{code:?} {said}");
    }
}

#[test]
fn a_full_disk_is_told_by_name_with_1_and_nothing_is_left() {
    let (inputs, place) = (Inputs::new(0.3), Place::new());
    let disk = place.path("disk");
    fs::create_dir(&disk).unwrap();
    let mounted =
        Command::new("mount").args(["-t", "tmpfs", "-o", "size=64k", "none"]).arg(&disk).limited_output();
    if !mounted.as_ref().is_ok_and(|output| output.status.success()) {
        eprintln!("SKIPPED: no file system of a few kB can be mounted here ({mounted:?})");
        return;
    }
    struct Mounted<'a>(&'a Path);
    impl Drop for Mounted<'_> {
        fn drop(&mut self) {
            let _ = Command::new("umount").arg("-l").arg(self.0).limited_output();
        }
    }
    let _mounted = Mounted(&disk);
    let outputs = disk.join("outputs");
    fs::create_dir(&outputs).unwrap();
    let mut bytes = vec![0; 128 << 10];
    while !bytes.is_empty() {
        let filled = fs::write(disk.join(format!("filler{}", bytes.len())), &bytes).is_ok();
        bytes.truncate(if filled { bytes.len() } else { bytes.len() / 2 });
        if filled && bytes.len() < 4096 {
            break;
        }
    }
    let whole = || Command::new(env!("CARGO_BIN_EXE_trabecula"));
    assert_told(&inputs, &outputs, whole, "No space left");
}

/// Regression: an empty file reserved the name; a file put in its place was lost.
#[test]
fn what_another_program_puts_there_meanwhile_stays() {
    let inputs = Inputs::new(4.0);
    let rows = [
        ("log export @log -o #t.csv", "t.csv"),
        ("log compress @log -o #c.mcap", "c.mcap"),
        ("replay @log --output #", "run.mcap"),
    ];
    for (words, name) in rows {
        // A command may be over before it is seen; most are not.
        let caught = (0..50).any(|_| {
            let place = Place::new();
            let (folder, file) = (place.path(""), place.path(name));
            let mut child = start(&inputs.command(words, &folder));
            // An open draft, with or without a name.
            let opened = PathBuf::from(format!("/proc/{}/fd", child.id()));
            let is_writing = || {
                let mut files = fs::read_dir(&opened).into_iter().flatten().flatten();
                files.any(|file| fs::read_link(file.path()).is_ok_and(|file| file.starts_with(&folder)))
            };
            while !is_writing() && child.try_wait().unwrap().is_none() {
                std::thread::sleep(Duration::from_millis(1));
            }
            signal(child.id(), Signal::STOP);
            wait_for("a process that stands still or has ended", || {
                let stat = fs::read_to_string(format!("/proc/{}/stat", child.id())).unwrap();
                [") T ", ") Z "].iter().any(|state| stat.contains(state)).then_some(())
            });
            let is_in_time = is_writing() && !file.exists();
            if is_in_time {
                fs::write(&file, MINE).unwrap();
            }
            signal(child.id(), Signal::CONT);
            let output = limited_output_of(child, LIMIT, words);
            let err = String::from_utf8_lossy(&output.stderr);
            if is_in_time {
                assert_eq!(output.status.code(), Some(2), "{words}: {err}");
                assert!(err.contains(&format!("{name}: already exists")), "{words}: {err}");
                assert_eq!(files_below(&folder), [(PathBuf::from(name), MINE.to_vec())], "{words}");
            }
            is_in_time
        });
        assert!(caught, "{words}: was never seen while it wrote");
    }
}
