//! MCAP and rosbag2: fields of ROS messages, by topic.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::path::Path;

use foreign_text::{foreign, foreign_path, nearest_name};
use identify::signal::Rows;
use mcap::records::Record;
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use ros_interface::definition::{Definition, FieldPath};

use super::{MAX_ROWS, mcap_files, no_column, opened, too_long};
use crate::failure::Failure;

/// Longest record, bytes, of a file that is not longer itself: chunks of recorders have some megabytes.
const MAX_RECORD_BYTES: u64 = 1 << 26;
/// Bytes that are read at a time: a record of a damaged length takes no more memory than the file has bytes.
const BYTES_AT_ONCE: usize = 1 << 20;

/// Names of the times that every message has.
const LOG_TIME: &str = "log_time";
const PUBLISH_TIME: &str = "publish_time";

/// What the messages of a topic are decoded with.
struct Decoder {
    definition: Definition,
    time: Time,
    paths: Vec<FieldPath>,
}

enum Time {
    Log,
    Publish,
    Field(FieldPath),
}

/// Reads fields of a topic's messages; the time is `log_time`, `publish_time` or a field.
pub(super) fn read(path: &Path, topic: &str, time: Option<&str>, wanted: &[&str]) -> Result<Rows, Failure> {
    let mut rows = Rows { times_s: Vec::new(), columns: vec![Vec::new(); wanted.len()] };
    let mut topics = BTreeSet::new();
    for file in mcap_files(path)? {
        append(&file, topic, time.unwrap_or(LOG_TIME), wanted, &mut rows, &mut topics)?;
    }
    if rows.times_s.is_empty() {
        let known: Vec<&str> = topics.iter().map(String::as_str).collect();
        return Err(match known.contains(&topic) {
            true => Failure::bad_input(format!(
                "{}: the topic `{}` has no messages",
                foreign_path(path),
                foreign(topic)
            )),
            false => {
                let listed: Vec<String> = known.iter().take(40).map(|it| foreign(it).to_string()).collect();
                let near = nearest_name(topic, known.iter().copied());
                let near = near.map_or(String::new(), |near| format!(" (did you mean `{}`?)", foreign(near)));
                Failure::bad_input(format!(
                    "{}: no topic `{}`{near}; it has {}",
                    foreign_path(path),
                    foreign(topic),
                    listed.join(", ")
                ))
            }
        });
    }
    Ok(rows)
}

fn append(
    file: &Path,
    topic: &str,
    time: &str,
    wanted: &[&str],
    rows: &mut Rows,
    topics: &mut BTreeSet<String>,
) -> Result<(), Failure> {
    let bad = |why: String| Failure::bad_input(format!("{}: {why}", foreign_path(file)));
    let mut from = opened(file)?;
    let longest = from.metadata().map_or(0, |metadata| metadata.len()).max(MAX_RECORD_BYTES);
    let options = LinearReaderOptions::default()
        .with_record_length_limit(longest as usize)
        .with_validate_chunk_crcs(true);
    let mut reader = LinearReader::new_with_options(options);
    let mut schemas = BTreeMap::new();
    let mut decoders: BTreeMap<u16, Decoder> = BTreeMap::new();
    while let Some(event) = reader.next_event() {
        let (opcode, data) =
            match event.map_err(|cause| bad(format!("damaged or not an MCAP file ({cause})")))? {
                LinearReadEvent::ReadRequest(count) => {
                    let read = from.read(reader.insert(count.min(BYTES_AT_ONCE)));
                    let read = read.map_err(|cause| bad(format!("cannot be read ({cause})")))?;
                    reader.notify_read(read);
                    continue;
                }
                LinearReadEvent::Record { data, opcode } => (opcode, data),
            };
        let record = mcap::parse_record(opcode, data);
        match record.map_err(|cause| bad(format!("a damaged record ({cause})")))? {
            Record::Schema { header, data } => {
                schemas.insert(header.id, (header.name, header.encoding, data.into_owned()));
            }
            Record::Channel(channel) => {
                topics.insert(channel.topic.clone());
                if channel.topic != topic {
                    continue;
                }
                let schema = schemas.get(&channel.schema_id);
                let (name, encoding, text) =
                    schema.ok_or_else(|| bad(format!("the topic `{}` has no schema", foreign(topic))))?;
                if channel.message_encoding != "cdr" || encoding != "ros2msg" {
                    return Err(bad(format!(
                        "the topic `{}` has messages in `{}` with a schema in `{}`, expected `cdr` and \
                         `ros2msg`",
                        foreign(topic),
                        foreign(&channel.message_encoding),
                        foreign(encoding)
                    )));
                }
                let text = String::from_utf8_lossy(text);
                let definition = Definition::parse(name, &text)
                    .map_err(|cause| bad(format!("schema `{}`: {cause}", foreign(name))))?;
                decoders.insert(channel.id, decoder(file, definition, time, wanted)?);
            }
            Record::Message { header, data } => {
                let Some(decoder) = decoders.get(&header.channel_id) else { continue };
                if rows.times_s.len() == MAX_ROWS {
                    return Err(too_long(file));
                }
                let number = rows.times_s.len();
                let value = |path: &FieldPath| {
                    let value = decoder.definition.value(path, &data);
                    value.map_err(|cause| bad(format!("message {number} of `{}`: {cause}", foreign(topic))))
                };
                rows.times_s.push(match &decoder.time {
                    Time::Log => header.log_time as f64 * 1e-9,
                    Time::Publish => header.publish_time as f64 * 1e-9,
                    Time::Field(path) => value(path)?.unwrap_or(f64::NAN),
                });
                for (column, path) in rows.columns.iter_mut().zip(&decoder.paths) {
                    column.push(value(path)?.unwrap_or(f64::NAN));
                }
            }
            _ => {}
        }
    }
    Ok(())
}

fn decoder(file: &Path, definition: Definition, time: &str, wanted: &[&str]) -> Result<Decoder, Failure> {
    let path = |name: &str| {
        definition.path(name).map_err(|names| {
            let known: Vec<&str> = names.iter().map(String::as_str).collect();
            no_column(file, name, &known)
        })
    };
    let time = match time {
        LOG_TIME => Time::Log,
        PUBLISH_TIME => Time::Publish,
        field => Time::Field(path(field)?),
    };
    let paths = wanted.iter().map(|name| path(name)).collect::<Result<_, _>>()?;
    Ok(Decoder { definition, time, paths })
}
