//! Who can read and write what: other users of the machine, and untrusted scenes and logs.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use test_support::limited::Limited;

use crate::common::client::Client;
use crate::common::logs::{rename_attachments, rewrite_as, verify};
use crate::common::program::{Place, Run, assert_nothing_left, call, segments_of};
use crate::common::scenes;

/// A user other than the one that runs the session.
const NOBODY: u32 = 65_534;

/// Returns all files of a session: its folder, its contents, and its shared memory.
fn files_of(run: &Run) -> Vec<PathBuf> {
    let segments = segments_of(&run.session());
    let mut files: Vec<PathBuf> = segments.iter().map(|name| Path::new("/dev/shm").join(name)).collect();
    assert!(files.len() > 10, "{files:?}");
    let mut folders = vec![run.session()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap().flatten() {
            if entry.path().is_dir() { folders.push(entry.path()) } else { files.push(entry.path()) }
        }
        files.push(folder);
    }
    files
}

fn is_root() -> bool {
    rustix::process::geteuid().is_root()
}

/// Returns whether a shell command succeeds for another user.
fn nobody_can(script: &str, file: &Path) -> bool {
    let mut shell = Command::new("sh");
    shell.args(["-c", script]).arg(file).uid(NOBODY).gid(NOBODY).current_dir("/");
    shell.limited_output().unwrap().status.success()
}

#[test]
fn another_user_can_neither_read_nor_write_a_session() {
    let place = Place::new();
    let run = place.start(&scenes::drill("realtime", 600.0));
    let client = Client::at(&run, 50);
    let files = files_of(&run);
    for file in &files {
        // A file may be deeper than others can look.
        let mode = fs::symlink_metadata(file).unwrap().mode();
        let hidden = file.starts_with(run.session()) && *file != run.session();
        assert!(hidden || mode & 0o077 == 0, "{}: mode {:o}", file.display(), mode & 0o7777);
        if is_root() {
            assert!(
                !nobody_can("cat \"$0\" || ls \"$0\"/*", file) || file.is_socket(),
                "{} is readable",
                file.display()
            );
            assert!(!nobody_can("test -w \"$0\"", file), "{} is writable", file.display());
        }
    }
    if is_root() {
        println!("another user can open none of the {} files of a session", files.len());
        // The second user's own sessions are unaffected.
        assert!(nobody_can("test -r /dev/shm", Path::new("")), "the second user works");
    } else {
        println!(
            "\n*** SKIPPED in part: only root can become a second user; the modes of {} files are checked ***\n",
            files.len()
        );
    }
    let ended = client.stop(run);
    assert_nothing_left(ended.pid);
}

trait Socket {
    fn is_socket(&self) -> bool;
}

impl Socket for PathBuf {
    fn is_socket(&self) -> bool {
        use std::os::unix::fs::FileTypeExt;
        fs::symlink_metadata(self).is_ok_and(|meta| meta.file_type().is_socket())
    }
}

/// Returns every file below a folder, with its size.
fn tree(folder: &Path) -> Vec<(PathBuf, u64)> {
    let (mut found, mut folders) = (Vec::new(), vec![folder.to_owned()]);
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap().flatten() {
            let meta = entry.metadata().unwrap();
            if meta.is_dir() {
                folders.push(entry.path());
            }
            found.push((entry.path(), if meta.is_dir() { 0 } else { meta.len() }));
        }
    }
    found.sort();
    found
}

/// Passes a log to every command that reads one; returns the commands' exit codes. Everything outside the
/// output folder must stay unchanged.
fn read_by_every_command(place: &Place, log: &Path, inside: &Path) -> Vec<i32> {
    fs::create_dir(inside).unwrap();
    let outside = || -> Vec<_> {
        tree(&place.path("")).into_iter().filter(|(path, _)| !path.starts_with(inside)).collect()
    };
    let before = outside();
    let told = |name: &str| inside.join(name).to_str().unwrap().to_owned();
    let log = log.to_str().unwrap().to_owned();
    let to = |words: &[&str], name: &str| {
        let words = words.iter().map(|word| (*word).to_owned());
        words.chain([log.clone(), "-o".to_owned(), told(name)]).collect::<Vec<_>>()
    };
    let alone = |words: &[&str], more: &[&str]| {
        let words = words.iter().map(|word| (*word).to_owned()).chain([log.clone()]);
        words.chain(more.iter().map(|word| (*word).to_owned())).collect::<Vec<_>>()
    };
    let all = [
        alone(&["log", "info"], &[]),
        alone(&["log", "cat"], &[]),
        to(&["log", "repair"], "r.mcap"),
        to(&["log", "compress"], "c.mcap"),
        to(&["log", "export"], "t.csv"),
        to(&["log", "export", "--frames"], "frames"),
        to(&["log", "split"], "s"),
        alone(&["replay"], &["--verify", "--frames"]),
    ];
    let codes = all.iter().map(|arguments| {
        let done = call(arguments);
        done.code.filter(|code| *code <= 2).unwrap_or_else(|| panic!("{arguments:?}: {}", done.err))
    });
    let codes = codes.collect();
    assert_eq!(outside(), before, "{log}");
    codes
}

/// A log of 0.3 s in `good.mcap`, and a folder deep enough that a name can lead out of it.
fn deep(place: &Place) -> (PathBuf, PathBuf) {
    let ended = place.complete(&scenes::drill("lockstep", 0.3));
    fs::create_dir_all(place.path("in/deep/folder")).unwrap();
    fs::rename(ended.folder.join("run.mcap"), place.path("good.mcap")).unwrap();
    (place.path("good.mcap"), place.path("in/deep/folder/evil.mcap"))
}

/// An untrusted log: its scene, controllers and names are arbitrary.
#[test]
fn a_log_whose_names_are_paths_writes_only_where_it_is_told_to() {
    let place = Place::new();
    let (good, log) = deep(&place);
    let absolute = place.path("evil").display().to_string();
    for evil in ["../../evil", &absolute] {
        rewrite_as(
            &good,
            &log,
            |header| {
                header.scene_name = evil.to_owned();
                header.controllers = vec![evil.to_owned()];
                header.scene_toml = header.scene_toml.replace("\"drill\"", &format!("{evil:?}"));
            },
            |_| {},
            |_| {},
        );
        let inside = place.path("in/deep/folder/told");
        fs::create_dir(&inside).unwrap();
        let before = tree(&place.path(""));
        let told = |name: &str| inside.join(name);
        let (joined, figure) = (told("joined.mcap"), told("figure"));
        type Words<'a> = Vec<&'a dyn AsRef<std::ffi::OsStr>>;
        // For a log with an invalid scene, commands that need no scene work; a replay rejects it.
        let all: [(i32, Words<'_>); 12] = [
            (0, vec![&"log", &"info", &log]),
            (0, vec![&"log", &"cat", &log]),
            (0, vec![&"log", &"repair", &log, &"-o", &"r.mcap"]),
            (0, vec![&"log", &"compress", &log, &"-o", &"c.mcap"]),
            (0, vec![&"log", &"export", &log, &"-o", &"t.csv"]),
            (0, vec![&"log", &"export", &good, &"--frames", &"-o", &"frames"]),
            (0, vec![&"log", &"cat-files", &log, &good, &"-o", &joined]),
            (0, vec![&"log", &"split", &joined, &"-o", &"runs"]),
            (0, vec![&"plot", &log, &"t_world_tip.position_m", &"--output", &figure]),
            (2, vec![&"volume", &"drilled", &log, &"-o", &"drilled.nrrd"]),
            (2, vec![&"replay", &log, &"--verify", &"--frames"]),
            (2, vec![&"replay", &log, &"--output", &"again"]),
        ];
        for (code, words) in all {
            let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
            let words: Vec<&std::ffi::OsStr> = words.iter().map(|word| word.as_ref()).collect();
            let done = command.args(&words).current_dir(&inside).limited_output().unwrap();
            assert_eq!(
                done.status.code(),
                Some(code),
                "{words:?}: {}",
                String::from_utf8_lossy(&done.stderr)
            );
        }
        let after: Vec<_> =
            tree(&place.path("")).into_iter().filter(|(path, _)| !path.starts_with(&inside)).collect();
        let before: Vec<_> = before.into_iter().filter(|(path, _)| !path.starts_with(&inside)).collect();
        assert_eq!(after, before, "{evil}");
        let written = |name: &str| inside.join(name).exists();
        let files = ["r.mcap", "c.mcap", "t.csv", "frames", "runs/run1.mcap", "runs/run2.mcap", "figure.svg"];
        assert!(files.into_iter().all(written) && !written("drilled.nrrd") && !written("again"));
        // Its scene is not one: it is read and rejected, never followed.
        assert_eq!(verify(&log).code, Some(2));
        fs::remove_dir_all(inside).unwrap();
    }
}

/// Pictures are numbered, tables have the given name: no command takes a file name from the log.
#[test]
fn exported_pictures_and_attachments_with_paths_for_names_stay_in_the_folder() {
    let place = Place::new();
    let (good, log) = deep(&place);
    // As long as `scene.toml` and `calibration.json`; not an existing file.
    let absolute = format!("/tmp/trb{:08x}", std::process::id());
    let names = [("scene.toml", "../../evil"), ("calibration.json", &*absolute)];
    let renamed = rename_attachments(&good, &log, &names);
    // The header is in the file twice.
    assert_eq!(renamed, 4);
    read_by_every_command(&place, &log, &place.path("in/deep/folder/told"));
    // With the usual names, the same log is exported completely.
    assert_eq!(rename_attachments(&log, &place.path("back.mcap"), &[("../../evil", "scene.toml")]), 2);
    let inside = place.path("in/deep/folder/back");
    let codes = read_by_every_command(&place, &place.path("back.mcap"), &inside);
    // The log of one run cannot be split.
    assert_eq!(codes, [0, 0, 0, 0, 0, 0, 2, 0], "info, cat, repair, compress, export twice, split, replay");
    let pictures = fs::read_dir(inside.join("frames")).unwrap().count();
    assert!(pictures >= 3, "{pictures} pictures");
    assert!(!Path::new(&absolute).exists());
}
