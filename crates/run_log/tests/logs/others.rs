//! Logs that another program has rewritten: valid MCAP, with chunks without checksums, without chunks, or
//! with metadata after the messages. Regression: each was reported as damaged. A file that is not one of our
//! logs was referred to `repair`, which rejected it.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use std::io::Cursor;
use std::path::Path;

use crate::common::*;
use mcap::records::{MessageHeader, Record};
use mcap::{Attachment, WriteOptions, Writer};
use run_log::*;

/// Where the other program puts metadata and attachments.
#[derive(Clone, Copy, PartialEq)]
enum Beside {
    WhereTheyStood,
    /// Each once, after all messages.
    AtTheEnd,
    /// All, before the messages: attachments, then metadata.
    AtTheStart,
    /// Each once, before the messages.
    OnceAtTheStart,
}

/// Returns the log as written by the `mcap` crate's writer.
fn written_again(log: &[u8], options: WriteOptions, beside: Beside) -> Vec<u8> {
    edited_again(log, options, beside, |_, data| data)
}

/// The same, with each message's bytes replaced by `edit`, given its topic and bytes.
fn edited_again(
    log: &[u8],
    options: WriteOptions,
    beside: Beside,
    edit: impl for<'a> Fn(&str, &'a [u8]) -> &'a [u8],
) -> Vec<u8> {
    retimed_again(log, options, beside, |topic, _, data| edit(topic, data))
}

/// The same, with the header of each message in the hands of `edit` too.
fn retimed_again(
    log: &[u8],
    options: WriteOptions,
    beside: Beside,
    mut edit: impl for<'a> FnMut(&str, &mut MessageHeader, &'a [u8]) -> &'a [u8],
) -> Vec<u8> {
    let mut topics = std::collections::BTreeMap::new();
    let mut out = Cursor::new(Vec::new());
    let mut writer: Writer<_> = options.profile("ros2").create(&mut out).unwrap();
    let mut channels = std::collections::BTreeMap::new();
    let mut schemas = std::collections::BTreeMap::new();
    let (mut attachments, mut metadata) = match beside {
        Beside::AtTheStart | Beside::OnceAtTheStart => all_beside(log),
        Beside::WhereTheyStood | Beside::AtTheEnd => Default::default(),
    };
    put(&mut writer, &attachments, &metadata, beside);
    let is_at_the_start = !metadata.is_empty();
    for record in mcap::read::ChunkFlattener::new(log).unwrap() {
        match record.unwrap() {
            Record::Schema { header, data } => {
                schemas.insert(header.id, writer.add_schema(&header.name, &header.encoding, &data).unwrap());
            }
            Record::Channel(channel) => {
                let schema = schemas[&channel.schema_id];
                let id =
                    writer.add_channel(schema, &channel.topic, &channel.message_encoding, &channel.metadata);
                channels.insert(channel.id, id.unwrap());
                topics.insert(channel.id, channel.topic);
            }
            Record::Message { mut header, data } => {
                let data = edit(&topics[&header.channel_id], &mut header, &data);
                header.channel_id = channels[&header.channel_id];
                writer.write_to_known_channel(&header, data).unwrap();
            }
            Record::Attachment { header, data, .. } if !is_at_the_start => {
                attachments.push(attachment(header, data.into_owned()));
            }
            Record::Metadata(found) if !is_at_the_start => metadata.push(found),
            Record::DataEnd(_) => break,
            _ => {}
        }
        if beside == Beside::WhereTheyStood {
            put(&mut writer, &attachments, &metadata, beside);
            (attachments, metadata) = Default::default();
        }
    }
    if !is_at_the_start {
        put(&mut writer, &attachments, &metadata, beside);
    }
    writer.finish().unwrap();
    drop(writer);
    out.into_inner()
}

fn attachment(header: mcap::records::AttachmentHeader, data: Vec<u8>) -> Attachment<'static> {
    Attachment {
        log_time: header.log_time,
        create_time: header.create_time,
        name: header.name,
        media_type: header.media_type,
        data: std::borrow::Cow::Owned(data),
    }
}

/// Returns all attachments and metadata of a log.
fn all_beside(log: &[u8]) -> (Vec<Attachment<'static>>, Vec<mcap::records::Metadata>) {
    let (mut attachments, mut metadata) = (Vec::new(), Vec::new());
    for record in mcap::read::ChunkFlattener::new(log).unwrap() {
        match record.unwrap() {
            Record::Attachment { header, data, .. } => {
                attachments.push(attachment(header, data.into_owned()))
            }
            Record::Metadata(found) => metadata.push(found),
            Record::DataEnd(_) => break,
            _ => {}
        }
    }
    (attachments, metadata)
}

fn put(
    writer: &mut Writer<&mut Cursor<Vec<u8>>>,
    attachments: &[Attachment],
    metadata: &[mcap::records::Metadata],
    beside: Beside,
) {
    let once = matches!(beside, Beside::AtTheEnd | Beside::OnceAtTheStart);
    let mut names: Vec<&str> = Vec::new();
    let mut is_wanted = |name| {
        let is_new = !names.contains(&name);
        names.push(name);
        is_new || !once
    };
    for found in attachments.iter().filter(|found| is_wanted(&found.name)) {
        writer.attach(found).unwrap();
    }
    for found in metadata.iter().filter(|found| is_wanted(&found.name)) {
        writer.write_metadata(found).unwrap();
    }
}

fn messages_of(log: &[u8]) -> Vec<(String, u64, Vec<u8>)> {
    let mut stream = stream(log, ReadOptions::default()).unwrap();
    let mut out = Vec::new();
    while let Some(message) = stream.next_message().unwrap() {
        out.push((message.topic.to_owned(), message.log_time_ns, message.body.to_vec()));
    }
    assert!(stream.verdict().is_intact(), "{}", stream.verdict());
    out
}

fn verdict_on(log: &[u8]) -> Verdict {
    let mut stream = stream(log, ReadOptions::default()).unwrap();
    while let Ok(Some(_)) = stream.next_message() {}
    stream.verdict()
}

/// Returns why a log is neither compressed nor joined.
fn refused(log: &LogBytes) -> [LogError; 2] {
    let to = Path::new("p.mcap");
    let compressed = join::compress(log, Vec::new(), to, Packing::RECORDED).unwrap_err();
    [compressed, join::cat_files(&[log], Vec::new(), to).unwrap_err()]
}

fn variants(log: &[u8]) -> Vec<(&'static str, Vec<u8>)> {
    let plain = || WriteOptions::new().compression(None).chunk_size(Some(20_000));
    use Beside::{AtTheEnd, AtTheStart, OnceAtTheStart, WhereTheyStood};
    vec![
        ("as it was", written_again(log, plain(), WhereTheyStood)),
        // The crate's checksum of the data section is wrong without those of chunks (mcap 0.26,
        // `ChunkWriter::finish`).
        (
            "chunk CRC 0",
            written_again(
                log,
                plain().calculate_chunk_crcs(false).calculate_data_section_crc(false),
                WhereTheyStood,
            ),
        ),
        ("no chunks", written_again(log, plain().use_chunks(false), WhereTheyStood)),
        ("metadata at the end", written_again(log, plain(), AtTheEnd)),
        ("no chunks, metadata at the end", written_again(log, plain().use_chunks(false), AtTheEnd)),
        // As written by a Python loop over attachments, one over metadata and one over messages.
        ("metadata at the start", written_again(log, plain(), AtTheStart)),
        ("metadata once at the start", written_again(log, plain(), OnceAtTheStart)),
        ("no chunks, metadata at the start", written_again(log, plain().use_chunks(false), AtTheStart)),
    ]
}

#[test]
fn a_valid_log_that_another_program_wrote_is_intact() {
    let log = write_log(&run_messages(200, None));
    let messages = messages_of(&log);
    for (name, again) in variants(&log) {
        assert!(messages_of(&again) == messages, "{name}");
        let steps = open_bytes(&again).unwrap().map(|step| step.unwrap().state.tick).collect::<Vec<_>>();
        assert_eq!(steps.len(), 200, "{name}");
    }
}

#[test]
fn repair_and_compress_take_what_another_program_wrote() {
    let log = write_log(&run_messages(200, None));
    let messages = messages_of(&log);
    for (name, again) in variants(&log) {
        let source = LogBytes::new("l.mcap", again);
        let packed = join::compress(&source, Vec::new(), Path::new("p.mcap"), Packing::RECORDED).unwrap();
        assert!(messages_of(&packed) == messages, "compressed: {name}");
        let (repaired, report) =
            repair::Repair::of(&source).unwrap().write(Vec::new(), Path::new("r.mcap")).unwrap();
        assert_eq!(report.left_out_bytes, 0, "{name}");
        assert!(messages_of(&repaired) == messages, "repaired: {name}");
    }
}

/// Regression: `compress` and `cat-files` skipped such messages, and claimed that their output was the same.
#[test]
fn messages_outside_of_chunks_in_a_file_that_says_it_is_ours_are_damage() {
    let log = write_log(&run_messages(200, None));
    let library = mcap::read::ChunkFlattener::new(&log).unwrap().find_map(|record| match record.unwrap() {
        Record::Header(header) => Some(header.library),
        _ => None,
    });
    let options = WriteOptions::new().compression(None).use_chunks(false).library(library.unwrap());
    let source = LogBytes::new("l.mcap", written_again(&log, options, Beside::WhereTheyStood));
    for error in refused(&source) {
        assert!(error.to_string().contains("outside of a chunk"), "{error}");
    }
    let (_, report) = repair::Repair::of(&source).unwrap().write(Vec::new(), Path::new("r.mcap")).unwrap();
    assert!(report.left_out_bytes > 200 * 1000, "{report:?}");
}

/// Regression: "the end marker says 200" for a truncated file.
#[test]
fn a_cut_log_with_its_metadata_before_its_messages_is_called_cut() {
    let log = write_log(&run_messages(200, None));
    let options = WriteOptions::new().compression(None).chunk_size(Some(20_000));
    let again = written_again(&log, options, Beside::AtTheStart);
    let verdict = verdict_on(&again[..again.len() / 2]);
    assert!(matches!(verdict.faults[..], [Fault::Cut { ended: false, .. }]), "{verdict}");
}

/// Regression: `compress` and `cat-files` accepted states of 20 bytes that no reader accepts.
#[test]
fn a_message_too_short_for_its_topic_is_damage_though_its_checksum_is_right() {
    let log = write_log(&run_messages(200, None));
    let again = edited_again(&log, WriteOptions::new(), Beside::WhereTheyStood, |topic, data| match topic {
        // The first 4 bytes precede the message.
        "/state" => &data[..20],
        _ => data,
    });
    for error in refused(&LogBytes::new("l.mcap", again)) {
        assert!(matches!(error, LogError::NotWhole { .. }), "{error}");
        assert!(error.to_string().contains("a message of /state of 16 bytes, expected"), "{error}");
    }
}

/// Regression: a replay compared only the messages' content, and found nothing where `log_time` was altered.
#[test]
fn an_altered_time_of_a_message_is_damage_though_its_checksum_is_right() {
    let log = write_log(&run_messages(200, None));
    for wanted in ["/state", "/latched", "/removed", "/drr/reply", "/drr/frame", "/drr/image"] {
        for is_log_time in [true, false] {
            let mut count = 0;
            let options = WriteOptions::new();
            let again = retimed_again(&log, options, Beside::WhereTheyStood, |topic, header, data| {
                count += u32::from(topic == wanted);
                let time = if is_log_time { &mut header.log_time } else { &mut header.publish_time };
                *time += u64::from(topic == wanted && count == 3);
                data
            });
            let report = verify(&mut open_bytes(&again).unwrap(), Toy::new, None);
            let name = if is_log_time { "log_time" } else { "publish_time" };
            let Some(LogError::Damaged { cause, .. }) = &report.log_error else {
                panic!("{wanted}, {name}: {:?}", report.log_error);
            };
            assert!(cause.contains(wanted) && cause.contains(name), "{cause}");
            assert!(!report.is_identical());
        }
    }
}

#[test]
fn a_chunk_without_a_checksum_is_still_checked_for_its_lengths() {
    let log = write_log(&run_messages(200, None));
    let options = WriteOptions::new().compression(None).calculate_chunk_crcs(false);
    let options = options.calculate_data_section_crc(false);
    let mut again = written_again(&log, options, Beside::WhereTheyStood);
    let topic = again.windows(6).position(|bytes| bytes == b"/state").unwrap();
    // The length of the channel's topic.
    again[topic - 4] = 0xff;
    assert!(verdict_on(&again).is_stopped_by_damage());
}

#[test]
fn a_file_that_is_no_log_of_ours_is_not_sent_to_repair() {
    let mut out = Cursor::new(Vec::new());
    let mut writer = WriteOptions::new().create(&mut out).unwrap();
    let schema = writer.add_schema("s", "ros2msg", b"float64 x").unwrap();
    let channel = writer.add_channel(schema, "/x", "cdr", &Default::default()).unwrap();
    let header =
        mcap::records::MessageHeader { channel_id: channel, sequence: 0, log_time: 1, publish_time: 1 };
    writer.write_to_known_channel(&header, &[0; 12]).unwrap();
    writer.finish().unwrap();
    drop(writer);
    let foreign = LogBytes::new("f.mcap", out.into_inner());
    let split = join::check_holds_runs(&foreign).unwrap_err();
    for error in refused(&foreign).into_iter().chain([split]) {
        assert!(matches!(error, LogError::NoHeader { .. }), "{error}");
        assert!(!error.to_string().contains("repair"), "{error}");
    }
}
