//! Reads logs, and creates faulty ones.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use ipc_types::messages::{DrrReply, Event, EventCode, Latched, State};
use recorder_proc::log_file::{LogFile, create_run};
use run_log::{EndMarker, EndReason, LogHeader, LogReader, MessageStream, ReadOptions, TickRecord, Topic};
use sim::{Drive, SharedScene, Sim};
use zerocopy::FromBytes;

use super::program::{Done, Place, trabecula};

/// A complete `run.mcap`: initial state, ticks, end marker.
pub struct Whole {
    pub initial: State,
    pub ticks: Vec<TickRecord>,
    pub marker: Option<EndMarker>,
}

/// Runs a scene without X-ray to its end in this process, without a session; returns the folder with its log.
pub fn recorded(place: &Place, scene: &str) -> PathBuf {
    let shared = SharedScene::load(Some(&place.scene(scene)), &[], None).unwrap();
    let mut sim = Sim::new(&shared, &Drive::Nothing).unwrap();
    let folder = place.path("recorded");
    sim.record(&folder).unwrap();
    sim.step(&[], shared.scene().tick_count()).unwrap();
    sim.close_recording().unwrap();
    folder
}

/// Reads a log that must be readable to its end.
pub fn read(folder: &Path) -> Whole {
    let mut reader = LogReader::open(&LogFile::at(folder.join("run.mcap"))).unwrap();
    let initial = *reader.initial();
    let ticks = reader.by_ref().map(Result::unwrap).collect();
    Whole { initial, ticks, marker: reader.ending().marker.clone() }
}

/// Returns the messages of a log by topic; the log must be complete, without losses.
pub fn counts(log: &Path) -> BTreeMap<String, u64> {
    let mut stream = MessageStream::open(&LogFile::at(log), ReadOptions::default()).unwrap();
    while stream.next_message().unwrap().is_some() {}
    let marker = stream.ending().marker.clone().expect("an end marker");
    assert_eq!(marker.lost, BTreeMap::new());
    stream.counts().into_iter().map(|(topic, count)| (topic, count.messages)).collect()
}

/// Returns the events of a run with this code: `State.tick` and text.
pub fn events(folder: &Path, code: EventCode) -> Vec<(u64, String)> {
    let log = LogFile::at(folder.join("timing.mcap"));
    let mut stream = MessageStream::open(&log, ReadOptions::default()).unwrap();
    let mut said = Vec::new();
    while let Some(message) = stream.next_message().unwrap() {
        if message.known == Some(Topic::Event) {
            let (event, text) = Event::read_from_prefix(message.body).unwrap();
            if event.code() == Ok(code) {
                said.push((event.tick, String::from_utf8(text.to_vec()).unwrap()));
            }
        }
    }
    said
}

/// Replays a folder or log with `--verify`.
pub fn verify(log: &Path) -> Done {
    trabecula(&[&"replay", &log, &"--verify"])
}

/// Replays a folder or log, which must be identical at every tick. Returns the program's output.
pub fn assert_replays(log: &Path) -> String {
    let done = verify(log);
    // An incomplete log is reported as such, also by its replay.
    let not_whole = ["gap: ", "truncated after ", "not ended: "].iter().any(|fault| done.out.contains(fault));
    assert_eq!(done.code, Some(if not_whole { 3 } else { 0 }), "{}\n{}", done.out, done.err);
    assert!(done.out.contains("all identical"), "{}", done.out);
    done.out
}

/// Rewrites a log with the recorder's own writer, so that every length and CRC is right, but with changed
/// commands and states. Frames are omitted.
pub fn rewrite(from: &Path, to: &Path, latched: impl Fn(&mut Latched), state: impl Fn(&mut State)) {
    rewrite_as(from, to, |_| {}, latched, state);
}

/// The same with a changed header.
pub fn rewrite_as(
    from: &Path,
    to: &Path,
    header: impl Fn(&mut LogHeader),
    latched: impl Fn(&mut Latched),
    state: impl Fn(&mut State),
) {
    let mut stream = MessageStream::open(&LogFile::at(from), ReadOptions::default()).unwrap();
    let mut changed = stream.header().clone();
    header(&mut changed);
    let mut log = create_run(to, &changed).unwrap();
    while let Some(message) = stream.next_message().unwrap() {
        match message.known {
            Some(Topic::Latched) => {
                let mut changed = Latched::read_from_bytes(message.body).unwrap();
                latched(&mut changed);
                log.latched(&changed).unwrap();
            }
            Some(Topic::State) => {
                let mut changed = State::read_from_bytes(message.body).unwrap();
                state(&mut changed);
                log.state(&changed).unwrap();
            }
            Some(Topic::Removed) => log.removed(message.body).unwrap(),
            Some(Topic::Keyframe) => log.keyframe(message.body).unwrap(),
            Some(Topic::Sensor) => log.reading(&FromBytes::read_from_bytes(message.body).unwrap()).unwrap(),
            _ => {}
        }
    }
    log.finish(EndReason::Completed, &BTreeMap::new()).unwrap();
}

/// Rewrites a log with every message in its place and its bytes changed by `edit`; a message for which `edit`
/// returns false is omitted.
pub fn edited(from: &Path, to: &Path, mut edit: impl FnMut(&str, &mut Vec<u8>) -> bool) {
    let mut stream = MessageStream::open(&LogFile::at(from), ReadOptions::default()).unwrap();
    let mut log = create_run(to, stream.header()).unwrap();
    log.keep_places();
    let (mut frame, mut chunk) = (None, 1);
    while let Some(message) = stream.next_message().unwrap() {
        let mut body = message.body.to_vec();
        if std::mem::replace(&mut chunk, message.chunk) != message.chunk
            && message.known != Some(Topic::DrrImage)
        {
            log.close_chunk().unwrap();
        }
        if !edit(message.topic, &mut body) {
            continue;
        }
        match message.known {
            Some(Topic::Latched) => log.latched(&Latched::read_from_bytes(&body).unwrap()).unwrap(),
            Some(Topic::State) => log.state(&State::read_from_bytes(&body).unwrap()).unwrap(),
            Some(Topic::Removed) => log.removed(&body).unwrap(),
            Some(Topic::Keyframe) => log.keyframe(&body).unwrap(),
            Some(Topic::Sensor) => log.reading(&FromBytes::read_from_bytes(&body).unwrap()).unwrap(),
            Some(Topic::DrrReply) => log.drr_reply(&DrrReply::read_from_bytes(&body).unwrap()).unwrap(),
            // Its image follows.
            Some(Topic::DrrFrame) => frame = Some(body),
            _ => log.frame(&[frame.take().unwrap(), body].concat()).unwrap(),
        }
    }
    log.finish(EndReason::Completed, &BTreeMap::new()).unwrap();
}

/// Rewrites a log with other attachment names of the same length, as a third-party tool could: every checksum
/// is right or, where MCAP permits it, absent (0). Returns the number of names changed.
pub fn rename_attachments(from: &Path, to: &Path, names: &[(&str, &str)]) -> usize {
    const MAGIC_BYTES: usize = 8;
    const FOOTER: u8 = 0x02;
    const ATTACHMENT: u8 = 0x09;
    const ATTACHMENT_INDEX: u8 = 0x0a;
    const DATA_END: u8 = 0x0f;
    let mut bytes = std::fs::read(from).unwrap();
    let (mut at, mut renamed) = (MAGIC_BYTES, 0);
    while at + MAGIC_BYTES < bytes.len() {
        let (kind, length) =
            (bytes[at], u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize);
        let record = &mut bytes[at + 9..at + 9 + length];
        at += 9 + length;
        let checksum = length - 4;
        match kind {
            DATA_END | FOOTER => record[checksum..].fill(0),
            ATTACHMENT | ATTACHMENT_INDEX => {
                for (old, new) in names {
                    assert_eq!(old.len(), new.len());
                    let place = record.windows(old.len()).position(|window| window == old.as_bytes());
                    if let Some(place) = place {
                        record[place..place + new.len()].copy_from_slice(new.as_bytes());
                        renamed += usize::from(kind == ATTACHMENT);
                    }
                }
                if kind == ATTACHMENT {
                    let mut crc = flate2::Crc::new();
                    crc.update(&record[..checksum]);
                    record[checksum..].copy_from_slice(&crc.sum().to_le_bytes());
                }
            }
            _ => {}
        }
    }
    std::fs::write(to, bytes).unwrap();
    renamed
}
