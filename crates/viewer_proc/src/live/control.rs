//! Pause, step, reset, stop and speed, through run control.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use ipc_types::messages::services;
use ipc_types::messages::{ControlAction, ControlStatus, RunControl, RunControlReply};
use ipc_types::ports::{PortError, Publisher, Subscriber};
use ipc_types::session::{Reader, Session, SessionError};
use ipc_types::wake::Waker;
use serde_json::json;
use tokio::sync::oneshot;

use crate::board::Board;
use crate::channels::PACE;
use crate::services::{Action, Control as Request, Outcome, Reply};

/// Maximum number of ticks in one step.
const MAX_STEP_TICKS: u64 = 1_000_000;
/// Time between two steps of a paced run.
const STEP_PERIOD: Duration = Duration::from_millis(20);
/// Maximum backlog of a paced run, in steps.
const MAX_BACKLOG_STEPS: u32 = 10;
/// Speed limit.
const MAX_SPEED: f64 = 1000.0;

type Answer = oneshot::Sender<Outcome>;

/// The session's run control.
pub(super) struct Control {
    requests: Publisher<RunControl>,
    replies: Subscriber<RunControlReply>,
    physics: Waker,
    /// Whether the physics has sent a message; requests sent before that are lost.
    listens: bool,
    /// Requests to send once the physics has sent a message.
    unsent: Vec<RunControl>,
    next_id: u64,
    waiting: BTreeMap<u64, Answer>,
    pace: Option<Pace>,
    paced: Instant,
    /// Speed last published to clients.
    told: Option<f64>,
}

/// Slows the simulation down: pauses it and requests as many ticks as the elapsed time allows. Pure: the
/// caller supplies the elapsed time.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Pace {
    speed: f64,
    /// Ticks due, fractional part.
    due: f64,
    /// The tick at which the requested steps end.
    goal: u64,
}

impl Pace {
    /// Returns the number of ticks to request now. The backlog is limited to [`MAX_BACKLOG_STEPS`] steps; any
    /// excess is dropped.
    fn ticks(&mut self, elapsed: Duration, tick: u64, dt_ns: u64) -> u64 {
        let of = |time: Duration| self.speed * time.as_nanos() as f64 / dt_ns.max(1) as f64;
        // Time lost in a stall is not caught up.
        let (due, most) = (
            self.due + of(elapsed.min(MAX_BACKLOG_STEPS * STEP_PERIOD)),
            of(MAX_BACKLOG_STEPS * STEP_PERIOD),
        );
        self.goal = self.goal.max(tick);
        let room = (most - (self.goal - tick) as f64).max(0.0).floor();
        let ticks = due.floor().min(room.max(if self.goal == tick { 1.0 } else { 0.0 }));
        self.due = due.fract();
        self.goal += ticks as u64;
        ticks as u64
    }
}

impl Control {
    pub(super) fn open(session: &Session) -> Result<Control, SessionError> {
        Ok(Control {
            requests: session.publisher(&services::RUN_CONTROL)?,
            replies: session.subscriber(&services::RUN_CONTROL_REPLY)?,
            physics: session.waker(Reader::Physics)?,
            listens: false,
            unsent: Vec::new(),
            // Other senders start at other numbers.
            next_id: u64::from(std::process::id()) << 32,
            waiting: BTreeMap::new(),
            pace: None,
            paced: Instant::now(),
            told: None,
        })
    }

    /// Sends a request and answers once the physics has replied.
    pub(super) fn ask(&mut self, request: &Request, answer: Answer) {
        let outcome = match request.action {
            Action::Speed => self.set_speed(request.speed),
            Action::Step => match request.ticks.unwrap_or(1) {
                ticks @ 1..=MAX_STEP_TICKS => {
                    self.pace = None;
                    self.send(ControlAction::Step, ticks)
                }
                ticks => Err(format!("`ticks` is {ticks}; allowed: 1 to {MAX_STEP_TICKS}")),
            },
            Action::Reset => self.send(ControlAction::Reset, 0),
            Action::Pause | Action::Resume | Action::Stop => {
                self.pace = None;
                let action = match request.action {
                    Action::Pause => ControlAction::Pause,
                    Action::Resume => ControlAction::Resume,
                    _ => ControlAction::Stop,
                };
                self.send(action, 0)
            }
        };
        match outcome {
            Ok(id) => {
                self.waiting.insert(id, answer);
            }
            // The client may have disconnected.
            Err(error) => drop(answer.send(Err(error))),
        }
    }

    fn set_speed(&mut self, speed: Option<f64>) -> Result<u64, String> {
        match speed {
            None | Some(0.0) => {
                self.pace = None;
                self.send(ControlAction::Resume, 0)
            }
            Some(speed) if speed > 0.0 && speed <= MAX_SPEED => {
                self.pace = Some(Pace { speed, due: 0.0, goal: 0 });
                self.paced = Instant::now();
                self.send(ControlAction::Pause, 0)
            }
            Some(speed) => Err(format!("`speed` is {speed}; allowed: 0 (unlimited) to {MAX_SPEED}")),
        }
    }

    fn send(&mut self, action: ControlAction, ticks: u64) -> Result<u64, String> {
        self.next_id += 1;
        let request = RunControl { request_id: self.next_id, ticks, action: action.code(), reserved: 0 };
        if self.listens {
            self.requests.send(&request).map_err(|error| error.to_string())?;
            self.physics.wake();
        } else if self.unsent.len() < services::RUN_CONTROL.queue_length {
            self.unsent.push(request);
        } else {
            return Err("the physics has not started yet, and its request queue is full".to_owned());
        }
        Ok(self.next_id)
    }

    /// Sends the pending requests: the physics has sent a message, so it receives requests.
    pub(super) fn physics_listens(&mut self) -> Result<(), PortError> {
        self.listens = true;
        for request in self.unsent.drain(..) {
            self.requests.send(&request)?;
            self.physics.wake();
        }
        Ok(())
    }

    /// Takes replies and steps a paced run.
    pub(super) fn poll(&mut self, board: &Board, dt_ns: u64) -> Result<(), PortError> {
        // Published before the reply, so that a client that has the reply finds the speed on the board.
        let speed = self.pace.map(|pace| pace.speed);
        if speed != self.told {
            self.told = speed;
            board.publish_json(PACE, &json!({"speed": speed}));
        }
        while let Some(reply) = self.replies.receive()? {
            let reply = *reply.message();
            let Some(answer) = self.waiting.remove(&reply.request_id) else { continue };
            let refused = || {
                let how = if reply.action() == Ok(ControlAction::Step) { "; pause first" } else { "" };
                format!("refused at tick {}{how}", reply.tick)
            };
            let is_done = reply.status() == Ok(ControlStatus::Done);
            let _ = answer.send(if is_done { Ok(Reply::Done) } else { Err(refused()) });
        }
        self.waiting.retain(|_, answer| !answer.is_closed());
        let elapsed = self.paced.elapsed();
        if elapsed >= STEP_PERIOD
            && self.listens
            && let Some(pace) = &mut self.pace
        {
            self.paced = Instant::now();
            let ticks = pace.ticks(elapsed, board.time_ns() / dt_ns.max(1), dt_ns);
            if ticks >= 1
                && let Err(error) = self.send(ControlAction::Step, ticks)
            {
                board.notice("error", &error);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use ipc_types::scene::{Policy, Wait};
    use ipc_types::session::{SessionHost, SessionPlan};

    use super::*;
    use crate::channels::Channels;

    fn pace(speed: f64) -> Pace {
        Pace { speed, due: 0.0, goal: 0 }
    }

    #[test]
    fn ticks_come_at_the_speed_asked_for() {
        for (speed, ticks) in [(0.01, 10), (0.25, 250), (1.0, 1000), (7.5, 7500)] {
            let mut pace = pace(speed);
            let (mut made, mut most) = (500, 0);
            for _ in 0..50 {
                let step = pace.ticks(STEP_PERIOD, made, 1_000_000);
                (made, most) = (made + step, most.max(step));
            }
            assert!((made - 500).abs_diff(ticks) <= 1, "{speed}: {made}");
            assert!(most as f64 <= (20.0 * speed).ceil(), "{speed}: {most} at once");
        }
    }

    /// Steps must not pile up in the physics: it would keep running at the old speed after a change.
    #[test]
    fn a_run_that_does_not_get_so_far_has_no_more_than_a_few_steps_before_it() {
        let mut pace = pace(100.0);
        let most = 100 * 20 * u64::from(MAX_BACKLOG_STEPS);
        let asked: u64 = (0..1000).map(|_| pace.ticks(STEP_PERIOD, 7, 1_000_000)).sum();
        assert_eq!(asked, most);
        assert_eq!(
            pace.ticks(STEP_PERIOD, 7 + most, 1_000_000),
            2000,
            "requests resume once earlier ticks are done"
        );
        // A tick takes long at a low speed: one step at a time, and no new one while one is pending.
        let mut slow = Pace { speed: 0.1, due: 0.0, goal: 0 };
        let steps: u64 = (0..90).map(|_| slow.ticks(STEP_PERIOD, 3, 100_000_000)).sum();
        assert_eq!(steps, 1);
    }

    /// A speed requested while the physics starts must not be lost, or the page waits in vain for 10 s.
    #[test]
    fn what_is_asked_before_the_physics_listens_is_sent_when_it_is_heard_of() {
        let plan = SessionPlan {
            controllers: Vec::new(),
            volume_bytes: 4096,
            frame_bytes: 0,
            sensors: false,
            tip_jacobian: false,
            recorder: false,
            wait: Wait::Hybrid,
            policy: Policy::Other,
        };
        let host = SessionHost::create(&plan).unwrap();
        host.announce().unwrap();
        host.session.claim(ipc_types::messages::Part::Physics).unwrap();
        let mut control = Control::open(&host.session).unwrap();
        let ask = |control: &mut Control, action| {
            let (answer, answered) = oneshot::channel();
            control.ask(&Request { action, ticks: None, speed: Some(0.5) }, answer);
            answered
        };
        let mut answered = ask(&mut control, Action::Speed);
        let physics = host.session.subscriber::<RunControl>(&services::RUN_CONTROL).unwrap();
        let replies = host.session.publisher::<RunControlReply>(&services::RUN_CONTROL_REPLY).unwrap();
        let board = Board::new(Channels::new(&[], false));
        control.poll(&board, 1_000_000).unwrap();
        assert!(physics.receive().unwrap().is_none(), "no command before the client is seen");
        control.physics_listens().unwrap();
        let request = *physics.receive().unwrap().unwrap().message();
        assert_eq!(
            (request.action, physics.receive().unwrap().is_none()),
            (ControlAction::Pause.code(), true)
        );
        let RunControl { request_id, action, .. } = request;
        replies
            .send(&RunControlReply { request_id, tick: 0, action, status: ControlStatus::Done.code() })
            .unwrap();
        control.poll(&board, 1_000_000).unwrap();
        assert_eq!(answered.try_recv(), Ok(Ok(Reply::Done)));
        // The queue is bounded until then.
        control.listens = false;
        let waiting: Vec<_> =
            (0..=services::RUN_CONTROL.queue_length).map(|_| ask(&mut control, Action::Pause)).collect();
        let refused = waiting.into_iter().next_back().unwrap().try_recv().unwrap().unwrap_err();
        assert!(refused.contains("not started yet"), "{refused}");
    }
}
