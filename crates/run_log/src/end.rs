//! How a log ends: with the marker of a clean finish, or truncated.

use std::collections::BTreeMap;
use std::path::Path;

use foreign_text::{foreign, foreign_line};
use messages::Tick;

use crate::error::LogError;
use crate::header::Entries;
use crate::seal::{is_unbroken, seal};

/// Name of the metadata record that a clean finish writes last.
pub const END_RECORD: &str = "end";

/// Name of the metadata record near the start of a repaired log.
pub const REPAIR_RECORD: &str = "repair";

/// End reason of a log that was moved, written by the end marker and the launcher. No part has this name.
const LOG_MOVED: &str = "log moved";

const PART_DIED: &str = "part died: ";
const CONTROLLER_MISSING: &str = "controller missing: ";
const CONTROLLER_LATE: &str = "controller late: ";
const SIMULATION_FAILED: &str = "simulation failed: ";
const SAVED: &str = "saved: ";

/// A reason with a detail (part, controller or cause): its text prefix and constructor.
type NamedReason = (&'static str, fn(String) -> EndReason);

/// The reasons with a detail, by text prefix.
const NAMED: [NamedReason; 5] = [
    (PART_DIED, EndReason::PartDied),
    (CONTROLLER_MISSING, EndReason::ControllerMissing),
    (CONTROLLER_LATE, EndReason::ControllerLate),
    (SIMULATION_FAILED, EndReason::SimulationFailed),
    (SAVED, EndReason::Saved),
];

/// Why a run ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum EndReason {
    /// The scene ran all its ticks. Older logs also use this for a run that was stopped.
    Completed,
    /// Run control stopped the run before its last tick.
    Stopped,
    /// A signal ended it.
    Interrupted,
    /// A part died; holds its name.
    PartDied(String),
    /// A controller did not join in time; holds its name.
    ControllerMissing(String),
    /// In lockstep, a controller did not answer in time; holds its name.
    ControllerLate(String),
    /// The simulation could not compute a tick, whose commands are the log's last. Holds the tick and the
    /// cause, as `tick 81: …`.
    SimulationFailed(String),
    /// The run continued; its recorder had saved what was before and after some events. Holds them, as `tick
    /// 81: breach; …`.
    Saved(String),
    /// The log, or its folder, was moved while it was being written.
    LogMoved,
    /// The log was damaged or truncated, then repaired; holds its earlier reason if that could be read.
    Repaired(Option<Box<EndReason>>),
}

impl EndReason {
    /// The reason as text for the end marker.
    pub fn text(&self) -> String {
        match self {
            EndReason::Completed => "completed".to_string(),
            EndReason::Stopped => "stopped".to_string(),
            EndReason::Interrupted => "interrupted".to_string(),
            EndReason::PartDied(part) => format!("{PART_DIED}{part}"),
            EndReason::ControllerMissing(name) => format!("{CONTROLLER_MISSING}{name}"),
            EndReason::ControllerLate(name) => format!("{CONTROLLER_LATE}{name}"),
            EndReason::SimulationFailed(cause) => format!("{SIMULATION_FAILED}{cause}"),
            EndReason::Saved(causes) => format!("{SAVED}{causes}"),
            EndReason::LogMoved => LOG_MOVED.to_string(),
            EndReason::Repaired(None) => "repaired".to_string(),
            EndReason::Repaired(Some(before)) => format!("repaired, before: {}", before.text()),
        }
    }

    /// Parses the output of [`text`](Self::text); returns `None` for any other text.
    pub fn parse(text: &str) -> Option<EndReason> {
        match text {
            "completed" => Some(EndReason::Completed),
            "stopped" => Some(EndReason::Stopped),
            "interrupted" => Some(EndReason::Interrupted),
            LOG_MOVED => Some(EndReason::LogMoved),
            "repaired" => Some(EndReason::Repaired(None)),
            _ if text.starts_with("repaired, before: ") => {
                let before =
                    text.strip_prefix("repaired, before: ").filter(|rest| !rest.starts_with("repaired"));
                Some(EndReason::Repaired(Some(Box::new(EndReason::parse(before?)?))))
            }
            _ => {
                NAMED.iter().find_map(|(prefix, reason)| Some(reason(text.strip_prefix(prefix)?.to_string())))
            }
        }
    }
}

/// Final state of the writer, stored at the end of a log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EndMarker {
    /// Why the run ended.
    pub reason: EndReason,
    /// `State.tick` of the last state; in the timing lane, the tick of the last message. `None` if the log
    /// has none.
    pub last_tick: Option<Tick>,
    /// `State.hash` of the last state, low word first; `None` in the timing lane.
    pub hash: Option<[u64; 2]>,
    /// Messages written, by topic.
    pub counts: BTreeMap<String, u64>,
    /// Messages that never reached the log, by topic: those missing by their numbers, and those counted by
    /// the writer's owner. Topics without losses are absent.
    pub lost: BTreeMap<String, u64>,
    /// Messages lost to damage of the log, by topic; only in a repaired log.
    pub damaged: BTreeMap<String, u64>,
}

impl EndMarker {
    /// Returns the marker as entries of its metadata record.
    pub fn to_metadata(&self) -> BTreeMap<String, String> {
        let mut entries = BTreeMap::new();
        entries.insert("reason".to_string(), self.reason.text());
        entries.insert("last_tick".to_string(), self.last_tick.map(|n| n.to_string()).unwrap_or_default());
        let hash = self.hash.map(hash_text).unwrap_or_default();
        entries.insert("hash".to_string(), hash);
        let named = |prefix: &str, (topic, n): (&String, &u64)| (format!("{prefix}{topic}"), n.to_string());
        entries.extend(self.counts.iter().map(|entry| named("count", entry)));
        entries.extend(self.lost.iter().map(|entry| named("lost", entry)));
        entries.extend(self.damaged.iter().map(|entry| named("damaged", entry)));
        seal(&mut entries);
        entries
    }

    /// Describes the losses; empty if there are none.
    fn losses(&self) -> String {
        let list = |what: &str, counts: &BTreeMap<String, u64>| {
            let each: Vec<String> = counts.iter().map(|(topic, n)| format!("{n} of {topic}")).collect();
            if each.is_empty() { String::new() } else { format!("; {what}: {}", each.join(", ")) }
        };
        list("lost by the recorder", &self.lost) + &list("lost to damage", &self.damaged)
    }

    /// Reads the entries of a log's metadata record [`END_RECORD`].
    ///
    /// # Errors
    /// An entry is missing or wrong, or the checksum does not match. `path` is the file named in the error.
    pub fn from_metadata(path: &Path, map: &BTreeMap<String, String>) -> Result<EndMarker, LogError> {
        let entries = Entries { path, record: END_RECORD, entries: map };
        if !is_unbroken(map) {
            return Err(entries.wrong("crc32", "the checksum of the other entries"));
        }
        let wrong_reason = || {
            entries.wrong(
                "reason",
                "completed, stopped, interrupted, log moved, saved, part died, controller missing or \
                 controller late",
            )
        };
        let reason = EndReason::parse(entries.text("reason")?).ok_or_else(wrong_reason)?;
        let last_tick = match entries.text("last_tick")? {
            "" => None,
            _ => Some(Tick(entries.number("last_tick", "a number")?)),
        };
        let hash = match entries.text("hash")? {
            "" => None,
            text => {
                let value = u128::from_str_radix(text, 16);
                let value = value.map_err(|_| entries.wrong("hash", "32 hexadecimal digits"))?;
                Some([value as u64, (value >> 64) as u64])
            }
        };
        let numbers = |prefix: &str| -> Result<BTreeMap<String, u64>, LogError> {
            let keys = map.keys().filter_map(|key| key.strip_prefix(prefix).map(|topic| (key, topic)));
            let keys = keys.filter(|(_, topic)| topic.starts_with('/'));
            keys.map(|(key, topic)| Ok((topic.to_string(), entries.number(key, "a number")?))).collect()
        };
        let (counts, lost, damaged) = (numbers("count")?, numbers("lost")?, numbers("damaged")?);
        Ok(EndMarker { reason, last_tick, hash, counts, lost, damaged })
    }
}

/// Formats a chained hash as 32 hexadecimal digits, high word first.
pub fn hash_text(hash: [u64; 2]) -> String {
    format!("{:016x}{:016x}", hash[1], hash[0])
}

/// How a file ends.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Ending {
    /// The marker of a clean finish, if there is one.
    pub marker: Option<EndMarker>,
    /// Set if the file stops before the end that MCAP requires.
    pub cut: Option<TruncationPoint>,
}

/// Where a file stops.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TruncationPoint {
    /// End of the last complete record; everything before it was read.
    pub offset: u64,
    /// Bytes of the incomplete record that follows.
    pub incomplete_bytes: u64,
}

impl Ending {
    /// Returns true if the marker is present and the file is not truncated.
    pub fn is_complete(&self) -> bool {
        self.marker.is_some() && self.cut.is_none()
    }

    /// Describes the ending in one line.
    pub fn describe(&self) -> String {
        let marker = match &self.marker {
            Some(marker) => {
                format!("end marker: {}{}", foreign(&marker.reason.text()), foreign_line(&marker.losses()))
            }
            None => "no end marker: the recorder did not finish, later ticks may be missing".to_string(),
        };
        match self.cut {
            None => marker,
            Some(cut) => {
                let TruncationPoint { offset, incomplete_bytes } = cut;
                format!(
                    "{marker}; truncated after byte {offset}, {incomplete_bytes} bytes of an incomplete \
                     record skipped"
                )
            }
        }
    }
}
