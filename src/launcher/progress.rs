//! The progress display: a small table rewritten in place on a terminal, a line every two seconds elsewhere,
//! or lines of JSON for scripts.

use std::io::{IsTerminal, Write, stderr};
use std::time::{Duration, Instant};

use ipc_types::messages::Phase;

use super::run::RunSnapshot;
use crate::failure::Failure;
use crate::printer::{self, ForwardedOutput};
use crate::report::{History, LiveSnapshot, LiveStats, json_line, progress_line};
use crate::say::path_text;

const TERMINAL_PERIOD: Duration = Duration::from_millis(250);
const PLAIN_PERIOD: Duration = Duration::from_secs(2);

/// Shows a run's progress.
#[derive(Debug)]
pub struct Display {
    style: ProgressStyle,
    terminal: bool,
    history: History,
    stats: LiveStats,
    last: Instant,
    last_sim_s: f64,
    last_frames: u64,
    /// Table lines currently on the terminal.
    drawn: usize,
    announced: bool,
}

/// How to show progress.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProgressStyle {
    /// Show nothing.
    Quiet,
    /// Lines and tables on standard error.
    Text,
    /// Lines of JSON on standard output.
    Json,
}

impl Display {
    /// Creates a display.
    pub fn new(style: ProgressStyle) -> Result<Display, Failure> {
        let stats = LiveStats::new().map_err(Failure::failed)?;
        let terminal = stderr().is_terminal();
        Ok(Display {
            style,
            terminal: terminal && style == ProgressStyle::Text,
            history: History::default(),
            stats,
            last: Instant::now(),
            last_sim_s: 0.0,
            last_frames: 0,
            drawn: 0,
            announced: false,
        })
    }

    /// Adds a snapshot, and updates the display if it is due.
    pub fn show(&mut self, snapshot: &RunSnapshot) {
        snapshot.timings.iter().for_each(|timing| self.stats.add(timing));
        if !self.announced {
            self.announced = true;
            self.announce(snapshot);
        }
        if let Some(waiting) = snapshot.waiting {
            tell!("{waiting}");
        }
        for caution in snapshot.cautions {
            // Below the table, which is then drawn again below this line.
            self.end();
            self.drawn = 0;
            tell!("caution: {caution}");
        }
        let period = if self.terminal { TERMINAL_PERIOD } else { PLAIN_PERIOD };
        if self.style == ProgressStyle::Quiet || self.last.elapsed() < period {
            return;
        }
        let lines = self.lines(snapshot);
        self.last = Instant::now();
        self.last_sim_s = snapshot.state.map_or(0.0, |state| state.sim_time_s);
        self.last_frames = snapshot.frames;
        self.draw(&lines);
    }

    /// Prints the session's name; scripts get it on standard output.
    fn announce(&self, snapshot: &RunSnapshot) {
        let session = snapshot.session.display();
        match self.style {
            ProgressStyle::Quiet => say!("session      {session}"),
            ProgressStyle::Text => tell!("session {session}"),
            ProgressStyle::Json => {
                say!("{}", serde_json::json!({"phase": "announced", "session": path_text(snapshot.session)}));
            }
        }
        if self.style != ProgressStyle::Quiet {
            snapshot.awaited.iter().for_each(|line| tell!("{line}"));
        }
    }

    fn lines(&mut self, snapshot: &RunSnapshot) -> Vec<String> {
        let phase = snapshot.status.and_then(|status| status.phase().ok());
        let Some(state) = snapshot.state.filter(|_| phase != Some(Phase::Connecting)) else {
            let waits = match snapshot.state {
                None => "loading the volume, connecting the parts",
                Some(_) => "connecting the parts",
            };
            return match self.style {
                ProgressStyle::Json => vec![json_line(&LiveSnapshot::default(), "connecting").to_string()],
                _ => vec![waits.to_owned()],
            };
        };
        let wall_s = self.last.elapsed().as_secs_f64();
        let snapshot = LiveSnapshot {
            sim_time_s: state.sim_time_s,
            real_time_factor: (state.sim_time_s - self.last_sim_s) / wall_s,
            tip_position_m: state.t_world_tip.position_m,
            tension_n: state.tendon_tension_n[0],
            removed_total: state.removed_total,
            interval: self.stats.take(),
            drr_rate_hz: (snapshot.frames > 0).then(|| (snapshot.frames - self.last_frames) as f64 / wall_s),
            missed_ticks: snapshot.status.filter(|status| status.mode != 0).map(|status| status.missed_ticks),
        };
        self.history.add(&snapshot);
        let paused = phase == Some(Phase::Paused);
        if self.style == ProgressStyle::Json {
            return vec![json_line(&snapshot, if paused { "paused" } else { "running" }).to_string()];
        }
        let mut lines = match self.terminal {
            true => self.history.table(&snapshot),
            false => vec![progress_line(&snapshot)],
        };
        if paused && let Some(first) = lines.first_mut() {
            first.insert_str(0, "paused  ");
        }
        lines
    }

    fn draw(&mut self, lines: &[String]) {
        // A closed terminal or pipe must not end the run.
        if self.style == ProgressStyle::Json {
            lines.iter().for_each(|line| say!("{line}"));
            return;
        }
        if self.terminal && printer::is_behind() {
            return;
        }
        let mut text = String::new();
        if self.terminal {
            // Move to the table's first line; each line is then cleared and rewritten.
            text = (1..self.drawn).fold("\r".to_owned(), |text, _| text + "\x1b[A");
            let rows: Vec<String> = lines.iter().map(|line| format!("\x1b[K{line}")).collect();
            text += &rows.join("\n");
            text += "\x1b[J";
        } else {
            lines.iter().for_each(|line| text += &format!("{line}\n"));
        }
        let _ = ForwardedOutput.write_all(text.as_bytes());
        self.drawn = lines.len();
    }

    /// Ends the display and leaves the table on the screen.
    pub fn end(&mut self) {
        if self.drawn > 0 && self.terminal {
            tell!("");
        }
    }
}
