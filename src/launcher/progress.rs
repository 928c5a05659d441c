//! The progress line: one line that is rewritten on a terminal, a line every two seconds elsewhere.

use std::io::{IsTerminal, Write, stderr};
use std::time::{Duration, Instant};

use ipc_types::messages::{PHASE_CONNECTING, PHASE_PAUSED};

use super::run::Glance;
use crate::failure::Failure;
use crate::report::{LiveSnapshot, LiveStats, progress_line};

const TERMINAL_PERIOD: Duration = Duration::from_millis(250);
const PLAIN_PERIOD: Duration = Duration::from_secs(2);

/// Shows how a run goes on.
#[derive(Debug)]
pub struct Display {
    quiet: bool,
    terminal: bool,
    stats: LiveStats,
    last: Instant,
    last_sim_s: f64,
    last_frames: u64,
    drawn: bool,
    announced: bool,
}

impl Display {
    /// A display on standard error; a quiet one shows nothing.
    ///
    /// # Errors
    /// The statistics cannot be set up.
    pub fn new(quiet: bool) -> Result<Display, Failure> {
        let stats = LiveStats::new().map_err(|error| Failure::failed(error.to_string()))?;
        let terminal = stderr().is_terminal();
        Ok(Display {
            quiet,
            terminal,
            stats,
            last: Instant::now(),
            last_sim_s: 0.0,
            last_frames: 0,
            drawn: false,
            announced: false,
        })
    }

    /// Takes in a glance and shows a line if it is time to.
    pub fn show(&mut self, glance: &Glance) {
        glance.timings.iter().for_each(|timing| self.stats.add(timing));
        if !self.quiet && !self.announced {
            self.announced = true;
            eprintln!("session {}", glance.session.display());
            glance.awaited.iter().for_each(|line| eprintln!("{line}"));
        }
        let period = if self.terminal { TERMINAL_PERIOD } else { PLAIN_PERIOD };
        if self.quiet || self.last.elapsed() < period {
            return;
        }
        let line = self.line(glance);
        self.last = Instant::now();
        self.last_sim_s = glance.state.map_or(0.0, |state| state.sim_time_s);
        self.last_frames = glance.frames;
        self.draw(&line);
    }

    fn line(&mut self, glance: &Glance) -> String {
        let Some(state) = glance.state else { return "loading the volume, connecting the parts".to_owned() };
        let phase = glance.status.map(|status| status.phase);
        if phase == Some(PHASE_CONNECTING) {
            return "connecting the parts".to_owned();
        }
        let wall_s = self.last.elapsed().as_secs_f64();
        let snapshot = LiveSnapshot {
            sim_time_s: state.sim_time_s,
            real_time_factor: (state.sim_time_s - self.last_sim_s) / wall_s,
            tip_position_m: state.t_world_tip.position_m,
            tension_n: state.tendon_tension_n[0],
            removed_total: state.removed_total,
            interval: self.stats.take(),
            drr_rate_hz: (glance.frames > 0).then(|| (glance.frames - self.last_frames) as f64 / wall_s),
            missed_ticks: glance.status.filter(|status| status.mode != 0).map(|status| status.missed_ticks),
        };
        let paused = if phase == Some(PHASE_PAUSED) { "paused  " } else { "" };
        format!("{paused}{}", progress_line(&snapshot))
    }

    fn draw(&mut self, line: &str) {
        let mut out = stderr().lock();
        // A terminal that has gone is no reason to end a run.
        let _ = if self.terminal { write!(out, "\r\x1b[K{line}") } else { writeln!(out, "{line}") };
        let _ = out.flush();
        self.drawn = true;
    }

    /// Leaves the line.
    pub fn end(&mut self) {
        if self.drawn && self.terminal {
            eprintln!();
        }
    }
}
