//! Selected fields of a topic as a table: one row per message, one column per scalar.

use messages::layout::{Description, Element};
use messages::{Tick, TickRange};

use crate::error::LogError;
use crate::fields::{FieldLocation, Scalar, element_size, find};
use crate::source::LogSource;
use crate::stream::{MessageStream, ReadOptions};
use crate::topics::{self, Topic, unit_of};
use crate::verdict::Verdict;

/// The first columns of a table: when a message was logged, as a tick and as simulated time. No message has
/// fields with these names, so column names are unique.
pub const LOG_COLUMNS: [&str; 2] = ["log_tick", "log_time_ns"];

/// One column: one scalar of a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Column {
    /// Its path, `t_world_tip.position_m[0]`.
    pub name: String,
    /// ROS type of the scalar.
    pub ros_type: &'static str,
    offset: usize,
    size: usize,
}

impl Column {
    /// Creates a column of computed numbers (`float64`), which no message contains.
    pub fn computed(name: &str) -> Column {
        Column { name: name.to_owned(), ros_type: "float64", offset: 0, size: 0 }
    }

    /// Returns the unit, from the end of the name of its field: `rad/s`; empty if it has none.
    pub fn unit(&self) -> &'static str {
        let field = self.name.rsplit('.').next().unwrap_or(&self.name);
        unit_of(field.split('[').next().unwrap_or(field)).unwrap_or_default()
    }

    /// Sets the column's value in a message; returns false, and changes nothing, if it is not a `float64`.
    pub fn set(&self, body: &mut [u8], value: f64) -> bool {
        let place = body.get_mut(self.offset..self.offset + self.size);
        match place.filter(|_| self.ros_type == "float64") {
            Some(place) if place.len() == size_of::<f64>() => {
                place.copy_from_slice(&value.to_le_bytes());
                true
            }
            _ => false,
        }
    }

    /// Sets the column's value in a message; returns false, and changes nothing, if it is not a `uint32`.
    pub fn set_whole(&self, body: &mut [u8], value: u32) -> bool {
        let place = body.get_mut(self.offset..self.offset + self.size);
        match place.filter(|place| self.ros_type == "uint32" && place.len() == size_of::<u32>()) {
            Some(place) => {
                place.copy_from_slice(&value.to_le_bytes());
                true
            }
            None => false,
        }
    }

    /// The column's value in a message; `None` for a computed column.
    pub fn value(&self, body: &[u8]) -> Option<Scalar> {
        Scalar::read(self.ros_type, body.get(self.offset..self.offset + self.size)?)
    }

    /// Sets the column's value in a message, if it is a `float64`.
    pub fn put_f64(&self, body: &mut [u8], value: f64) {
        if self.ros_type == "float64"
            && let Some(place) = body.get_mut(self.offset..self.offset + self.size)
            && place.len() == 8
        {
            place.copy_from_slice(&value.to_le_bytes());
        }
    }
}

/// Returns the columns for the given fields, in that order, or for the whole message if there are none.
/// Arrays and nested messages expand to one column per scalar.
///
/// # Errors
/// [`LogError::NoSuchField`].
pub fn columns(description: &'static Description, fields: &[String]) -> Result<Vec<Column>, LogError> {
    let mut out = Vec::new();
    if fields.is_empty() {
        message(description, "", 0, &mut out);
    }
    for field in fields {
        let place = find(description, field);
        let place = place.map_err(|reason| LogError::NoSuchField { field: field.clone(), reason })?;
        of_place(&place, field, &mut out);
    }
    Ok(out)
}

fn message(description: &'static Description, prefix: &str, offset: usize, out: &mut Vec<Column>) {
    for field in description.fields {
        let name = format!("{prefix}{}", field.name);
        let place = FieldLocation {
            path: name.clone(),
            element: field.element,
            array_length: field.array_length,
            offset: offset + field.offset,
            size: field.size,
        };
        debug_assert!(element_size(field) * field.array_length.unwrap_or(1) == field.size);
        of_place(&place, &name, out);
    }
}

fn of_place(place: &FieldLocation, name: &str, out: &mut Vec<Column>) {
    let count = place.array_length.unwrap_or(1).max(1);
    let size = place.size / count;
    for i in 0..count {
        let name = match place.array_length {
            Some(_) => format!("{name}[{i}]"),
            None => name.to_owned(),
        };
        let offset = place.offset + i * size;
        match place.element {
            Element::Scalar(ros_type) => out.push(Column { name, ros_type, offset, size }),
            Element::Message(nested) => message(nested, &format!("{name}."), offset, out),
        }
    }
}

/// Receives a table row by row.
pub trait Rows {
    /// Receives a row: the tick, the simulated time, and one value per column.
    ///
    /// # Errors
    /// Any error of the row's destination.
    fn row(&mut self, tick: Tick, log_time_ns: u64, values: &[Scalar]) -> Result<(), LogError>;

    /// Writes buffered rows, after the last one.
    ///
    /// # Errors
    /// Any error of the rows' destination.
    fn finish(&mut self) -> Result<(), LogError> {
        Ok(())
    }
}

impl<F: FnMut(Tick, u64, &[Scalar]) -> Result<(), LogError>> Rows for F {
    fn row(&mut self, tick: Tick, log_time_ns: u64, values: &[Scalar]) -> Result<(), LogError> {
        self(tick, log_time_ns, values)
    }
}

/// This build's description of a topic in either lane.
///
/// # Errors
/// [`LogError::NoSuchTopic`].
pub fn description_of_topic(log: &dyn LogSource, topic: &str) -> Result<&'static Description, LogError> {
    let mut stream = MessageStream::open_topics(log, &[topic.to_owned()], ReadOptions::default())?;
    let first = stream.next_message()?.map(|message| message.description);
    let known = Topic::of_name(topic).filter(|known| topics::RUN_TOPICS.contains(known));
    let of_run_lane = || known.map(Topic::description);
    match first.or_else(of_run_lane) {
        Some(description) => Ok(description),
        // A topic without messages has no description to decode it with.
        None => Err(stream.no_such_topic(topic)),
    }
}

/// Reads the messages of a topic over a range of ticks into rows.
///
/// # Errors
/// A log that cannot be read; any error of the rows' destination.
pub fn read_rows(
    log: &dyn LogSource,
    topic: &str,
    columns: &[Column],
    ticks: TickRange,
    rows: &mut dyn Rows,
) -> Result<Verdict, LogError> {
    let mut stream = MessageStream::open_topics(log, &[topic.to_owned()], ReadOptions::default())?;
    let dt_ns = stream.header().dt_ns.max(1);
    let mut values = Vec::with_capacity(columns.len());
    while let Some(message) = stream.next_message()? {
        let tick = Tick(message.log_time_ns / dt_ns);
        if !ticks.contains(tick) {
            continue;
        }
        values.clear();
        values.extend(columns.iter().filter_map(|column| column.value(message.body)));
        rows.row(tick, message.log_time_ns, &values)?;
    }
    Ok(stream.verdict())
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by it")]
mod tests {
    use super::*;

    /// Regression: two columns named `tick` made pandas, polars and fastparquet reject the table.
    #[test]
    fn no_two_columns_of_a_table_have_one_name() {
        for topic in Topic::ALL {
            let columns = columns(topic.description(), &[]).unwrap();
            let mut names: Vec<&str> = LOG_COLUMNS.to_vec();
            names.extend(columns.iter().map(|column| column.name.as_str()));
            let count = names.len();
            names.sort_unstable();
            names.dedup();
            assert_eq!(names.len(), count, "{}", topic.name());
        }
    }
}
