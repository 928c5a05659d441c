//! Pause, step, reset, stop and speed, through run control.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use ipc_types::messages::{
    CONTROL_DONE, CONTROL_PAUSE, CONTROL_RESET, CONTROL_RESUME, CONTROL_STEP, CONTROL_STOP, RunControl,
    RunControlReply,
};
use ipc_types::ports::{PortError, Publisher, Subscriber};
use ipc_types::services;
use ipc_types::session::{Reader, Session, SessionError};
use ipc_types::wake::Waker;
use tokio::sync::oneshot;

use crate::board::Board;
use crate::services::{Action, Control as Request};

/// Longest step.
const MAX_STEP_TICKS: u64 = 1_000_000;
/// Time between two steps of a run that goes at a given speed.
const PACE: Duration = Duration::from_millis(20);
/// Most speed that may be asked for.
const MAX_SPEED: f64 = 1000.0;

type Answer = oneshot::Sender<Result<(), String>>;

/// The session's run control.
pub(super) struct Control {
    requests: Publisher<RunControl>,
    replies: Subscriber<RunControlReply>,
    physics: Waker,
    next_id: u64,
    waiting: BTreeMap<u64, Answer>,
    pace: Option<Pace>,
}

/// A run slowed down: it is paused, and steps as many ticks as the time allows.
struct Pace {
    speed: f64,
    last: Instant,
    /// Ticks that are due but not yet whole.
    due: f64,
}

impl Control {
    pub(super) fn open(session: &Session) -> Result<Control, SessionError> {
        Ok(Control {
            requests: session.publisher(&services::RUN_CONTROL)?,
            replies: session.subscriber(&services::RUN_CONTROL_REPLY)?,
            physics: session.waker(Reader::Physics)?,
            // Other senders count from elsewhere.
            next_id: u64::from(std::process::id()) << 32,
            waiting: BTreeMap::new(),
            pace: None,
        })
    }

    /// Sends a request; the answer comes when the physics has replied.
    pub(super) fn ask(&mut self, request: &Request, answer: Answer) {
        let outcome = match request.action {
            Action::Speed => self.set_speed(request.speed),
            Action::Step => match request.ticks.unwrap_or(1) {
                ticks @ 1..=MAX_STEP_TICKS => {
                    self.pace = None;
                    self.send(CONTROL_STEP, ticks)
                }
                ticks => Err(format!("`ticks` is {ticks}, allowed is 1 to {MAX_STEP_TICKS}")),
            },
            Action::Reset => self.send(CONTROL_RESET, 0),
            Action::Pause | Action::Resume | Action::Stop => {
                self.pace = None;
                let code = match request.action {
                    Action::Pause => CONTROL_PAUSE,
                    Action::Resume => CONTROL_RESUME,
                    _ => CONTROL_STOP,
                };
                self.send(code, 0)
            }
        };
        match outcome {
            Ok(id) => {
                self.waiting.insert(id, answer);
            }
            // The client may have left.
            Err(error) => drop(answer.send(Err(error))),
        }
    }

    fn set_speed(&mut self, speed: Option<f64>) -> Result<u64, String> {
        match speed {
            None | Some(0.0) => {
                self.pace = None;
                self.send(CONTROL_RESUME, 0)
            }
            Some(speed) if speed > 0.0 && speed <= MAX_SPEED => {
                self.pace = Some(Pace { speed, last: Instant::now(), due: 0.0 });
                self.send(CONTROL_PAUSE, 0)
            }
            Some(speed) => Err(format!("`speed` is {speed}, allowed is 0 (unlimited) to {MAX_SPEED}")),
        }
    }

    fn send(&mut self, action: u32, ticks: u64) -> Result<u64, String> {
        self.next_id += 1;
        let request = RunControl { request_id: self.next_id, ticks, action, reserved: 0 };
        self.requests.send(&request).map_err(|error| error.to_string())?;
        self.physics.wake();
        Ok(self.next_id)
    }

    /// Takes replies, and steps a run that goes at a given speed.
    pub(super) fn look(&mut self, board: &Board, dt_ns: u64) -> Result<(), PortError> {
        while let Some(reply) = self.replies.receive()? {
            let reply = *reply.message();
            let Some(answer) = self.waiting.remove(&reply.request_id) else { continue };
            let refused = || {
                let how = if reply.action == CONTROL_STEP { "; pause first" } else { "" };
                format!("the run refused this at tick {}{how}", reply.tick)
            };
            let _ = answer.send(if reply.status == CONTROL_DONE { Ok(()) } else { Err(refused()) });
        }
        self.waiting.retain(|_, answer| !answer.is_closed());
        let Some(pace) = &mut self.pace else { return Ok(()) };
        let elapsed = pace.last.elapsed();
        if elapsed >= PACE {
            pace.last = Instant::now();
            // After a stall it goes on from there.
            let elapsed_ns = elapsed.min(10 * PACE).as_nanos() as f64;
            pace.due += pace.speed * elapsed_ns / dt_ns.max(1) as f64;
            let ticks = pace.due.floor();
            pace.due -= ticks;
            if ticks >= 1.0
                && let Err(error) = self.send(CONTROL_STEP, ticks as u64)
            {
                board.notice("error", &error);
            }
        }
        Ok(())
    }
}
