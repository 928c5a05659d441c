//! Fields of a log over time, for plots.
//!
//! A background thread (`background`) reads the log once and fills [`Bins`]. Plotting any span then needs no
//! reading, except for a short span of a long log, whose bins are coarser than its ticks; that span is read
//! from the file.

pub mod bins;

mod place;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Mutex;

use run_log::RUN_TOPICS;
use serde::{Deserialize, Serialize};

use super::file::{LogFile, body_of};
use crate::board::lock;
use bins::{Bins, Columns, MOST_BINS};
pub(super) use place::FieldPlace;

/// Maximum number of fields kept per log: 128 MiB.
pub const MOST_FIELDS: usize = 32;
/// The fields plotted by default, so that the first pass over a log already reads them.
const FIRST: [(&str, &str); 6] = [
    ("/state", "tendon_tension_n[0]"),
    ("/state", "tendon_tension_n[1]"),
    ("/state", "bend_rad"),
    ("/state", "burr_force_n"),
    ("/state", "burr_speed_rad_per_s"),
    ("/timing/tick", "step_ns"),
];
/// Maximum number of columns per request.
const MOST_COLUMNS: u32 = 8192;
/// Maximum number of ticks read from the file per request: 64 MB of states.
const MOST_TICKS_READ: u64 = 1 << 14;
/// Maximum delay between a tick and the recording of its message in the timing lane.
const MOST_LATE_NS: u64 = 100_000_000;
/// Maximum number of misses kept, with their causes: 16 MiB. Further ones are only counted.
const MOST_MISSES: usize = 1 << 20;

/// A `/series` request: fields of a log over a span of time.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct SeriesRequest {
    /// The fields.
    pub fields: Vec<FieldName>,
    /// Start of the span, ns of simulated time.
    pub from_ns: u64,
    /// End of the span, ns.
    pub to_ns: u64,
    /// Number of columns to divide it into.
    pub columns: u32,
    /// Whether the request is for the second log.
    #[serde(default)]
    pub second: bool,
}

/// A scalar field of a topic's messages.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct FieldName {
    /// Topic.
    pub topic: String,
    /// Path of the field, such as `t_world_burr.position_m[2]`.
    pub field: String,
}

/// One of a log's two files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Lane {
    /// `run.mcap`.
    Run,
    /// `timing.mcap`.
    Timing,
}

impl Lane {
    fn of(topic: &str) -> Lane {
        if RUN_TOPICS.iter().any(|known| known.name() == topic) { Lane::Run } else { Lane::Timing }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Progress {
    Waiting,
    Reading,
    Read,
}

#[derive(Debug)]
struct Series {
    place: FieldPlace,
    bins: Bins,
    progress: Progress,
    /// Number of the last request for this field.
    used: u64,
}

#[derive(Debug, Default)]
struct SeriesTable {
    series: BTreeMap<FieldName, Series>,
    /// Time and letter of the cause, in log order.
    misses: Vec<(u64, char)>,
    missed: u64,
    /// Fraction of the log read so far, during a pass.
    reading: Option<f64>,
    requests: u64,
}

/// The part of a log read so far. Shared by the thread that reads it and those that answer requests.
#[derive(Debug)]
pub(super) struct LogSeries {
    begin_ns: u64,
    end_ns: u64,
    dt_ns: u64,
    found: Mutex<SeriesTable>,
}

/// Position of misses in a time span.
#[derive(Debug, Default, Serialize)]
struct Misses {
    /// Columns with at least one miss.
    at: Vec<u32>,
    /// Letter of the cause of the first miss in each.
    letters: String,
    /// Number of misses in each.
    count: Vec<u64>,
}

#[derive(Debug, Serialize)]
struct Answer {
    ok: bool,
    from_ns: u64,
    to_ns: u64,
    columns: u32,
    /// Fraction of the log read so far; `None` if all requested fields are complete.
    reading: Option<f64>,
    series: Vec<Columns>,
    misses: Misses,
}

impl LogSeries {
    /// Creates an empty series for a log with these bounds.
    pub(super) fn new((begin_ns, end_ns): (u64, u64), dt_ns: u64) -> LogSeries {
        let found = Mutex::default();
        let series = LogSeries { begin_ns, end_ns: end_ns.max(begin_ns), dt_ns: dt_ns.max(1), found };
        for (topic, field) in FIRST {
            // A field that a later version lacks is simply not read in advance.
            let _ = series.want(&FieldName { topic: topic.to_owned(), field: field.to_owned() });
        }
        series
    }

    /// First and last simulated time, ns.
    pub(super) fn bounds_ns(&self) -> (u64, u64) {
        (self.begin_ns, self.end_ns)
    }

    fn bins(&self) -> Bins {
        Bins::new(self.begin_ns, self.end_ns, self.dt_ns, MOST_BINS)
    }

    /// Keeps a field from now on; evicts the least recently requested one if there are too many.
    ///
    /// # Errors
    /// No such field.
    pub(super) fn want(&self, name: &FieldName) -> Result<(), String> {
        let mut found = lock(&self.found);
        found.requests += 1;
        let used = found.requests;
        if let Some(series) = found.series.get_mut(name) {
            series.used = used;
            return Ok(());
        }
        let place = FieldPlace::of(name)?;
        while found.series.len() >= MOST_FIELDS {
            let oldest = found.series.iter().min_by_key(|(_, series)| series.used);
            let Some(oldest) = oldest.map(|(name, _)| name.clone()) else { break };
            found.series.remove(&oldest);
        }
        let series = Series { place, bins: self.bins(), progress: Progress::Waiting, used };
        found.series.insert(name.clone(), series);
        Ok(())
    }

    /// Begins a pass over a file; returns the topics of the fields that wait for it.
    pub(super) fn begin(&self, lane: Lane) -> BTreeSet<String> {
        let mut found = lock(&self.found);
        let waiting = found
            .series
            .iter_mut()
            .filter(|(name, series)| series.progress == Progress::Waiting && Lane::of(&name.topic) == lane);
        let topics = waiting.map(|(name, series)| {
            series.progress = Progress::Reading;
            name.topic.clone()
        });
        topics.collect()
    }

    /// Adds a message during a pass.
    pub(super) fn add(&self, topic: &str, log_time_ns: u64, body: &[u8]) {
        let mut found = lock(&self.found);
        let reading = found
            .series
            .iter_mut()
            .filter(|(name, series)| series.progress == Progress::Reading && name.topic == topic);
        for (_, series) in reading {
            if let Some(value) = series.place.read(body) {
                series.bins.add(series.place.time_ns(body, log_time_ns, self.dt_ns), value);
            }
        }
    }

    /// Adds a late tick with the letter of its cause.
    pub(super) fn add_miss(&self, time_ns: u64, letter: char) {
        let mut found = lock(&self.found);
        found.missed += 1;
        if found.misses.len() < MOST_MISSES {
            found.misses.push((time_ns, letter));
        }
    }

    /// Sets the fraction of the log read so far; `None` at the end of a pass.
    pub(super) fn set_reading(&self, share: Option<f64>) {
        lock(&self.found).reading = share;
    }

    /// Ends a pass.
    pub(super) fn end(&self, lane: Lane) {
        let mut found = lock(&self.found);
        let read = found
            .series
            .iter_mut()
            .filter(|(name, series)| series.progress == Progress::Reading && Lane::of(&name.topic) == lane);
        read.for_each(|(_, series)| series.progress = Progress::Read);
    }

    /// Returns the fraction of the log read so far, or `None` if no pass is in progress.
    pub(super) fn reading(&self) -> Option<f64> {
        lock(&self.found).reading
    }

    /// Returns the number of missed ticks up to a time, and in the whole log.
    pub(super) fn missed(&self, time_ns: u64) -> (u64, u64) {
        let found = lock(&self.found);
        let until = found.misses.partition_point(|(time, _)| *time <= time_ns) as u64;
        // If a log has more misses than are kept, those after the last kept one are not distinguished.
        let all_kept = found.missed == found.misses.len() as u64;
        (if all_kept || until < found.misses.len() as u64 { until } else { found.missed }, found.missed)
    }

    /// Answers a request. `file` returns one of the log's files, for a span too short for the bins'
    /// resolution.
    ///
    /// # Errors
    /// An error text for the user.
    pub(super) fn answer<'a>(
        &self,
        request: &SeriesRequest,
        file: impl Fn(Lane) -> Option<&'a LogFile>,
    ) -> Result<String, String> {
        request.check()?;
        request.fields.iter().try_for_each(|name| self.want(name))?;
        let mut series: Vec<Columns> = Vec::new();
        let mut fine: Vec<Fine<'_>> = Vec::new();
        for name in &request.fields {
            let (columns, place) = self.columns(name, request);
            series.push(columns);
            fine.extend(place.map(|place| self.fine(name, place, series.len() - 1, request)));
        }
        for lane in [Lane::Run, Lane::Timing] {
            let mut own: Vec<&mut Fine<'_>> =
                fine.iter_mut().filter(|fine| Lane::of(&fine.name.topic) == lane).collect();
            let Some(log) = file(lane).filter(|_| !own.is_empty()) else { continue };
            // If the file cannot be read, the bins are shown instead.
            if self.read_span(&mut own, request, log).is_some() {
                for fine in own {
                    series[fine.at] = fine.bins.columns(request.from_ns, request.to_ns, request.columns);
                }
            }
        }
        let found = lock(&self.found);
        let all_read = request
            .fields
            .iter()
            .all(|name| found.series.get(name).is_none_or(|series| series.progress == Progress::Read));
        let answer = Answer {
            ok: true,
            from_ns: request.from_ns,
            to_ns: request.to_ns,
            columns: request.columns,
            reading: if all_read { None } else { Some(found.reading.unwrap_or(0.0)) },
            series,
            misses: misses(&found.misses, request),
        };
        serde_json::to_string(&answer).map_err(|error| error.to_string())
    }

    /// Returns a field's values from the bins, and its place if they are too coarse for the request and the
    /// file must be read.
    fn columns(&self, name: &FieldName, request: &SeriesRequest) -> (Columns, Option<FieldPlace>) {
        let found = lock(&self.found);
        let Some(series) = found.series.get(name) else { return (Columns::default(), None) };
        let shown = series.bins.columns(request.from_ns, request.to_ns, request.columns);
        let width_ns = if series.progress == Progress::Read { series.bins.width_ns() } else { u64::MAX };
        let span_ns = request.to_ns - request.from_ns;
        let is_coarse = width_ns > self.dt_ns && span_ns / width_ns < u64::from(request.columns);
        let is_to_read = is_coarse && span_ns / self.dt_ns <= MOST_TICKS_READ;
        (shown, is_to_read.then(|| series.place.clone()))
    }

    fn fine<'a>(
        &self,
        name: &'a FieldName,
        place: FieldPlace,
        at: usize,
        request: &SeriesRequest,
    ) -> Fine<'a> {
        let (from, to) = (request.from_ns.max(self.begin_ns), request.to_ns.min(self.end_ns));
        Fine { name, place, at, bins: Bins::new(from, to, self.dt_ns, MOST_BINS) }
    }

    /// Reads the span's messages from a file, once for all fields.
    fn read_span(&self, fields: &mut [&mut Fine<'_>], request: &SeriesRequest, log: &LogFile) -> Option<()> {
        let to = request.to_ns.min(self.end_ns);
        let topics: BTreeSet<&str> = fields.iter().map(|fine| fine.name.topic.as_str()).collect();
        let topics: Vec<&str> = topics.into_iter().collect();
        let mut reading = log.after(request.from_ns.checked_sub(1), &topics).ok()?;
        let mut left = 2 * MOST_TICKS_READ * topics.len() as u64;
        loop {
            let is_behind = reading.next_with(|topic, time_ns, payload| {
                let body = body_of(payload);
                for fine in fields.iter_mut().filter(|fine| fine.name.topic == topic) {
                    if let Some(value) = fine.place.read(body) {
                        fine.bins.add(fine.place.time_ns(body, time_ns, self.dt_ns), value);
                    }
                }
                time_ns > to.saturating_add(MOST_LATE_NS)
            });
            match is_behind.ok()? {
                Some(false) => left = left.checked_sub(1)?,
                Some(true) | None => return Some(()),
            }
        }
    }
}

/// A field read from the file at full resolution.
struct Fine<'a> {
    name: &'a FieldName,
    place: FieldPlace,
    /// Its index in the answer.
    at: usize,
    bins: Bins,
}

impl SeriesRequest {
    fn check(&self) -> Result<(), String> {
        let SeriesRequest { fields, from_ns, to_ns, columns, .. } = self;
        if from_ns >= to_ns {
            return Err(format!("empty time span: {from_ns} to {to_ns} ns"));
        }
        if !(1..=MOST_COLUMNS).contains(columns) {
            return Err(format!("`columns` is {columns}; allowed: 1 to {MOST_COLUMNS}"));
        }
        if fields.len() > MOST_FIELDS {
            return Err(format!("too many fields: {}; at most {MOST_FIELDS} are allowed", fields.len()));
        }
        Ok(())
    }
}

fn misses(all: &[(u64, char)], request: &SeriesRequest) -> Misses {
    let mut found = Misses::default();
    let (from, span) = (request.from_ns, u128::from(request.to_ns - request.from_ns));
    let begin = all.partition_point(|(time, _)| *time < from);
    for (time, letter) in all[begin..].iter().take_while(|(time, _)| *time <= request.to_ns) {
        let column = u128::from(time.saturating_sub(from)) * u128::from(request.columns) / span;
        let column = column.min(u128::from(request.columns) - 1) as u32;
        if found.at.last() != Some(&column) {
            found.at.push(column);
            found.letters.push(*letter);
            found.count.push(0);
        }
        if let Some(count) = found.count.last_mut() {
            *count += 1;
        }
    }
    found
}
