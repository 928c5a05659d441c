//! What a stranger found who had read the documents alone.

use std::ffi::OsStr;
use std::fs;

use recorder_proc::EndReason;
use rustix::fs::{CWD, FileType, Mode, mknodat};
use rustix::process::Signal;

use crate::common::client::Client;
use crate::common::logs::{assert_replays, read};
use crate::common::program::{Place, assert_nothing_left, signal, trabecula};
use crate::common::scenes;

/// The command waited for somebody to write into it, for ever.
#[test]
fn a_pipe_in_place_of_a_log_is_refused_and_not_waited_for() {
    let place = Place::new();
    let (pipe, made) = (place.path("pipe"), place.path("made.mcap"));
    mknodat(CWD, &pipe, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
    let all: [&[&dyn AsRef<OsStr>]; 7] = [
        &[&"log", &"info", &pipe],
        &[&"log", &"cat", &pipe],
        &[&"log", &"diff", &pipe, &pipe],
        &[&"log", &"repair", &pipe, &"-o", &made],
        &[&"log", &"compress", &pipe, &"-o", &made],
        &[&"replay", &pipe],
        &[&"view", &pipe, &"--no-open", &"--port", &"0"],
    ];
    for words in all {
        let done = trabecula(words);
        assert_eq!(done.code, Some(2), "{}{}", done.out, done.err);
        assert!(done.err.contains("it is no regular file"), "{}", done.err);
        assert!(!made.exists());
    }
}

/// The comparison stopped at the first difference, and called what it had not read "not ended".
#[test]
fn a_whole_log_is_not_called_unfinished_beside_a_cut_one() {
    let place = Place::new();
    let log = place.complete(&scenes::hold("lockstep", 0.3)).folder.join("run.mcap");
    let (cut, bytes) = (place.path("cut.mcap"), fs::read(&log).unwrap());
    fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    for (words, whole, short) in [([&log, &cut], "first", "second"), ([&cut, &log], "second", "first")] {
        let done = trabecula(&[&"log", &"diff", words[0], words[1]]);
        assert_eq!(done.code, Some(1), "{}{}", done.out, done.err);
        assert!(!done.out.contains(&format!("the {whole} log:")), "{}", done.out);
        assert!(done.out.contains(&format!("the {short} log: cut")), "{}", done.out);
    }
}

/// The log's end blamed a launcher that was well.
#[test]
fn a_signal_of_somebody_else_to_the_recorder_blames_nobody() {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", 1.5));
    Client::join(&run.session()).wait_for_state(|state| state.tick >= 100);
    signal(run.part("recorder"), Signal::TERM);
    let ended = run.end();
    assert_eq!(ended.code, Some(0), "{}", ended.err);
    assert_nothing_left(ended.pid);
    let log = read(&ended.folder);
    assert_eq!((log.marker.unwrap().reason, log.ticks.len()), (EndReason::Completed, 1500));
    assert_replays(&ended.folder);
}
