//! The file that redirects a browser to the viewer's page.

use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use crate::common::logs::recorded;
use crate::common::program::{Guarded, Place, Run, wait_for};
use crate::common::scenes;

/// Regression: a killed viewer's file, which contains a token, stayed forever.
#[test]
fn the_file_that_a_killed_viewer_leaves_goes_with_the_next_viewer_or_run() {
    let place = Place::new();
    let log = recorded(&place, &scenes::hold("lockstep", 0.1));
    let (tools, runtime) = (place.path("tools"), place.path("runtime"));
    [&tools, &runtime].into_iter().for_each(|folder| std::fs::create_dir(folder).unwrap());
    std::fs::set_permissions(&runtime, std::fs::Permissions::from_mode(0o700)).unwrap();
    let opener = tools.join("xdg-open");
    std::fs::write(&opener, format!("#!/bin/sh\ntouch {}\n", place.path("opened").display())).unwrap();
    std::fs::set_permissions(&opener, std::fs::Permissions::from_mode(0o755)).unwrap();
    let path = format!("{}:{}", tools.display(), std::env::var("PATH").unwrap());
    let viewer = || {
        let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
        command.arg("view").arg(&log).args(["--port", "0"]).env("PATH", &path).env("DISPLAY", ":99");
        command.env("XDG_RUNTIME_DIR", &runtime).stdin(Stdio::null()).stdout(Stdio::null());
        Guarded(command.spawn().unwrap())
    };
    let pages = || -> Vec<PathBuf> {
        let entries = std::fs::read_dir(&runtime).unwrap().flatten().map(|entry| entry.path());
        let is_page = |path: &PathBuf| path.extension().is_some_and(|ending| ending == "html");
        let holds_something = |path: &PathBuf| path.metadata().is_ok_and(|it| it.len() > 0);
        entries.filter(is_page).filter(holds_something).collect()
    };
    let first = viewer();
    // Until the opener runs, it too may have the file open, and thereby its lock.
    wait_for("the opener", || place.path("opened").exists().then_some(()));
    let left = pages().pop().unwrap();
    drop(first);
    assert_eq!(pages(), std::slice::from_ref(&left), "killed, it has cleared up nothing");
    let mut second = Some(viewer());
    let page = wait_for("the next viewer's file", || pages().into_iter().find(|page| *page != left));
    assert_eq!(pages(), std::slice::from_ref(&page));
    // A run leaves the file of a living viewer alone, and removes that of a dead one.
    for is_alive in [true, false] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
        let (scene, output) = (place.path("scene.toml"), place.path(&format!("out-{is_alive}")));
        command.arg("run").arg(scene).arg("--output").arg(&output).arg("--quiet");
        command.env("XDG_RUNTIME_DIR", &runtime);
        assert_eq!(Run::of(command, output).end().code, Some(0));
        assert_eq!(page.exists(), is_alive && second.is_some());
        if is_alive {
            second = None;
        }
    }
}
