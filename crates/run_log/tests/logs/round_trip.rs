//! What is written can be read back unchanged.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use std::collections::BTreeMap;

use crate::common::*;
use messages::layout::Message;
use messages::*;
use run_log::diff::diff;
use run_log::*;
use zerocopy::{FromBytes, IntoBytes};

#[test]
fn ticks_come_back_bit_for_bit() {
    let steps = run_messages(1234, None);
    let mut reader = open_bytes(&write_log(&steps)).unwrap();
    assert_eq!(*reader.header(), header());
    assert_eq!(*reader.initial(), Toy::new().state);
    assert_eq!(reader.predrilled(), PREDRILLED);
    let mut toy = Toy::new();
    for k in 0..1234 {
        let tick = reader.next().unwrap().unwrap();
        toy.step(&latched(k)).unwrap();
        assert_eq!(tick.latched.as_bytes(), latched(k).as_bytes());
        assert_eq!(tick.state.as_bytes(), toy.state.as_bytes());
        assert_eq!(tick.removed, toy.removed);
        assert_eq!((tick.state.tick, tick.restored), (k + 1, None));
    }
    assert!(reader.next().is_none());
    assert_eq!(reader.last_complete_tick(), Tick(1234));
    let ending = reader.ending();
    assert!(ending.is_complete());
    let marker = ending.marker.as_ref().unwrap();
    assert_eq!((marker.last_tick, marker.hash), (Some(Tick(1234)), Some(toy.state.hash)));
    assert_eq!(marker.counts["/state"], 1235);
    assert_eq!(marker.counts["/latched"], 1234);
    assert_eq!(marker.counts["/drr/image"], 31);
    assert!(marker.lost.is_empty());
}

#[test]
fn a_reset_puts_voxels_back_and_time_goes_on() {
    let steps = run_messages(500, Some(321));
    let bytes = write_log(&steps);
    let reader = open_bytes(&bytes).unwrap();
    let ticks: Vec<TickRecord> = reader.map(Result::unwrap).collect();
    assert_eq!(ticks.len(), 500);
    let restored: Vec<_> = ticks.iter().filter_map(|t| Some((t.state.tick, t.restored.clone()?))).collect();
    assert_eq!(restored, [(322, PREDRILLED.to_vec())]);
    // Tick 325 is the first one after the reset that drills: 325 = 46 * 7 + 3.
    assert_eq!((ticks[320].state.removed_total, ticks[321].state.removed_total), (4 + 46 * 5, 4));
    assert_eq!((ticks[324].removed.len(), ticks[324].state.removed_total), (5, 9));
    let states = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap);
    let times: Vec<u64> = states.filter(|m| m.channel.topic == "/state").map(|m| m.log_time).collect();
    assert_eq!(times, (0..=500).map(|k| k * 1_000_000).collect::<Vec<u64>>());
}

#[test]
fn other_readers_see_the_same_bytes() {
    let steps = run_messages(150, None);
    let bytes = write_log(&steps);
    let mut images = 0;
    let mut states = steps.iter().filter_map(|step| if let Step::State(s) = step { Some(s) } else { None });
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let schema = message.channel.schema.clone().unwrap();
        assert_eq!((message.channel.message_encoding.as_str(), schema.encoding.as_str()), ("cdr", "ros2msg"));
        let body = message.data.strip_prefix(&[0, 1, 0, 0]).unwrap();
        match message.channel.topic.as_str() {
            "/state" => {
                let state = states.next().unwrap();
                assert_eq!(body, state.as_bytes());
                assert_eq!(u64::from(message.sequence), state.tick);
                assert_eq!(schema.name, "trabecula_msgs/msg/State");
                assert_eq!(schema.data.as_ref(), State::DESCRIPTION.schema().as_bytes());
            }
            "/drr/image" => {
                images += 1;
                assert_eq!(schema.name, "sensor_msgs/msg/Image");
                assert_eq!(body, &frame_bytes(images, 40 * images - 19, 32, 20)[Frame::DESCRIPTION.size..]);
            }
            _ => (),
        }
    }
    assert_eq!((images, states.next().is_none()), (4, true));
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    // Images get their own chunks: a chunk with an image holds nothing else.
    let image = summary.channels.values().find(|channel| channel.topic == "/drr/image").unwrap().id;
    let with_image: Vec<_> =
        summary.chunk_indexes.iter().filter(|c| c.message_index_offsets.contains_key(&image)).collect();
    assert_eq!(with_image.len(), 4);
    assert!(with_image.iter().all(|chunk| chunk.message_index_offsets.len() == 1));
}

#[test]
fn frames_come_back_with_their_pixels() {
    let bytes = write_log(&run_messages(200, None));
    let path = named("run.mcap", &bytes);
    let records: Vec<FrameRecord> =
        frames(&path, ReadOptions::default()).unwrap().map(Result::unwrap).collect();
    assert_eq!(records.len(), 5);
    for (i, record) in records.iter().enumerate() {
        let payload = [record.frame.as_bytes(), record.image.unwrap().as_bytes(), &record.pixels].concat();
        let n = i as u64 + 1;
        assert_eq!(payload, frame_bytes(n, 40 * n - 19, 32, 20));
    }
}

#[test]
fn frames_may_be_logged_without_their_images() {
    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    for step in run_messages(900, None) {
        match &step {
            Step::Frame(bytes) => {
                log.frame_without_image(&Frame::read_from_prefix(bytes).unwrap().0).unwrap()
            }
            _ => feed(&mut log, &[step]).unwrap(),
        }
    }
    let (marker, bytes) = log.finish(EndReason::Completed, &BTreeMap::new()).unwrap();
    assert_eq!((marker.counts["/drr/frame"], marker.counts["/drr/image"]), (22, 0));
    let path = named("run.mcap", &bytes);
    let records: Vec<FrameRecord> =
        frames(&path, ReadOptions::default()).unwrap().map(Result::unwrap).collect();
    let ticks: Vec<u64> = records.iter().map(|record| record.frame.tick).collect();
    assert_eq!(ticks, (0..22).map(|n| 40 * n + 21).collect::<Vec<u64>>());
    assert!(records.iter().all(|record| record.image.is_none() && record.pixels.is_empty()));
    // A log with images and one with hashes only hold the same run.
    let with_images = named("images.mcap", &write_log(&run_messages(900, None)));
    let report = diff(&path, &with_images, ReadOptions::default()).unwrap();
    assert_eq!((report.same_run(), report.identical_frames), (true, 22));
}

#[test]
fn the_timing_lane_takes_any_message() {
    let mut log = TimingLog::create(Vec::new(), &header()).unwrap();
    let mut event = Event::zeroed();
    event.tick = 3;
    event.text_length = 6;
    let event = [event.as_bytes(), b"hello\0"].concat();
    for k in 0..250 {
        let mut timing = TickTiming::zeroed();
        timing.tick = k;
        timing.start_ns = 77 + k;
        log.message(Topic::TickTiming, Tick(k), timing.as_bytes()).unwrap();
        if k == 3 {
            log.message(Topic::Event, Tick(k), &event).unwrap();
        }
    }
    let refused = log.message(Topic::Event, Tick(9), &event[..event.len() - 1]).unwrap_err();
    println!("{refused}");
    assert!(matches!(refused, LogError::Message { .. }));
    let lost = BTreeMap::from([("/event".to_string(), 2), ("/timing/tick".to_string(), 0)]);
    let (marker, bytes) = log.finish(EndReason::PartDied("drr".to_string()), &lost).unwrap();
    let mut stream = stream(&bytes, ReadOptions::default()).unwrap();
    let (mut ticks, mut texts) = (0, Vec::new());
    while let Some(message) = stream.next_message().unwrap() {
        match message.topic {
            "/timing/tick" => {
                let timing = TickTiming::read_from_bytes(message.body).unwrap();
                assert_eq!(
                    (timing.tick, timing.start_ns, message.log_time_ns),
                    (ticks, 77 + ticks, ticks * 1_000_000)
                );
                ticks += 1;
            }
            _ => texts.push(message.body[Event::DESCRIPTION.size..].to_vec()),
        }
    }
    assert_eq!((ticks, texts), (250, vec![b"hello\0".to_vec()]));
    assert_eq!(stream.ending().marker, Some(marker));
    assert_eq!(stream.ending().marker.as_ref().unwrap().lost, BTreeMap::from([("/event".to_string(), 2)]));
}

#[test]
fn a_log_without_ticks_still_has_its_header() {
    let log = RunLog::create(Vec::new(), &header()).unwrap();
    let bytes = log.finish(EndReason::Interrupted, &BTreeMap::new()).unwrap().1;
    assert!(matches!(open_bytes(&bytes), Err(LogError::NoStates { .. })));
    // A truncated log gives a different error.
    assert!(matches!(open_bytes(&bytes[..bytes.len() - 100]), Err(LogError::NoInitialState { .. })));
    let info = info(&named("run.mcap", &bytes), ReadOptions::default()).unwrap();
    assert_eq!(info.ending.marker.unwrap().reason, EndReason::Interrupted);
}

#[test]
fn errors_name_the_file_and_the_cause() {
    let text = named("a.txt", b"not a log at all");
    let error = LogReader::open(&text).err().unwrap();
    println!("{error}");
    assert!(matches!(error, LogError::NotMcap { .. }));

    let mut log = RunLog::create(Vec::new(), &header()).unwrap();
    let mut frame = frame_bytes(1, 1, 8, 8);
    frame.pop();
    let error = log.frame(&frame).unwrap_err();
    println!("{error}");
    assert!(matches!(error, LogError::Message { .. }));
    assert!(matches!(log.removed(&[0; 31]), Err(LogError::Message { .. })));
}

#[test]
fn another_layout_is_refused_by_name_unless_allowed() {
    let bytes = write_log(&run_messages(10, None));
    let hash = State::DESCRIPTION.layout_hash();
    let position = bytes.windows(16).position(|window| window == hash.as_bytes()).unwrap();
    let mut other = unsealed(bytes);
    other[position..position + 16].copy_from_slice(b"0123456789abcdef");
    let error = open_bytes(&other).err().unwrap();
    println!("{error}");
    let text = error.to_string();
    assert!(text.contains("State") && text.contains("0123456789abcdef") && text.contains(&hash));
    let stream = stream(&other, ReadOptions { allow_other_layouts: true }).unwrap();
    assert_eq!(LogReader::from_stream(stream).unwrap().filter(Result::is_ok).count(), 10);
}
