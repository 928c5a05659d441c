//! Rounds of the recorder, with messages that the test publishes in the physics' place.
#![allow(clippy::unwrap_used, clippy::panic)]

use ipc_types::messages::{
    ControlAction, EventCode, Keyframe, Latched, Participant, RunControl, RunControlReply, State, Tick,
    TickTiming,
};
use ipc_types::ports::Publisher;
use ipc_types::process::EventSender;
use ipc_types::scene::{Policy, Wait};
use ipc_types::session::{SessionHost, SessionPlan};
use run_log::{LogReader, MessageStream, ReadOptions, Topic};
use test_support::scenes;
use zerocopy::FromBytes;

use super::recorder::TICKS_PER_ROUND;
use super::*;
use crate::log_file::LogFile;

/// Late tick, save request and controller's remark, in ticks.
const LATE: u64 = 5;
const REQUEST: u64 = 9;
const REMARK: u64 = 40;
/// `ring_s` and `after_s` in ticks.
const BEFORE: u64 = 1000;
const AFTER: u64 = 100;

/// A host that publishes what the physics would.
struct Physics {
    host: SessionHost,
    states: Publisher<State>,
    latched: Publisher<Latched>,
    keyframes: Publisher<Keyframe>,
    timing: Publisher<TickTiming>,
    tick: u64,
}

impl Physics {
    fn start(scene: &Scene) -> Physics {
        let plan = SessionPlan {
            controllers: scene.controller_names(),
            volume_bytes: 0,
            frame_bytes: 0,
            sensors: false,
            tip_jacobian: false,
            recorder: true,
            wait: Wait::Hybrid,
            policy: Policy::Other,
        };
        let host = SessionHost::create(&plan).unwrap();
        host.announce().unwrap();
        host.session.claim(Part::Physics).unwrap();
        Physics {
            states: host.session.publisher(&services::STATE).unwrap(),
            latched: host.session.publisher(&services::LATCHED).unwrap(),
            keyframes: host.session.publisher(&services::KEYFRAME).unwrap(),
            timing: host.session.publisher(&services::TICK_TIMING).unwrap(),
            tick: 0,
            host,
        }
    }

    /// Publishes as many ticks as the recorder reads in a round, with a keyframe every 80.
    fn round(&mut self) {
        for tick in self.tick..self.tick + TICKS_PER_ROUND as u64 {
            self.latched.send(&Latched { tick, ..Latched::zeroed() }).unwrap();
            let missed = u32::from(tick == LATE);
            self.timing.send(&TickTiming { tick, missed, ..TickTiming::zeroed() }).unwrap();
            self.states.send(&State { tick: tick + 1, ..State::zeroed() }).unwrap();
            self.tick = tick + 1;
        }
        if self.tick.is_multiple_of(80) {
            let head = Keyframe {
                tick: self.tick,
                sequence: self.tick / 80,
                total_bytes: 1,
                data_length: 1,
                ..Keyframe::zeroed()
            };
            self.keyframes.send_with_tail(&head, &[0]).unwrap();
        }
    }
}

/// A round that ends a saved log used to leave its timing out; an event ahead of the recorder was moved to
/// the newest state.
#[test]
fn a_trigger_is_of_its_own_tick_and_both_lanes_of_a_saved_log_end_together() {
    let text = format!(
        "name = \"ring\"\n[run]\nmode = \"lockstep\"\nduration_s = 10.0\n{}[recording]\nring_s = 1.0\n\
         after_s = 0.1\nkeyframe_interval_s = 0.08\ntriggers = [\"missed_tick\", \"controller\"]\n",
        scenes::TOOL
    );
    let scene = Scene::parse(&text, Path::new("ring.toml")).unwrap();
    let mut physics = Physics::start(&scene);
    let session = Session::join(physics.host.session.folder()).unwrap();
    session.claim(Part::Recorder).unwrap();
    let header = LogHeader {
        scene_toml: text,
        calibration_json: None,
        scene_name: scene.name.clone(),
        volume_sha256: None,
        volume_dimensions: [0; 3],
        dt_ns: scene.dt_ns(),
        mode: RunMode::Lockstep,
        controllers: scene.controller_names(),
        build: build_info::current(),
        first_tick: Tick::START,
    };
    let output = tempfile::tempdir().unwrap();
    let mut recorder = start(&session, &scene, &header, output.path()).unwrap();
    let mut remarks = EventSender::new(&physics.host.session, Participant::Part(Part::Host)).unwrap();
    let controls = physics.host.session.publisher(&services::RUN_CONTROL).unwrap();
    let replies = physics.host.session.publisher(&services::RUN_CONTROL_REPLY).unwrap();

    physics.states.send(&State::zeroed()).unwrap();
    recorder.take_round().unwrap();
    remarks.inform(Tick(REMARK), EventCode::Controller, "look at this").unwrap();
    let action = ControlAction::Save.code();
    controls.send(&RunControl { request_id: 7, action, ..RunControl::zeroed() }).unwrap();
    let reply = RunControlReply { request_id: 7, tick: REQUEST, action, ..RunControlReply::zeroed() };
    replies.send(&reply).unwrap();
    let saved = output.path().join("saved-1");
    while !saved.exists() && physics.tick < 4 * BEFORE {
        physics.round();
        recorder.take_round().unwrap();
    }

    let mut reader = LogReader::open(&LogFile::at(saved.join(LANES[0]))).unwrap();
    let last = reader.by_ref().map(|record| record.unwrap().state.tick).last().unwrap();
    let ending = reader.stream().ending().describe();
    for cause in [
        format!("tick {LATE}: missed_tick"),
        format!("tick {REQUEST}: requested by a client"),
        format!("tick {REMARK}: controller"),
    ] {
        assert!(ending.contains(&cause), "{ending}");
    }
    assert!(last >= REMARK + AFTER, "{last}");
    let timing = LogFile::at(saved.join(LANES[1]));
    let mut stream = MessageStream::open(&timing, ReadOptions::default()).unwrap();
    let mut measured = Vec::new();
    while let Some(message) = stream.next_message().unwrap() {
        if message.known == Some(Topic::TickTiming) {
            measured.push(TickTiming::read_from_bytes(message.body).unwrap().tick);
        }
    }
    assert!(measured.iter().copied().eq(0..last), "{} of {last}", measured.len());
}
