//! Logs: ticks, frames, keyframes assembled from their parts, the summary, the survey of a repair.

use std::io::Cursor;
use std::path::Path;

use recorder_proc::build_info;
use run_log::repair::survey;
use run_log::segments::{SegmentOptions, verify_segments};
use run_log::{FrameReader, LogBytes, LogError, LogReader, MessageStream, ReadOptions};

use crate::seeds::Toy;

const OPTIONS: ReadOptions = ReadOptions { allow_other_layouts: true };

fn stream(data: &[u8]) -> Result<MessageStream, LogError> {
    MessageStream::from_reader(Box::new(Cursor::new(data.to_vec())), Path::new("fuzz.mcap"), OPTIONS)
}

/// Reads a complete file with every reader.
pub fn log(data: &[u8]) {
    ticks(data);
    summary(data);
    repair(data);
}

/// Reads the records of a chunk with a correct checksum, which would otherwise keep the fuzzer out.
pub fn chunk_content(data: &[u8]) {
    let file = with_chunk(data);
    ticks(&file);
    repair(&file);
}

/// Checks that ticks have no gap, keyframes are complete, and nothing follows an error.
fn ticks(data: &[u8]) {
    let mut keyframes = 0;
    if let Ok(mut reader) = stream(data).and_then(LogReader::from_stream) {
        // A log whose start is missing begins at a keyframe.
        let mut ticks = reader.beginning().map_or(0, |beginning| beginning.tick.0);
        for number in ticks + 1.. {
            let item = reader.next();
            if let Some(saved) = reader.take_keyframe() {
                assert!(saved.tick.0 < number && saved.bytes.len() <= data.len());
                keyframes += 1;
            }
            let Some(Ok(tick)) = item else { break };
            ticks += 1;
            assert_eq!(tick.state.tick, ticks);
        }
        assert!(reader.next().is_none());
        assert_eq!(reader.last_complete_tick().0, ticks);
    }
    if let Ok(stream) = stream(data) {
        let frames = FrameReader::from_stream(stream).map_while(Result::ok);
        frames.zip(1..).for_each(|(frame, number)| assert_eq!(frame.frame.sequence, number));
    }
    // Threads are expensive: only if there is a keyframe to begin at.
    if keyframes > 0
        && let Ok(mut reader) = stream(data).and_then(LogReader::from_stream)
    {
        let options = SegmentOptions { start: None, to_tick: None, threads: 2 };
        let report = verify_segments(&mut reader, &|| Ok(Toy::new()), &options);
        assert!(report.identical_keyframes <= keyframes);
    }
}

/// Runs `log info`, and formats every message as `log cat` does.
fn summary(data: &[u8]) {
    if let Ok(info) = run_log::info(&LogBytes::new("fuzz.mcap", data), OPTIONS) {
        let mut text = Vec::new();
        info.write(&mut text).unwrap();
        info.write_misses(&mut text).unwrap();
    }
    if let Ok(mut stream) = stream(data) {
        while let Ok(Some(message)) = stream.next_message() {
            run_log::cat::whole(message.description, message.body);
        }
    }
}

/// Surveys a repair. Skipped pieces must lie within the file.
fn repair(data: &[u8]) {
    let Ok(report) = survey(Cursor::new(data), Path::new("fuzz.mcap")) else { return };
    let mut end = 0;
    for piece in &report.pieces {
        assert!(piece.offset >= end && piece.bytes > 0);
        end = piece.offset + piece.bytes;
    }
    assert!(end <= data.len() as u64);
}

/// Builds a file with the header of a log and one uncompressed chunk of these records.
fn with_chunk(records: &[u8]) -> Vec<u8> {
    let mut file = header();
    let mut body = [0_u8; 16].to_vec();
    body.extend((records.len() as u64).to_le_bytes());
    body.extend(crc32fast::hash(records).to_le_bytes());
    body.extend(0_u32.to_le_bytes());
    body.extend((records.len() as u64).to_le_bytes());
    body.extend(records);
    file.push(6);
    file.extend((body.len() as u64).to_le_bytes());
    file.extend(body);
    file
}

/// Returns an empty log up to its first chunk.
fn header() -> Vec<u8> {
    let header = run_log::LogHeader {
        scene_toml: String::new(),
        calibration_json: None,
        scene_name: "fuzz".to_string(),
        volume_sha256: None,
        volume_dimensions: [0; 3],
        dt_ns: 1_000_000,
        mode: run_log::RunMode::Lockstep,
        controllers: Vec::new(),
        build: build_info::current(),
        first_tick: messages::Tick::START,
    };
    let log = run_log::RunLog::create(Vec::new(), &header);
    let whole = log.and_then(|log| log.finish(run_log::EndReason::Completed, &Default::default()));
    let (_, bytes) = whole.unwrap();
    let mut at = 8;
    // An attachment (9) and a header (1) precede the metadata record (12) that is the log's header.
    while bytes.get(at).is_some_and(|opcode| *opcode != 12) {
        at += record_length(&bytes, at);
    }
    bytes[..at + record_length(&bytes, at)].to_vec()
}

fn record_length(bytes: &[u8], at: usize) -> usize {
    let length = bytes.get(at + 1..at + 9).and_then(|length| length.try_into().ok());
    9 + length.map_or(0, |length| u64::from_le_bytes(length) as usize)
}
