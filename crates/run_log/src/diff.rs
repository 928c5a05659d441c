//! `diff` — compares two logs of a run.

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::io::Write;

use foreign_text::{foreign, foreign_line};
use messages::layout::Message;
use messages::{DrrReply, Frame, ImagePrefix, Keyframe, Latched, Tick};
use zerocopy::IntoBytes;

use crate::difference::{Divergence, compare, compare_removed};
use crate::end::EndReason;
use crate::error::LogError;
use crate::frames::{FrameReader, FrameRecord, frames};
use crate::header::LogHeader;
use crate::reader::{LogReader, TickRecord};
use crate::seal::SEAL;
use crate::source::LogSource;
use crate::stream::{LogMessage, MessageStream, ReadOptions};
use crate::topics::{Logged, Topic};
use crate::verdict::Verdict;
use crate::verify::{compare_readings, compare_state};

/// A header entry that differs; empty where a log lacks the entry.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HeaderDifference {
    /// Name of the entry.
    pub name: String,
    /// In the first log.
    pub first: String,
    /// In the second log.
    pub second: String,
}

/// Result of comparing two logs.
#[derive(Debug, Default)]
pub struct DiffReport {
    /// Header entries that differ.
    pub header: Vec<HeaderDifference>,
    /// Complete ticks that are identical.
    pub identical_ticks: u64,
    /// Frames that are identical.
    pub identical_frames: u64,
    /// The first tick that differs.
    pub ticks: Option<Divergence>,
    /// The first frame that differs.
    pub frames: Option<Divergence>,
    /// The first keyframe part and the first reply that differ.
    pub messages: Vec<Divergence>,
    /// Items that only one log has, and each log's end reason if the reasons differ. A log that merely lacks
    /// its end is covered by its verdict.
    pub remarks: Vec<String>,
    /// The faults of each log.
    pub verdicts: [Verdict; 2],
}

impl DiffReport {
    /// Returns true if both logs contain the same ticks, frames, keyframes and replies. Header entries may
    /// differ (another build, another mode).
    pub fn same_run(&self) -> bool {
        let none_differs = self.ticks.is_none() && self.frames.is_none() && self.messages.is_empty();
        none_differs && self.remarks.is_empty()
    }

    /// Writes the comparison as text.
    pub fn write(&self, out: &mut dyn Write) -> Result<(), LogError> {
        for HeaderDifference { name, first, second } in &self.header {
            let [name, first, second] = [name, first, second].map(|text| foreign(text));
            writeln!(out, "header {name}: \"{first}\" against \"{second}\"")?;
        }
        writeln!(
            out,
            "{} identical ticks, {} identical frames",
            self.identical_ticks, self.identical_frames
        )?;
        for divergence in self.ticks.iter().chain(&self.frames).chain(&self.messages) {
            writeln!(out, "{divergence}")?;
        }
        for remark in &self.remarks {
            writeln!(out, "{}", foreign_line(remark))?;
        }
        for (name, verdict) in ["first", "second"].into_iter().zip(&self.verdicts) {
            if !verdict.is_intact() {
                writeln!(out, "the {name} log: {verdict}")?;
            }
        }
        if self.same_run() {
            writeln!(out, "identical")?;
        }
        Ok(())
    }
}

/// Compares two `run.mcap`: headers, every tick, every frame, every keyframe and reply. Two logs of one run
/// may interleave frames and ticks differently; that does not count as a difference.
pub fn diff(
    first: &dyn LogSource,
    second: &dyn LogSource,
    options: ReadOptions,
) -> Result<DiffReport, LogError> {
    let mut report = DiffReport::default();
    compare_ticks(first, second, options, &mut report)?;
    compare_frames(first, second, options, &mut report)?;
    compare_messages::<Keyframe>(first, second, options, &mut report)?;
    compare_messages::<DrrReply>(first, second, options, &mut report)?;
    Ok(report)
}

fn compare_ticks(
    first: &dyn LogSource,
    second: &dyn LogSource,
    options: ReadOptions,
    out: &mut DiffReport,
) -> Result<(), LogError> {
    let mut a = LogReader::open_with(first, options)?;
    let mut b = LogReader::open_with(second, options)?;
    out.header = compare_headers(a.stream().metadata(), b.stream().metadata());
    if a.beginning().is_none() && b.beginning().is_none() {
        out.ticks = compare_state(a.initial(), b.initial())
            .or_else(|| compare_removed(Tick::START, a.predrilled(), b.predrilled()));
    }
    let (mut x, mut y) = (next_tick(&mut a)?, next_tick(&mut b)?);
    // Counts ticks that only one log has because the other has a gap there.
    let mut alone = [0_u64; 2];
    while out.ticks.is_none() {
        // After a gap in one log, resume both at the next tick they share.
        if let (Some(in_a), Some(in_b)) = (&x, &y) {
            match in_a.state.tick.cmp(&in_b.state.tick) {
                Ordering::Less => {
                    alone[0] += 1;
                    x = next_tick(&mut a)?;
                    continue;
                }
                Ordering::Greater => {
                    alone[1] += 1;
                    y = next_tick(&mut b)?;
                    continue;
                }
                Ordering::Equal => {}
            }
        }
        match (x, y) {
            (Some(x), Some(y)) => {
                out.ticks = compare_tick(&x, &y);
                out.identical_ticks += u64::from(out.ticks.is_none());
            }
            (None, None) => {
                if let (Some(x), Some(y)) = (reason(&a), reason(&b))
                    && x != y
                {
                    out.remarks.push(format!("{}: {}", first.path().display(), a.ending().describe()));
                    out.remarks.push(format!("{}: {}", second.path().display(), b.ending().describe()));
                }
                break;
            }
            (more_in_first, _) => {
                let (long, short, ending) = match more_in_first {
                    Some(_) => (first, second, b.ending()),
                    None => (second, first, a.ending()),
                };
                let (long, short, ending) =
                    (long.path().display(), short.path().display(), ending.describe());
                out.remarks.push(format!("{short} ends first, {long} continues: {ending}"));
                break;
            }
        }
        (x, y) = (next_tick(&mut a)?, next_tick(&mut b)?);
    }
    for (path, count) in [first, second].into_iter().zip(alone).filter(|(_, count)| *count > 0) {
        out.remarks.push(format!("{count} ticks are only in {}", path.path().display()));
    }
    // The verdict covers the whole log, so read both to the end even if they differ earlier.
    for reader in [&mut a, &mut b] {
        while let Ok(Some(_)) = next_tick(reader) {}
    }
    out.verdicts = [a.stream().verdict(), b.stream().verdict()];
    Ok(())
}

/// Returns the next complete tick, skipping a gap if necessary.
fn next_tick(reader: &mut LogReader) -> Result<Option<TickRecord>, LogError> {
    loop {
        match reader.next() {
            Some(Ok(tick)) => return Ok(Some(tick)),
            None => return Ok(None),
            Some(Err(LogError::Gap { .. })) => {
                if reader.go_on()?.is_none() {
                    return Ok(None);
                }
            }
            Some(Err(error)) => return Err(error),
        }
    }
}

/// Returns why a run ended, if its log says so; for a repaired log, the reason before the repair.
fn reason(reader: &LogReader) -> Option<&EndReason> {
    let mut reason = &reader.ending().marker.as_ref()?.reason;
    while let EndReason::Repaired(before) = reason {
        reason = before.as_ref()?;
    }
    Some(reason)
}

fn compare_headers(a: &BTreeMap<String, String>, b: &BTreeMap<String, String>) -> Vec<HeaderDifference> {
    let names: std::collections::BTreeSet<&String> =
        a.keys().chain(b.keys()).filter(|name| *name != SEAL).collect();
    let value = |map: &BTreeMap<String, String>, name: &String| map.get(name).cloned().unwrap_or_default();
    let entries = names.into_iter().map(|name| HeaderDifference {
        name: name.clone(),
        first: value(a, name),
        second: value(b, name),
    });
    entries.filter(|entry| entry.first != entry.second).collect()
}

/// Compares two ticks. The command is compared first, because the state is its effect.
fn compare_tick(a: &TickRecord, b: &TickRecord) -> Option<Divergence> {
    let restored = |tick: &TickRecord| tick.restored.clone().unwrap_or_default();
    let (x, y) = (a.latched.as_bytes(), b.latched.as_bytes());
    compare(Topic::Latched, Tick(a.latched.tick), Latched::DESCRIPTION, x, y)
        .or_else(|| compare_state(&a.state, &b.state))
        .or_else(|| compare_removed(Tick(a.state.tick), &restored(a), &restored(b)))
        .or_else(|| compare_removed(Tick(a.state.tick), &a.removed, &b.removed))
        .or_else(|| compare_readings(Tick(a.state.tick), &a.readings, &b.readings))
}

fn compare_frames(
    first: &dyn LogSource,
    second: &dyn LogSource,
    options: ReadOptions,
    out: &mut DiffReport,
) -> Result<(), LogError> {
    let (mut a, mut b) = (frames(first, options)?, frames(second, options)?);
    let mut start = SharedStart::of(a.header(), b.header());
    while out.frames.is_none() {
        let of = |frame: &FrameRecord| Tick(frame.frame.tick);
        let (x, y) = start.next_pair(of, || next_frame(&mut a), || next_frame(&mut b))?;
        match (x, y) {
            (Some(x), Some(y)) => {
                out.frames = compare_frame(&x, &y);
                out.identical_frames += u64::from(out.frames.is_none());
            }
            (None, None) => break,
            (more_in_first, _) => {
                let long = if more_in_first.is_some() { first } else { second };
                out.remarks.push(format!("{} has more frames", long.path().display()));
                break;
            }
        }
    }
    Ok(())
}

/// Where to start comparing two logs of which one begins later.
struct SharedStart {
    first_tick: Tick,
    is_found: bool,
}

impl SharedStart {
    fn of(a: &LogHeader, b: &LogHeader) -> SharedStart {
        SharedStart { first_tick: a.first_tick.max(b.first_tick), is_found: a.first_tick == b.first_tick }
    }

    /// Returns the next item of each log, given their ticks; skips those before the shared part.
    fn next_pair<T>(
        &mut self,
        tick: impl Fn(&T) -> Tick,
        mut a: impl FnMut() -> Result<Option<T>, LogError>,
        mut b: impl FnMut() -> Result<Option<T>, LogError>,
    ) -> Result<(Option<T>, Option<T>), LogError> {
        let precedes = |x: &Option<T>, y: &Option<T>| {
            let (x, y) = (x.as_ref().map(&tick), y.as_ref().map(&tick));
            x.is_some_and(|x| x < self.first_tick || y.is_some_and(|y| x < y))
        };
        let (mut x, mut y) = (a()?, b()?);
        while !self.is_found {
            if precedes(&x, &y) {
                x = a()?;
            } else if precedes(&y, &x) {
                y = b()?;
            } else {
                self.is_found = true;
            }
        }
        Ok((x, y))
    }
}

/// Returns the next frame, skipping a gap if necessary.
fn next_frame(reader: &mut FrameReader) -> Result<Option<FrameRecord>, LogError> {
    loop {
        match reader.next().transpose() {
            Err(LogError::Gap { .. }) if reader.go_on() => {}
            other => return other,
        }
    }
}

/// Compares the messages of a topic in order, byte by byte.
fn compare_messages<M: Logged>(
    first: &dyn LogSource,
    second: &dyn LogSource,
    options: ReadOptions,
    out: &mut DiffReport,
) -> Result<(), LogError> {
    let open = |log: &dyn LogSource| MessageStream::open_topics(log, &[M::TOPIC.name().to_owned()], options);
    let (mut a, mut b) = (open(first)?, open(second)?);
    let dt_ns = a.header().dt_ns.max(1);
    let mut start = SharedStart::of(a.header(), b.header());
    let next = |stream: &mut MessageStream| {
        let owned = |message: LogMessage<'_>| (Tick(message.log_time_ns / dt_ns), message.body.to_vec());
        Ok(stream.next_message()?.map(owned))
    };
    loop {
        match start.next_pair(|(tick, _)| *tick, || next(&mut a), || next(&mut b))? {
            (Some((tick, x)), Some((_, y))) => {
                if let Some(divergence) = compare(M::TOPIC, tick, M::DESCRIPTION, &x, &y) {
                    out.messages.push(divergence);
                    return Ok(());
                }
            }
            (None, None) => return Ok(()),
            (more_in_first, _) => {
                let long = if more_in_first.is_some() { first } else { second };
                out.remarks.push(format!("{} has more messages of {}", long.path().display(), M::TOPIC));
                return Ok(());
            }
        }
    }
}

/// Compares two frames. If a log contains hashes instead of images, the frames' own fields decide, including
/// the hash.
pub fn compare_frame(a: &FrameRecord, b: &FrameRecord) -> Option<Divergence> {
    let (tick, frame) = (Tick(a.frame.tick), Frame::DESCRIPTION);
    compare(Topic::DrrFrame, tick, frame, a.frame.as_bytes(), b.frame.as_bytes()).or_else(|| {
        let (x, y) = (a.image.as_ref()?, b.image.as_ref()?);
        let (x, y) = ([x.as_bytes(), &a.pixels].concat(), [y.as_bytes(), &b.pixels].concat());
        compare(Topic::DrrImage, tick, ImagePrefix::DESCRIPTION, &x, &y)
    })
}
