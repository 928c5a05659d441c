//! The position on the time line and how it moves. Pure: no clock, no files.

use std::time::Duration;

use super::marks::Mark;
use crate::services::{Playback, PlaybackAction};

/// Speed limit, in both directions.
const MAX_SPEED: f64 = 1000.0;

/// The time line.
#[derive(Debug, Clone, PartialEq)]
pub struct Player {
    /// First simulated time, ns.
    pub begin_ns: u64,
    /// Last simulated time, ns.
    pub end_ns: u64,
    /// Simulated time per tick, ns.
    pub dt_ns: u64,
    /// Whether it is playing.
    pub playing: bool,
    /// Ratio of simulated to wall time; negative plays backward.
    pub speed: f64,
    /// Marks in time order.
    pub marks: Vec<Mark>,
    time_ns: f64,
}

/// A side of the current time.
#[derive(Clone, Copy)]
enum Side {
    Before,
    After,
}

impl Player {
    /// Creates a player that is paused at the beginning.
    pub fn new(begin_ns: u64, end_ns: u64, dt_ns: u64, mut marks: Vec<Mark>) -> Player {
        // The index of an untrusted log may have its end before its beginning.
        let end_ns = end_ns.max(begin_ns);
        marks.sort_by_key(|mark| mark.time_ns);
        Player {
            begin_ns,
            end_ns,
            dt_ns: dt_ns.max(1),
            playing: false,
            speed: 1.0,
            marks,
            time_ns: begin_ns as f64,
        }
    }

    /// Current position, ns.
    pub fn time_ns(&self) -> u64 {
        self.time_ns as u64
    }

    /// Advances by elapsed wall time. Stops at either end.
    pub fn advance(&mut self, elapsed: Duration) {
        if !self.playing {
            return;
        }
        self.go_to(self.time_ns + self.speed * elapsed.as_nanos() as f64);
        let at_end =
            if self.speed > 0.0 { self.time_ns() >= self.end_ns } else { self.time_ns() <= self.begin_ns };
        self.playing = !at_end;
    }

    fn go_to(&mut self, time_ns: f64) {
        self.time_ns = time_ns.clamp(self.begin_ns as f64, self.end_ns as f64);
    }

    /// Executes a client's request.
    ///
    /// # Errors
    /// An error text for the user.
    pub fn apply(&mut self, request: &Playback) -> Result<(), String> {
        match request.action {
            PlaybackAction::Play => {
                self.set_speed(request.speed)?;
                // At the end, play restarts from the beginning.
                if self.speed > 0.0 && self.time_ns() >= self.end_ns {
                    self.go_to(self.begin_ns as f64);
                }
                self.playing = true;
            }
            PlaybackAction::Pause => self.playing = false,
            PlaybackAction::Speed => self.set_speed(request.speed)?,
            PlaybackAction::Seek => {
                let to = request.time_ns.ok_or("`time_ns` is missing")?;
                self.go_to(to as f64);
            }
            PlaybackAction::Step => {
                self.playing = false;
                let tick = (self.time_ns / self.dt_ns as f64).round();
                self.go_to((tick + request.ticks.unwrap_or(1) as f64) * self.dt_ns as f64);
            }
            PlaybackAction::Next => self.jump(request.kind.as_deref(), Side::After)?,
            PlaybackAction::Previous => self.jump(request.kind.as_deref(), Side::Before)?,
        }
        Ok(())
    }

    fn set_speed(&mut self, speed: Option<f64>) -> Result<(), String> {
        match speed {
            None => Ok(()),
            Some(speed) if speed != 0.0 && speed.abs() <= MAX_SPEED => {
                self.speed = speed;
                Ok(())
            }
            Some(speed) => Err(format!("`speed` is {speed}; allowed: -{MAX_SPEED} to {MAX_SPEED}, not 0")),
        }
    }

    /// Jumps to the nearest mark of a kind on one side of the current time.
    fn jump(&mut self, kind: Option<&str>, side: Side) -> Result<(), String> {
        let now = self.time_ns();
        // Notes do not count as events, unless the log has nothing else.
        let only_notes = kind == Some("event") && !self.marks.iter().any(|mark| mark.kind == "event");
        let kind = if only_notes { Some("note") } else { kind };
        let fits = |mark: &&Mark| kind.is_none_or(|kind| kind == mark.kind);
        let found = match side {
            Side::After => self.marks.iter().filter(fits).find(|mark| mark.time_ns > now),
            Side::Before => self.marks.iter().rev().filter(fits).find(|mark| mark.time_ns < now),
        };
        let what = kind.unwrap_or("mark");
        let side = match side {
            Side::After => "after",
            Side::Before => "before",
        };
        let time_ns = found.ok_or_else(|| format!("no {what} {side} this time"))?.time_ns;
        self.playing = false;
        self.go_to(time_ns as f64);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mark(time_ns: u64, kind: &'static str) -> Mark {
        Mark { time_ns, kind, text: String::new() }
    }

    fn request(action: PlaybackAction) -> Playback {
        Playback { action, time_ns: None, speed: None, kind: None, ticks: None }
    }

    fn player() -> Player {
        let marks = vec![mark(700, "miss"), mark(200, "event"), mark(400, "miss")];
        Player::new(100, 1000, 10, marks)
    }

    #[test]
    fn it_plays_at_any_speed_and_stops_at_both_ends() {
        let mut player = player();
        player.apply(&Playback { speed: Some(2.0), ..request(PlaybackAction::Play) }).unwrap();
        player.advance(Duration::from_nanos(100));
        assert_eq!((player.time_ns(), player.playing), (300, true));
        player.advance(Duration::from_nanos(500));
        assert_eq!((player.time_ns(), player.playing), (1000, false));
        player.apply(&Playback { speed: Some(-0.5), ..request(PlaybackAction::Play) }).unwrap();
        player.advance(Duration::from_nanos(200));
        assert_eq!(player.time_ns(), 900);
        player.advance(Duration::from_secs(1));
        assert_eq!((player.time_ns(), player.playing), (100, false));
        for speed in [0.0, f64::NAN, f64::INFINITY, 1e9] {
            assert!(
                player.apply(&Playback { speed: Some(speed), ..request(PlaybackAction::Speed) }).is_err()
            );
        }
    }

    #[test]
    fn a_log_that_ends_before_it_begins_panics_nowhere() {
        let mut player = Player::new(1000, 0, 10, Vec::new());
        player.apply(&Playback { time_ns: Some(500), ..request(PlaybackAction::Seek) }).unwrap();
        player.apply(&Playback { speed: Some(-1.0), ..request(PlaybackAction::Play) }).unwrap();
        player.advance(Duration::from_nanos(100));
        assert_eq!((player.time_ns(), player.playing), (1000, false));
    }

    #[test]
    fn it_steps_by_ticks_and_jumps_between_marks() {
        let mut player = player();
        player.apply(&Playback { ticks: Some(3), ..request(PlaybackAction::Step) }).unwrap();
        assert_eq!(player.time_ns(), 130);
        player.apply(&Playback { ticks: Some(-100), ..request(PlaybackAction::Step) }).unwrap();
        assert_eq!(player.time_ns(), 100);
        player.apply(&request(PlaybackAction::Next)).unwrap();
        assert_eq!(player.time_ns(), 200);
        let miss = |action| Playback { kind: Some("miss".to_owned()), ..request(action) };
        player.apply(&miss(PlaybackAction::Next)).unwrap();
        player.apply(&miss(PlaybackAction::Next)).unwrap();
        assert_eq!(player.time_ns(), 700);
        assert!(
            player.apply(&miss(PlaybackAction::Next)).is_err_and(|error| error.contains("no miss after"))
        );
        player.apply(&request(PlaybackAction::Previous)).unwrap();
        assert_eq!(player.time_ns(), 400);
        player.apply(&Playback { time_ns: Some(u64::MAX), ..request(PlaybackAction::Seek) }).unwrap();
        assert_eq!(player.time_ns(), 1000);
    }
}
