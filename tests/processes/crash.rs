//! What a run leaves on disk after a power failure. Uses a file system in a file that is copied as it is on
//! the disk and, without privileges, the order in which files are synced.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use ipc_types::messages::CONTROL_PAUSE;
use rustix::process::Signal;

use test_support::limited::Limited;

use crate::common::client::Client;
use crate::common::logs::assert_replays;
use crate::common::preload;
use crate::common::program::{Place, Run, assert_nothing_left, signal, trabecula, wait_for};
use crate::common::scenes;

fn tool(name: &str, arguments: &[&dyn AsRef<std::ffi::OsStr>]) -> std::io::Result<Output> {
    let mut command = Command::new(name);
    // Some systems keep these tools outside the user's path.
    command.env("PATH", format!("{}:/usr/sbin:/sbin", std::env::var("PATH").unwrap_or_default()));
    arguments.iter().for_each(|argument| {
        command.arg(argument);
    });
    command.limited_output()
}

fn done(name: &str, arguments: &[&dyn AsRef<std::ffi::OsStr>]) -> Result<(), String> {
    match tool(name, arguments) {
        Ok(output) if output.status.success() => Ok(()),
        Ok(output) => Err(format!("{name}: {}", String::from_utf8_lossy(&output.stderr).trim())),
        Err(cause) => Err(format!("{name}: {cause}")),
    }
}

/// An ext4 file system in a file, mounted. Its journal is not committed periodically: only synced data are on
/// the disk.
struct Disk {
    place: Place,
}

impl Disk {
    fn mount() -> Result<Disk, String> {
        let place = Place::new();
        let (image, mounted) = (place.path("image"), place.path("disk"));
        fs::File::create(&image).unwrap().set_len(96 << 20).unwrap();
        fs::create_dir(&mounted).unwrap();
        done("mkfs.ext4", &[&"-q", &"-F", &image])?;
        done("mount", &[&"-o", &"loop,commit=300", &image, &mounted])?;
        Ok(Disk { place })
    }

    fn folder(&self) -> PathBuf {
        self.place.path("disk")
    }

    /// Copies the disk in its current state.
    fn copy(&self) -> PathBuf {
        let copy = self.place.path("copy");
        done("cp", &[&"--sparse=always", &self.place.path("image"), &copy]).unwrap();
        copy
    }

    /// Returns the folder of runs as found after a reboot with such a disk.
    fn after_a_crash(&self, copy: &Path, name: &str) -> PathBuf {
        let tree = self.place.path(name);
        // 0: nothing to repair; 1: repaired, as by the journal.
        let checked = tool("e2fsck", &[&"-fy", &copy]).unwrap();
        assert!(
            checked.status.code().is_some_and(|code| code < 4),
            "{}",
            String::from_utf8_lossy(&checked.stdout)
        );
        fs::create_dir(&tree).unwrap();
        done("debugfs", &[&"-R", &format!("rdump /out {}", tree.display()), &copy]).unwrap();
        tree.join("out")
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = done("umount", &[&"-l", &self.folder()]);
    }
}

/// Returns the contents of all files in the only folder of a folder.
fn files(out: &Path) -> BTreeMap<String, Vec<u8>> {
    let Some(folder) = fs::read_dir(out).ok().and_then(|mut all| all.next()) else { return BTreeMap::new() };
    let entries = fs::read_dir(folder.unwrap().path()).unwrap().flatten();
    entries.map(|e| (e.file_name().to_string_lossy().into_owned(), fs::read(e.path()).unwrap())).collect()
}

fn disk() -> Option<Disk> {
    match Disk::mount() {
        Ok(disk) => Some(disk),
        Err(cause) => {
            eprintln!("SKIPPED: no file system in a file can be mounted here ({cause})");
            None
        }
    }
}

/// Regression: 0.2 s after "completed" there was no run folder; after 3 s pictures and summary were empty.
#[test]
fn a_completed_run_survives_a_crash_of_the_machine() {
    let Some(disk) = disk() else { return };
    let place = Place::new();
    let scene = place.scene(&format!("{}{}", scenes::drill("lockstep", 1.5), scenes::keyframes(0.5)));
    let run = Run::start(&scene, disk.folder().join("out"), &[]);
    wait_for("the summary", || run.shown().contains("completed").then_some(()));
    let first = disk.after_a_crash(&disk.copy(), "first");
    run.end_well();
    std::thread::sleep(std::time::Duration::from_millis(150));
    let second = disk.after_a_crash(&disk.copy(), "second");
    let whole = files(&disk.folder().join("out"));
    assert!(whole.len() >= 9 && whole.values().all(|bytes| !bytes.is_empty()), "{:?}", whole.keys());
    for copy in [first, second] {
        let found = files(&copy);
        let names = |files: &BTreeMap<String, Vec<u8>>| -> Vec<(String, usize)> {
            files.iter().map(|(name, bytes)| (name.clone(), bytes.len())).collect()
        };
        assert_eq!(names(&found), names(&whole), "bytes of each file");
        assert!(found == whole, "the same lengths, but other bytes");
        assert_replays(&fs::read_dir(&copy).unwrap().next().unwrap().unwrap().path());
    }
}

/// Messages published before a pause are soon on the disk, except those of the open chunk, while the run
/// continues; in the middle of a chunk, everything on the disk can be read.
#[test]
fn a_run_under_way_survives_a_crash_of_the_machine() {
    let Some(disk) = disk() else { return };
    let place = Place::new();
    let scene = place.scene(&format!("{}{}", scenes::hold("realtime", 600.0), scenes::keyframes(0.5)));
    let run = Run::start(&scene, disk.folder().join("out"), &[]);
    let client = Client::join(&run.session());
    let recorder = run.part("recorder");
    let mut copies = 0;
    let mut ticks_after_a_crash = || {
        copies += 1;
        // Nothing is written in between, so the copy is a consistent snapshot.
        signal(recorder, Signal::STOP);
        let copy = disk.copy();
        signal(recorder, Signal::CONT);
        let out = disk.after_a_crash(&copy, &format!("tree{copies}"));
        let folder = fs::read_dir(&out).unwrap().next().expect("the folder of the run").unwrap().path();
        let said = trabecula(&[&"replay", &folder, &"--verify"]);
        let last = said.out.split("last tick ").nth(1).and_then(|rest| rest.split(',').next());
        last.and_then(|tick| tick.parse::<u64>().ok())
    };
    client.wait_for_state(|state| state.tick >= 700);
    // As much as was synced by then, possibly nothing yet; but the folder exists.
    let early = ticks_after_a_crash();
    let published = client.ask(CONTROL_PAUSE, 0).tick;
    assert!(early.is_none_or(|tick| tick <= published), "{early:?}");
    // A tick is a millisecond; an incomplete chunk is not written.
    wait_for("the last ticks on the disk", || {
        ticks_after_a_crash().is_some_and(|tick| tick + 100 >= published).then_some(())
    });
    let ended = client.stop(run);
    assert_nothing_left(ended.pid);
}

/// The same without privileges: files, their folder and newly created parent folders are synced before the
/// summary is shown.
#[test]
fn all_files_and_folders_are_brought_to_the_disk_before_the_summary_is_shown() {
    let library = preload::library("processes/sync_order.c");
    let place = Place::new();
    let scene = place.scene(&scenes::drill("lockstep", 0.4));
    let (order, output) = (place.path("order"), place.path("new/out"));
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    command.arg("run").arg(&scene).arg("--output").arg(&output).arg("--quiet");
    command.env("LD_PRELOAD", &library).env("SYNC_ORDER", &order);
    let ended = Run::of(command, output.clone()).end();
    fs::remove_file(&library).unwrap();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    let text = fs::read_to_string(&order).unwrap();
    let before: Vec<u64> = text
        .lines()
        .take_while(|line| *line != "said")
        .map(|line| line.strip_prefix("sync ").unwrap().parse().unwrap())
        .collect();
    let last_sync = |path: &Path| {
        let number = fs::metadata(path).unwrap().ino();
        let place = before.iter().rposition(|synced| *synced == number);
        place.unwrap_or_else(|| panic!("{} was not synced before the summary", path.display()))
    };
    let folder = last_sync(&ended.folder);
    let entries: Vec<PathBuf> = fs::read_dir(&ended.folder).unwrap().flatten().map(|e| e.path()).collect();
    assert!(entries.len() >= 9, "{entries:?}");
    for file in &entries {
        assert!(last_sync(file) < folder, "{} came behind its folder's sync", file.display());
    }
    for above in [output.as_path(), output.parent().unwrap(), &place.path("")] {
        last_sync(above);
    }
}

/// Logs, pictures and summary have the mode set by the user's umask, however they are written.
#[test]
fn files_of_a_run_have_the_mode_that_the_umask_leaves() {
    let place = Place::new();
    let scene = place.scene(&scenes::drill("lockstep", 0.3));
    for (umask, of_folder, of_files) in [("027", 0o750, 0o640), ("077", 0o700, 0o600)] {
        let output = place.path(umask);
        let mut command = Command::new("sh");
        command.arg("-c").arg(format!("umask {umask}; exec \"$@\"")).arg("sh");
        command.arg(env!("CARGO_BIN_EXE_trabecula")).arg("run").arg(&scene);
        command.arg("--output").arg(&output).arg("--quiet");
        let ended = Run::of(command, output).end_well();
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode(&ended.folder), of_folder);
        for file in fs::read_dir(&ended.folder).unwrap().flatten() {
            assert_eq!(mode(&file.path()), of_files, "{:?} under umask {umask}", file.file_name());
        }
    }
}
