//! Untrusted files: what they can make the program read, and what of them reaches the terminal.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs::{self, File};
use std::path::Path;
use std::process::{Command, Stdio};

use recorder_proc::log_file::{LogFile, create_run};
use run_log::{EndReason, MessageStream, ReadOptions, Topic};
use zerocopy::FromBytes;

use crate::common::logs::recorded;
use crate::common::program::{Done, Guarded, Place, wait_for};
use crate::common::scenes;
use crate::dicom_bytes::DicomSlice;

/// Clears the screen, sets the title, reverses text, forges a line.
const HOSTILE: &str = "x\x1b[2J\x1b]0;owned\x07\rend marker: completed\u{202e}\u{9b}31m";

/// Runs the program; if it does not end, it is killed and the test fails.
fn limited(words: &[&dyn AsRef<OsStr>]) -> Done {
    let place = Place::new();
    let file = |name: &str| File::create(place.path(name)).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula"));
    words.iter().for_each(|word| {
        command.arg(word);
    });
    let mut child =
        Guarded(command.stdin(Stdio::null()).stdout(file("out")).stderr(file("err")).spawn().unwrap());
    let named: Vec<&OsStr> = words.iter().map(|word| word.as_ref()).collect();
    let status = wait_for(&format!("the end of {named:?}"), || child.0.try_wait().unwrap());
    let text = |name: &str| String::from_utf8(fs::read(place.path(name)).unwrap()).unwrap();
    Done { code: status.code(), out: text("out"), err: text("err") }
}

/// Asserts that a command's output contains no control sequences, and returns it; untrusted text is shown
/// escaped.
fn assert_plain(done: &Done, what: &str) -> String {
    let said = format!("{}{}", done.out, done.err);
    let bad = |c: char| (c.is_control() && c != '\n' && c != '\t') || c == '\u{202e}';
    assert!(!said.contains(bad), "{what}: {:?}", said.chars().filter(|c| bad(*c)).collect::<String>());
    assert!(
        !said.lines().any(|line| line.starts_with("end marker: completed\\u202e")),
        "{what} forges a line: {said}"
    );
    said
}

/// Writes a log in which every text is hostile.
fn hostile_log(from: &Path, to: &Path) {
    let mut stream = MessageStream::open(&LogFile::at(from), ReadOptions::default()).unwrap();
    let mut header = stream.header().clone();
    let forged = format!("{HOSTILE}\nend         forged");
    header.scene_name = forged.clone();
    header.controllers = vec![HOSTILE.to_owned()];
    header.build.version = forged.clone();
    header.build.target = forged.clone();
    header.build.rustc = Some(forged);
    let mut log = create_run(to, &header).unwrap();
    while let Some(message) = stream.next_message().unwrap() {
        match message.known {
            Some(Topic::Latched) => log.latched(&FromBytes::read_from_bytes(message.body).unwrap()).unwrap(),
            Some(Topic::State) => log.state(&FromBytes::read_from_bytes(message.body).unwrap()).unwrap(),
            Some(Topic::Removed) => log.removed(message.body).unwrap(),
            _ => {}
        }
    }
    log.finish(EndReason::PartDied(HOSTILE.to_owned()), &BTreeMap::new()).unwrap();
}

#[test]
fn texts_of_an_untrusted_log_reach_the_terminal_escaped() {
    let place = Place::new();
    let good = recorded(&place, &scenes::drill_unseen("lockstep", 0.1));
    let log = place.path("log.mcap");
    hostile_log(&good.join("run.mcap"), &log);
    // Truncated, so that the messages about damage are seen, too.
    let cut = place.path("cut.mcap");
    fs::write(&cut, &fs::read(&log).unwrap()[..4000]).unwrap();
    let told = |name: &str| place.path(name);
    let (r, c, t, b) = (told("r.mcap"), told("c.mcap"), told("t.csv"), told("b.mcap"));
    let (s, f, d) = (told("runs"), told("figure"), told("d.nrrd"));
    let all: [(&[&dyn AsRef<OsStr>], bool); 18] = [
        (&[&"log", &"info", &log], true),
        (&[&"log", &"cat", &log], false),
        (&[&"log", &"diff", &log, &good], true),
        (&[&"log", &"diff", &good, &log], true),
        (&[&"log", &"repair", &log, &"-o", &r], true),
        (&[&"log", &"compress", &log, &"-o", &c], false),
        (&[&"log", &"export", &log, &"-o", &t], true),
        (&[&"log", &"cat-files", &log, &log, &"-o", &b], false),
        (&[&"log", &"info", &b], false),
        (&[&"log", &"split", &b, &"-o", &s], false),
        (&[&"log", &"info", &cut], false),
        (&[&"log", &"repair", &cut, &"-o", &told("r2.mcap")], false),
        (&[&"plot", &log, &"t_world_tip.position_m", &"--output", &f], false),
        (&[&"replay", &log, &"--verify"], true),
        (&[&"replay", &log, &"--allow-mismatch"], true),
        (&[&"volume", &"drilled", &log, &"-o", &d], true),
        (&[&"plan", &"--check", &log], true),
        (&[&"view", &cut, &"--port", &"0", &"--no-open"], false),
    ];
    for (words, shows) in all {
        let named: Vec<&OsStr> = words.iter().map(|word| word.as_ref()).collect();
        let done = limited(words);
        let said = assert_plain(&done, &format!("{named:?}"));
        // A regular exit code, 3 for truncated: no signal, no panic.
        assert!(done.code.is_some_and(|code| code <= 3), "{named:?}: {said}");
        assert!(!shows || said.contains("\\u001b[2J"), "{named:?} shows the text: {said}");
        assert!(!said.lines().any(|line| line.starts_with("end         forged")), "{named:?}: {said}");
        if named[1] == "cat" {
            assert!(done.out.lines().count() > 200);
        }
    }
}

/// The last output of a controller appears on the terminal, in an event, and in the output of `log cat`.
#[test]
fn the_last_output_of_a_controller_reaches_the_terminal_escaped() {
    let place = Place::new();
    // It prints once the recorder is there, so that the event is in the log.
    let wait = format!(
        "until ls {}/*/timing.mcap; do sleep 0.05; done >/dev/null 2>&1; sleep 0.5",
        place.path("*").display()
    );
    let words = format!(
        r#"command = ["sh", "-c", "{wait}; printf 'a\\033[2J\\033]0;owned\\007\\302\\233b\\r\\n'; exit 3"]"#
    );
    let scene = scenes::hold("realtime", 5.0);
    let controller = format!("[[controller]]\nname = \"stranger\"\ndrives = []\n{words}\n");
    for optional in ["optional = true\n", ""] {
        let file = place.scene(&format!("{scene}\n{controller}{optional}"));
        let output = place.path("out");
        let done = limited(&[&"run", &file, &"--output", &output, &"--quiet"]);
        let said = assert_plain(&done, optional);
        assert!(said.contains("a\\u001b[2J\\u001b]0;owned\\u0007\\u009bb"), "{optional}: {said}");
        let folder = fs::read_dir(&output).unwrap().flatten().next().unwrap().path();
        let timing = place.path("timing.mcap");
        fs::rename(folder.join("timing.mcap"), &timing).unwrap();
        fs::remove_dir_all(&output).unwrap();
        let done = limited(&[&"log", &"cat", &timing, &"--topic", &"/event"]);
        assert_plain(&done, "log cat");
        // The same text in the JSON lines.
        let texts = done.out.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
        let texts: Vec<String> = texts.map(|line| line["message"]["text"].to_string()).collect();
        if !optional.is_empty() {
            assert_eq!(done.code, Some(0), "{}", done.err);
            assert!(
                done.out.contains("\\u009b") && texts.iter().any(|text| text.contains('\u{9b}')),
                "{texts:?}"
            );
        }
    }
}

#[test]
fn texts_of_an_untrusted_volume_or_scene_reach_the_terminal_escaped() {
    let place = Place::new();
    let geometry = "dimension: 3\nsizes: 2 3 4\nspace: LPS\nspace directions: (1,0,0) (0,1,0) (0,0,1)";
    let nrrd = format!("NRRD0005\ntype: {HOSTILE}\n{geometry}\nencoding: raw\nendian: little\n\n");
    let nhdr =
        format!("NRRD0005\ntype: short\n{geometry}\nencoding: raw\nendian: little\ndata file: {HOSTILE}\n");
    let mha = format!(
        "ObjectType = Image\nNDims = 3\nDimSize = 2 3 4\nElementSpacing = 1 1 1\nElementType = {HOSTILE}\nElementDataFile = LOCAL\n"
    );
    let dicom = DicomSlice { orientation: HOSTILE, ..DicomSlice::default() }.bytes();
    let own: &[(&str, &[u8])] = &[
        ("v.nrrd", nrrd.as_bytes()),
        ("v.nhdr", nhdr.as_bytes()),
        ("v.mha", mha.as_bytes()),
        ("v.dcm", &dicom),
        // For NIfTI only the file name is shown.
        ("n\x1b[2J\x07.nii", b"\x5c\x01\0\0 and no more"),
    ];
    for (name, bytes) in own {
        let file = place.path(name);
        fs::write(&file, bytes).unwrap();
        let scene = place.scene(
            &format!("{}\n[volume]\npath = {:?}\n", scenes::hold("lockstep", 0.1), file.to_str().unwrap())
                .replace("\\u{1b}", "\\u001b")
                .replace("\\u{7}", "\\u0007"),
        );
        let picture = place.path("p.png");
        let all: [&[&dyn AsRef<OsStr>]; 4] = [
            &[&"volume", &"info", &file],
            &[&"drr", &file, &"-o", &picture],
            &[&"run", &scene, &"--no-record", &"--quiet"],
            &[&"calibrate", &scene, &"-o", &place.path("cal")],
        ];
        for words in all {
            let done = limited(words);
            let said = assert_plain(&done, name);
            assert_eq!(done.code, Some(2), "{said}");
        }
        // The type is shown in lower case.
        assert!(assert_plain(&limited(all[0]), name).to_lowercase().contains("\\u001b[2j"), "{name}");
    }
    for scene in [
        "name = \"x\\u001b[2Jy\"\n".to_owned() + &scenes::hold("lockstep", 0.1),
        scenes::hold("lockstep", 0.1) + "\n\"a\\u001b[2J\\u0007\" = 1\n",
        format!("name = \"{HOSTILE}"),
    ] {
        let file = place.scene(&scene);
        for words in [&[&"scene" as &dyn AsRef<OsStr>, &"check", &file][..], &[&"plan", &file]] {
            let done = limited(words);
            assert_plain(&done, &scene);
            assert_eq!(done.code, Some(2), "{}", done.err);
        }
    }
}

/// Regression: a private file became a picture: NRRD and MetaImage headers may name any file.
#[test]
fn a_volume_names_no_file_elsewhere_unless_the_user_allows_it() {
    let place = Place::new();
    for folder in ["private", "theirs"] {
        fs::create_dir(place.path(folder)).unwrap();
    }
    let block = place.path("private/block.nrrd");
    assert_eq!(limited(&[&"phantom", &"block", &"-o", &block, &"--spacing-mm", &"1"]).code, Some(0));
    // The same volume with a header elsewhere, whose voxels follow the lines of that file.
    let bytes = fs::read(&block).unwrap();
    let end = bytes.windows(2).position(|pair| pair == b"\n\n").unwrap() + 2;
    let header = std::str::from_utf8(&bytes[..end]).unwrap();
    let lines = header.lines().count();
    let header = format!("{}\nline skip: {lines}\ndata file: ../private/block.nrrd\n", header.trim_end());
    let file = place.path("theirs/v.nhdr");
    fs::write(&file, header).unwrap();
    let scene = place.scene(&scenes::drill_in_file("lockstep", 0.05, "theirs/v.nhdr"));
    let (picture, out) = (place.path("p.png"), place.path("out"));
    let info: &[&dyn AsRef<OsStr>] = &[&"volume", &"info", &file];
    let drr: &[&dyn AsRef<OsStr>] = &[&"drr", &file, &"-o", &picture, &"--columns", &"32", &"--rows", &"32"];
    let run: &[&dyn AsRef<OsStr>] = &[&"run", &scene, &"--output", &out, &"--quiet"];
    let both = |words: &[&dyn AsRef<OsStr>]| {
        let done = limited(words);
        assert_eq!(done.code, Some(2), "{}", done.err);
        assert!(done.err.contains("v.nhdr") && done.err.contains("--allow-elsewhere"), "{}", done.err);
        let allowed: Vec<&dyn AsRef<OsStr>> =
            words.iter().copied().chain([&"--allow-elsewhere" as _]).collect();
        let done = limited(&allowed);
        assert_eq!(done.code, Some(0), "{}", done.err);
    };
    [info, drr, run].into_iter().for_each(both);
    assert!(picture.exists());
    // The scene in the log names the same header, and is equally untrusted.
    let log = fs::read_dir(&out).unwrap().flatten().next().unwrap().path();
    both(&[&"replay", &log, &"--verify"]);
    both(&[&"volume", &"drilled", &log, &"-o", &place.path("d.nrrd")]);
}

/// Regression: `/dev/zero` filled the memory, and a pipe was waited for forever.
#[test]
fn only_text_files_are_accepted_as_scene_pose_or_calibration() {
    let place = Place::new();
    let ball = place.path("ball.nrrd");
    assert_eq!(limited(&[&"phantom", &"sphere", &"-o", &ball, &"--spacing-mm", &"2"]).code, Some(0));
    let pipe = |name: &str| {
        let path = place.path(name);
        let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
        rustix::fs::mknodat(rustix::fs::CWD, &path, rustix::fs::FileType::Fifo, mode, 0).unwrap();
        path
    };
    let (scene, pose, table) = (pipe("p.toml"), pipe("q.toml"), pipe("cal.csv"));
    std::os::unix::fs::symlink("/dev/zero", place.path("zero.toml")).unwrap();
    let zero = place.path("zero.toml");
    let calibrated = scenes::drill("lockstep", 0.05).replace("tension_n = 6.0", "calibration = \"cal.csv\"");
    let calibrated =
        calibrated.replace("ramp_end_mm = 15.0", "ramp_end_mm = 15.0\ntarget_mm = [3.0, 0.0, -16.0]");
    let own = place.path("own.toml");
    fs::write(&own, calibrated).unwrap();
    let picture = place.path("x.png");
    let all: [&[&dyn AsRef<OsStr>]; 11] = [
        &[&"run", &scene],
        &[&"run", &zero],
        &[&"scene", &"check", &scene],
        &[&"scene", &"check", &zero],
        &[&"plan", &scene],
        &[&"calibrate", &zero],
        &[&"stress", &scene],
        &[&"drr", &ball, &"-o", &picture, &"--pose", &pose],
        &[&"drr", &ball, &"-o", &picture, &"--pose", &zero],
        &[&"scene", &"check", &own],
        &[&"drr", &pose, &"-o", &picture],
    ];
    for words in all {
        let named: Vec<&OsStr> = words.iter().map(|word| word.as_ref()).collect();
        let done = limited(words);
        assert!(done.code == Some(2) && done.err.contains("not a regular file"), "{named:?}: {}", done.err);
    }
    fs::remove_file(table).unwrap();
    let done = limited(&[&"scene", &"check", &own]);
    assert!(done.code == Some(2) && done.err.contains("cal.csv"), "{}", done.err);
}
