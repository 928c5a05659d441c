//! Marks for a log: events, missed ticks, gaps, and where two logs diverge.

use ipc_types::messages::{Event, Removed, Severity, State, Tick, TickTiming};
use run_log::misses::Misses;
use run_log::{LogHeader, Topic, Verdict, voxel_indices, voxels_of};
use serde_json::{Value, json};
use zerocopy::FromBytes;

/// Maximum number of marks of one kind; the first ones are kept.
const MOST: usize = 2000;
/// Maximum number of removed voxels kept, over all resets: 1 GiB.
const MOST_REMOVED: u64 = 1 << 28;

/// A mark on the time line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mark {
    /// Simulated time, ns.
    pub time_ns: u64,
    /// `event`, `note` (an informational event), `miss`, `divergence` or `gap`.
    pub kind: &'static str,
    /// Text for the user.
    pub text: String,
}

impl Mark {
    /// As JSON for the page.
    pub fn json(&self) -> Value {
        json!({"time_ns": self.time_ns, "kind": self.kind, "text": self.text})
    }
}

/// Result of one pass over a run lane.
#[derive(Debug, Clone)]
pub struct Outline {
    /// The log's header.
    pub header: LogHeader,
    /// Tick of the newest state.
    last_tick: Option<u64>,
    /// Removals in order, with their times.
    pub removals: Vec<(u64, Removed, Vec<u32>)>,
    /// Gaps.
    pub marks: Vec<Mark>,
    /// Whether the log has frames.
    pub has_frames: bool,
    /// Notices for the user.
    pub notices: Vec<String>,
    /// Voxels removed since the last reset, and in total.
    since_reset: u64,
    kept: u64,
    /// Whether removals at the end were dropped.
    cut_short: bool,
}

impl Outline {
    /// Creates an empty outline.
    pub(super) fn new(header: LogHeader) -> Outline {
        Outline {
            header,
            last_tick: None,
            removals: Vec::new(),
            marks: Vec::new(),
            has_frames: false,
            notices: Vec::new(),
            since_reset: 0,
            kept: 0,
            cut_short: false,
        }
    }

    /// Adds the file's faults, at its end.
    pub(super) fn end(&mut self, verdict: &Verdict) {
        self.notices.extend(verdict.faults.iter().map(ToString::to_string));
        if self.header.first_tick > Tick::START {
            let first = self.header.first_tick;
            self.notices.push(format!("the log begins at tick {first}: bone drilled before is shown intact"));
        }
        if !self.has_frames {
            self.notices.push("the log has no X-ray frames".to_owned());
        }
    }

    /// Adds a message.
    pub(super) fn add(&mut self, topic: Option<Topic>, time_ns: u64, body: &[u8]) {
        match topic {
            Some(Topic::State) => {
                let Ok(state) =
                    State::ref_from_bytes(body).copied().or_else(|_| State::read_from_bytes(body))
                else {
                    return;
                };
                if let Some(last) = self.last_tick
                    && last.checked_add(1) != Some(state.tick)
                    && self.marks.len() < MOST
                {
                    let (from, to) = (last.saturating_add(1), state.tick.saturating_sub(1));
                    let text = format!("ticks {from} to {to} are missing");
                    self.marks.push(Mark { time_ns, kind: "gap", text });
                }
                self.last_tick = Some(state.tick);
            }
            Some(Topic::Removed) => {
                if let Ok((removed, tail)) = Removed::read_from_prefix(body) {
                    self.remove(time_ns, removed, voxel_indices(tail));
                }
            }
            Some(Topic::DrrFrame) => self.has_frames = true,
            _ => {}
        }
    }

    /// Keeps a removal while the total is physically possible and fits into memory: an untrusted log can pack
    /// any number of removals into few bytes.
    fn remove(&mut self, time_ns: u64, removed: Removed, voxels: Vec<u32>) {
        // Counts at least one, because a removal without voxels takes memory too.
        let count = voxels.len().max(1) as u64;
        if removed.restore_first != 0 {
            self.since_reset = 0;
        }
        self.since_reset += count;
        self.kept += count;
        // One extra, because a reset's own message may contain no voxel.
        let impossible = self.since_reset > voxels_of(&self.header).saturating_add(1);
        if (impossible || self.kept > MOST_REMOVED) && !self.cut_short {
            self.cut_short = true;
            let tick = removed.tick;
            let cause = if impossible { "the volume has" } else { "a viewer can hold" };
            self.notices.push(format!(
                "the bone is shown as it was before tick {tick}: more voxels are removed than {cause}"
            ));
        }
        if !self.cut_short {
            self.removals.push((time_ns, removed, voxels));
        }
    }
}

/// Returns the first tick that both logs have with different chained hashes, or the first tick after the end
/// of the shorter log. A gap in one log is not a divergence: the chain continues after it.
pub(super) fn part(
    first: impl Iterator<Item = (u64, [u64; 2])>,
    second: impl Iterator<Item = (u64, [u64; 2])>,
) -> Option<(u64, &'static str)> {
    let (mut first, mut second) = (first, second);
    let (mut a, mut b) = (first.next(), second.next());
    loop {
        match (a, b) {
            (Some((x, _)), Some((y, _))) if x < y => a = first.next(),
            (Some((x, _)), Some((y, _))) if x > y => b = second.next(),
            (Some((_, x)), Some((_, y))) if x == y => (a, b) = (first.next(), second.next()),
            (Some((tick, _)), Some(_)) => return Some((tick, "diverge at")),
            (Some((tick, _)), None) => return Some((tick, "differ in length: the second ends before")),
            (None, Some((tick, _))) => return Some((tick, "differ in length: the first ends before")),
            (None, None) => return None,
        }
    }
}

/// Events and missed ticks of a timing lane. Each is placed at the tick it refers to, because the log time is
/// when the recorder received it.
pub(super) struct Events {
    dt_ns: u64,
    events: Vec<Mark>,
    misses: Vec<Mark>,
    causes: Misses,
}

impl Events {
    /// Creates an empty list.
    pub(super) fn new(dt_ns: u64) -> Events {
        Events { dt_ns, events: Vec::new(), misses: Vec::new(), causes: Misses::default() }
    }

    /// Adds a message; returns time and cause of a late tick.
    pub(super) fn add(&mut self, topic: Option<Topic>, body: &[u8]) -> Option<(u64, char)> {
        match topic {
            Some(Topic::Event) => {
                let (event, text) = Event::read_from_prefix(body).ok()?;
                let time_ns = event.tick.saturating_mul(self.dt_ns);
                let text = String::from_utf8_lossy(text.strip_suffix(&[0]).unwrap_or(text)).into_owned();
                let kind = if event.severity == Severity::Info as u32 { "note" } else { "event" };
                push(&mut self.events, Mark { time_ns, kind, text });
                None
            }
            Some(Topic::TickTiming) => {
                let timing = TickTiming::read_from_bytes(body).ok()?;
                let cause = self.causes.add(&timing)?.main_cause();
                let time_ns = timing.tick.saturating_mul(self.dt_ns);
                let late_us = timing.wake_lateness_ns as f64 * 1e-3;
                let text = format!("tick {} started {late_us:.0} µs late: {}", timing.tick, cause.name());
                push(&mut self.misses, Mark { time_ns, kind: "miss", text });
                Some((time_ns, cause.letter()))
            }
            _ => None,
        }
    }

    /// The marks.
    pub(super) fn marks(self) -> Vec<Mark> {
        self.events.into_iter().chain(self.misses).collect()
    }
}

fn push(marks: &mut Vec<Mark>, mark: Mark) {
    if marks.len() < MOST {
        marks.push(mark);
    }
}

#[cfg(test)]
mod tests {
    use recorder_proc::build_info;
    use run_log::RunMode;
    use zerocopy::IntoBytes;

    use super::*;

    fn outline_of(volume_dimensions: [u32; 3]) -> Outline {
        Outline::new(LogHeader {
            scene_toml: String::new(),
            calibration_json: None,
            scene_name: String::new(),
            volume_sha256: None,
            volume_dimensions,
            dt_ns: 1_000_000,
            mode: RunMode::RealTime,
            controllers: Vec::new(),
            build: build_info::current(),
            first_tick: Tick::START,
        })
    }

    #[test]
    fn a_state_of_the_last_tick_there_is_panics_nowhere() {
        let mut outline = outline_of([1; 3]);
        for tick in [0, u64::MAX, 0, 1] {
            let state = State { tick, ..State::zeroed() };
            outline.add(Some(Topic::State), 0, state.as_bytes());
        }
        let texts: Vec<&str> = outline.marks.iter().map(|mark| mark.text.as_str()).collect();
        let last = u64::MAX;
        let first = format!("ticks 1 to {} are missing", last - 1);
        assert_eq!(texts, [first, format!("ticks {last} to 0 are missing")]);
    }

    #[test]
    fn removals_that_no_volume_can_hold_are_not_kept() {
        let mut outline = outline_of([4, 4, 4]);
        let message = |restore_first: u32, voxels: u32| {
            let removed = Removed { restore_first, voxel_index_length: voxels, ..Removed::zeroed() };
            [removed.as_bytes(), &vec![0; voxels as usize * 4]].concat()
        };
        outline.add(Some(Topic::Removed), 0, &message(0, 64));
        outline.add(Some(Topic::Removed), 1, &message(1, 0));
        outline.add(Some(Topic::Removed), 2, &message(0, 64));
        assert_eq!((outline.removals.len(), outline.notices.len()), (3, 0));
        for _ in 0..1000 {
            outline.add(Some(Topic::Removed), 3, &message(0, 0));
        }
        outline.add(Some(Topic::Removed), 4, &message(1, 1));
        assert_eq!((outline.removals.len(), outline.notices.len()), (3, 1));
        assert!(outline.notices[0].contains("more voxels are removed than the volume has"));
    }

    fn states(all: &[(u64, u64)]) -> Vec<(u64, [u64; 2])> {
        all.iter().map(|(tick, hash)| (*tick, [*hash, 0])).collect()
    }

    /// States must be compared by tick: after a gap in one log, positions in the two files no longer match.
    #[test]
    fn two_logs_part_where_a_tick_of_both_differs_and_not_where_one_has_a_gap() {
        let first = states(&[(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]);
        let told = |other: &[(u64, u64)]| {
            let part =
                |a: &[(u64, [u64; 2])], b: &[(u64, [u64; 2])]| part(a.iter().copied(), b.iter().copied());
            let found = part(&first, &states(other));
            let swapped = part(&states(other), &first).map(|(tick, _)| tick);
            assert_eq!(found.map(|(tick, _)| tick), swapped, "whichever comes first");
            found
        };
        assert_eq!(told(&[(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]), None);
        assert_eq!(told(&[(0, 1), (3, 4), (4, 5)]), None, "a gap");
        assert_eq!(told(&[(0, 1), (1, 2), (2, 9), (3, 9), (4, 9)]), Some((2, "diverge at")));
        assert_eq!(told(&[(0, 1), (3, 9), (4, 9)]), Some((3, "diverge at")));
        assert_eq!(told(&[(0, 1), (1, 2)]), Some((2, "differ in length: the second ends before")));
    }
}
