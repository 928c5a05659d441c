//! A sent command is applied and recorded unchanged, whatever its sender writes afterwards.

use std::path::Path;
use std::process::Command;

use ipc_types::messages::Command as Message;
use ipc_types::session::{CONTROLLER_VARIABLE, SESSION_VARIABLE};
use recorder_proc::log_file::LogFile;
use run_log::{MessageStream, ReadOptions};
use zerocopy::FromBytes;

use crate::common::logs::{assert_replays, read};
use crate::common::program::{Place, Run, assert_nothing_left};
use crate::languages::{clients, compiled_test, output_within_limit};

/// Returns the tensions of a run's commands, latched and as sent.
fn tensions_n(folder: &Path) -> (Vec<[f64; 2]>, Vec<[f64; 2]>) {
    let two = |command: &Message| [command.tendon_force_n[0], command.tendon_force_n[1]];
    let latched = read(folder).ticks.iter().map(|tick| two(&tick.latched.commands[0].command)).collect();
    let mut stream =
        MessageStream::open(&LogFile::at(folder.join("timing.mcap")), ReadOptions::default()).unwrap();
    let mut sent = Vec::new();
    while let Some(message) = stream.next_message().unwrap() {
        if message.topic.starts_with("/command") {
            sent.push(two(&Message::read_from_bytes(message.body).unwrap()));
        }
    }
    (latched, sent)
}

/// Runs a controller that sends 3 N and then writes 55 N to the sent message.
fn assert_only_what_was_sent(mut controller: Command) {
    let place = Place::new();
    let run = Run::start(&clients().join("scenes/free_space.toml"), place.path("out"), &[]);
    controller.env(SESSION_VARIABLE, run.session()).env(CONTROLLER_VARIABLE, "mine");
    assert_eq!(output_within_limit(&mut controller), "ended\n");
    let ended = run.end_well();
    assert_nothing_left(ended.pid);
    let (latched, sent) = tensions_n(&ended.folder);
    assert_eq!((latched.len(), sent.len() >= 1000), (1000, true));
    for (what, tensions) in [("latched", latched), ("as sent", sent)] {
        let others = tensions.iter().filter(|two| **two != [3.0, 0.0]).count();
        assert_eq!(others, 0, "{others} of {} {what}: {:?} ...", tensions.len(), &tensions[..3]);
    }
    assert_replays(&ended.folder);
}

/// Regression: C's pointer was into the sent message: 718 of 1000 ticks latched 55 N where 3 N were sent.
#[test]
fn a_command_that_is_written_after_it_was_sent_is_what_it_was_in_c() {
    let place = Place::new();
    assert_only_what_was_sent(Command::new(compiled_test("sent", &place)));
}
