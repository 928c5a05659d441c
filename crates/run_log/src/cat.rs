//! `cat` — prints messages of a log as JSON, one per line.

use std::io::Write;

use messages::layout::{Description, Element, Tail};
use messages::{ALL, Tick, TickRange};
use serde_json::{Map, Value, json};

use crate::Topic;
use crate::error::LogError;
use crate::fields::{FieldLocation, Scalar, element_size, find};
use crate::source::LogSource;
use crate::stream::{LogMessage, MessageStream, ReadOptions};
use crate::verdict::Verdict;

/// Longest tail that is printed in full. For a longer one, such as pixels, only the element count is printed.
const MAX_TAIL_ELEMENTS: usize = 4096;

/// Which messages and fields to print.
#[derive(Debug, Clone, Default)]
pub struct CatOptions {
    /// Topics; empty for all.
    pub topics: Vec<String>,
    /// Field paths such as `t_world_link[7].position_m`; empty for whole messages. Topics without any of
    /// these fields are skipped.
    pub fields: Vec<String>,
    /// Ticks whose messages to print.
    pub ticks: TickRange,
    /// First simulated time, in nanoseconds.
    pub first_ns: u64,
    /// Last simulated time, inclusive, in nanoseconds.
    pub last_ns: Option<u64>,
    /// How strict the reader is.
    pub read: ReadOptions,
}

impl CatOptions {
    fn takes(&self, tick: Tick, time_ns: u64) -> bool {
        self.ticks.contains(tick)
            && time_ns >= self.first_ns
            && self.last_ns.is_none_or(|last| time_ns <= last)
    }
}

/// Result of [`cat`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CatSummary {
    /// How many messages of the selected topics are in the range.
    pub messages: u64,
    /// Tick of the last message of the selected topics, written or not; `None` if there is none.
    pub last_tick: Option<Tick>,
    /// The log's faults, as far as it was read.
    pub verdict: Verdict,
}

/// Writes the selected messages. Floats are printed with just enough digits to round-trip; infinities and NaN
/// become strings.
///
/// # Errors
/// [`LogError::NoSuchField`]; [`LogError::NoSuchTopic`], after the messages of the other topics; a log that
/// cannot be read.
pub fn cat(log: &dyn LogSource, options: &CatOptions, out: &mut dyn Write) -> Result<CatSummary, LogError> {
    check_fields(&options.fields, &options.topics)?;
    let mut stream = match options.topics.as_slice() {
        [] => MessageStream::open(log, options.read)?,
        topics => MessageStream::open_topics(log, topics, options.read)?,
    };
    let dt_ns = stream.header().dt_ns.max(1);
    let (mut messages, mut last_tick) = (0, None);
    while let Some(message) = stream.next_message()? {
        let tick = Tick(message.log_time_ns / dt_ns);
        if !options.topics.is_empty() && !options.topics.iter().any(|topic| topic == message.topic) {
            continue;
        }
        last_tick = last_tick.max(Some(tick));
        if !options.takes(tick, message.log_time_ns) {
            continue;
        }
        messages += 1;
        let Some(content) = content(&message, &options.fields) else { continue };
        let mut line = Map::new();
        line.insert("topic".to_string(), json!(message.topic));
        line.insert("tick".to_string(), json!(tick.0));
        line.insert("log_time_ns".to_string(), json!(message.log_time_ns));
        line.insert("message".to_string(), content);
        writeln!(out, "{}", Value::Object(line))?;
    }
    let topics = stream.topics();
    match options.topics.iter().find(|topic| !topics.contains(topic.as_str())) {
        Some(unknown) => Err(stream.no_such_topic(unknown)),
        None => Ok(CatSummary { messages, last_tick, verdict: stream.verdict() }),
    }
}

/// Returns an error for a field that exists in no message of `topics`, the topics whose messages are printed.
fn check_fields(fields: &[String], topics: &[String]) -> Result<(), LogError> {
    let first_chosen = topics.iter().find_map(|topic| Topic::of_name(topic)).map(Topic::description);
    for field in fields {
        let mut attempts = ALL.iter().map(|description| find(description, field));
        if attempts.all(|attempt| attempt.is_err()) {
            let name = field.split(['.', '[']).next().unwrap_or_default();
            let with_name = ALL.iter().find(|description| description.fields.iter().any(|f| f.name == name));
            let closest = with_name.copied().or(first_chosen);
            let reason = closest.and_then(|description| find(description, field).err());
            let reason = reason.unwrap_or_else(|| format!("no message has a field '{name}'"));
            return Err(LogError::NoSuchField { field: field.clone(), reason });
        }
    }
    Ok(())
}

fn content(message: &LogMessage<'_>, fields: &[String]) -> Option<Value> {
    if fields.is_empty() {
        return Some(whole(message.description, message.body));
    }
    let mut map = Map::new();
    for field in fields {
        if let Ok(place) = find(message.description, field) {
            map.insert(field.clone(), place_value(&place, message.body));
        }
    }
    (!map.is_empty()).then_some(Value::Object(map))
}

/// Converts a whole message to JSON, tail included.
pub fn whole(description: &'static Description, body: &[u8]) -> Value {
    let mut map = object(description, body);
    if let Some(tail) = description.tail {
        let bytes = body.get(description.size..).unwrap_or_default();
        map.insert(tail.name.to_string(), tail_value(&tail, bytes));
    }
    Value::Object(map)
}

fn object(description: &'static Description, bytes: &[u8]) -> Map<String, Value> {
    let mut map = Map::new();
    for field in description.fields {
        let place = FieldLocation {
            path: String::new(),
            element: field.element,
            array_length: field.array_length,
            offset: field.offset,
            size: field.size,
        };
        debug_assert!(element_size(field) * field.array_length.unwrap_or(1) == field.size);
        map.insert(field.name.to_string(), place_value(&place, bytes));
    }
    map
}

fn place_value(place: &FieldLocation, bytes: &[u8]) -> Value {
    let bytes = bytes.get(place.offset..place.offset + place.size).unwrap_or_default();
    match place.array_length {
        None => element_value(place.element, bytes),
        Some(length) => {
            let size = (place.size / length.max(1)).max(1);
            bytes.chunks(size).map(|part| element_value(place.element, part)).collect()
        }
    }
}

fn element_value(element: Element, bytes: &[u8]) -> Value {
    match element {
        Element::Scalar(ros) => Scalar::read(ros, bytes).map_or(Value::Null, scalar_value),
        Element::Message(nested) => Value::Object(object(nested, bytes)),
    }
}

fn scalar_value(scalar: Scalar) -> Value {
    match scalar {
        Scalar::Unsigned(value) => json!(value),
        Scalar::Signed(value) => json!(value),
        Scalar::Float32(value) => scalar_value(Scalar::Float64(f64::from(value))),
        Scalar::Float64(value) if value.is_finite() => json!(value),
        Scalar::Float64(value) => json!(value.to_string()),
    }
}

fn tail_value(tail: &Tail, bytes: &[u8]) -> Value {
    let size = tail.element_size.max(1);
    let count = bytes.len() / size;
    if tail.ros_type == "string" {
        return json!(String::from_utf8_lossy(bytes.strip_suffix(&[0]).unwrap_or(bytes)));
    }
    if count > MAX_TAIL_ELEMENTS {
        return json!(format!("{count} elements of {}", tail.ros_type));
    }
    bytes.chunks(size).map(|part| element_value(Element::Scalar(tail.ros_type), part)).collect()
}
