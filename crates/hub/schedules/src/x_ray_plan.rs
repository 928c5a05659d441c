//! The choices of a seed about X-ray frames: how often they are due, how long they take, and which programs
//! request more.

use fastrand::Rng;
use hub::rate_limit::Connection;
use messages::{ControllerIndex, DrrRequest, GeometryChoice};
use scene::Mode;

use crate::plan::{MS, SchedulePlan, US};

/// Number of programs that request frames.
const ASKERS: usize = 4;

/// The X-ray frames of a schedule.
#[derive(Debug, Clone, Default)]
pub struct XRayPlan {
    /// Seeds the choices of the DRR process while it runs.
    pub seed: u64,
    /// Ticks from one frame to the next; `None` if frames are rendered on request only.
    pub period_ticks: Option<u64>,
    /// Longest time to render a frame.
    pub render_ns: u64,
    /// The only controller that may move the C-arm.
    pub c_arm_driver: Option<ControllerIndex>,
    /// Number of states that the process's queue holds.
    pub state_queue: usize,
    /// Number of `Removed` messages that its queue holds.
    pub removed_queue: usize,
    /// Requests for frames.
    pub asks: Vec<RequestBurst>,
    /// Whether each controller looks at frames before it answers.
    pub watching: Vec<bool>,
    /// Number of frames that a controller's queue holds.
    pub frame_queue: usize,
}

/// Requests that are sent together.
#[derive(Debug, Clone)]
pub struct RequestBurst {
    /// When they are sent, after the beginning.
    pub at_ns: u64,
    /// Index of the program; the first ones are the controllers.
    pub asker: usize,
    /// Number of connections; a program that has reconnected has another one.
    pub connections: u64,
    /// Number of requests from each.
    pub count: u64,
    /// Ticks ahead of the newest state; `None` for the newest state.
    pub ahead_ticks: Option<u64>,
    /// Their peculiarity.
    pub kind: RequestKind,
}

/// Peculiarities of requests for frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RequestKind {
    /// None.
    Plain,
    /// They specify a C-arm.
    MovesCArm,
    /// They specify a C-arm without pixels.
    BadCArm,
    /// They name another program as their sender.
    OthersName,
}

/// A request on its way to the DRR process.
#[derive(Debug, Clone, Copy)]
pub struct SentRequest {
    /// The connection that it arrives over.
    pub from: Connection,
    /// The controller that sent it; `None` for any other program.
    pub sender: Option<ControllerIndex>,
    /// The request.
    pub request: DrrRequest,
}

impl XRayPlan {
    /// Derives the frames from a plan's seed, mode, length and controllers. Draws from its own random stream,
    /// so that the rest of the plan does not depend on it.
    pub fn of(plan: &SchedulePlan) -> XRayPlan {
        let mut random = Rng::with_seed(plan.seed ^ 0xd1b5_4a32_d192_ed03);
        let period_ticks = (random.u8(..4) > 0).then(|| random.u64(1..15));
        // A real queue holds more ticks than a schedule has. In lockstep the hub's lead prevents an overflow.
        let is_short = plan.mode == Mode::Realtime && random.u8(..4) == 0;
        let queue = |random: &mut Rng| if is_short { random.usize(1..12) } else { 512 };
        let asks = [0, 0, 1, 3, 6][random.usize(..5)];
        let seed = random.u64(..);
        let render_ns = [50 * US, 800 * US, 4 * MS, 30 * MS][random.usize(..4)];
        // Its own random stream, so that the rest of the plan does not depend on it. In lockstep a controller
        // that waits for slow frames would time out.
        let mut looks = Rng::with_seed(plan.seed ^ 0x1f83_d9ab_fb41_bd6b);
        let may_watch = plan.drr_ns.is_some() && (plan.mode == Mode::Realtime || render_ns <= MS);
        let watching = plan.controllers.iter().map(|_| looks.u8(..3) > 0 && may_watch).collect();
        // In lockstep the real queue is long enough.
        let frame_queue = if plan.mode == Mode::Realtime { [1, 4, 64][looks.usize(..3)] } else { 64 };
        XRayPlan {
            seed,
            watching,
            frame_queue,
            period_ticks,
            render_ns,
            c_arm_driver: random.bool().then(|| ControllerIndex(random.u32(..plan.controllers.len() as u32))),
            state_queue: queue(&mut random),
            removed_queue: queue(&mut random),
            asks: (0..asks).map(|_| ask(plan, &mut random)).collect(),
        }
    }
}

fn ask(plan: &SchedulePlan, random: &mut Rng) -> RequestBurst {
    use RequestKind::{BadCArm, MovesCArm, OthersName, Plain};
    let ahead_ticks = match random.u8(..8) {
        0..=3 => None,
        // Many of these come after the end of the run.
        4 => Some(random.u64(..2 * plan.tick_count)),
        _ => Some(random.u64(..8)),
    };
    // Either one program floods, or many send requests.
    let (connections, count) = match random.u8(..4) {
        0 => (random.u64(2..=12), random.u64(1..=10)),
        _ => (1, [1, 1, 2, 7, 10, 70][random.usize(..6)]),
    };
    RequestBurst {
        at_ns: random.u64(..plan.nominal_ns() + 3 * MS),
        asker: random.usize(..ASKERS),
        connections,
        count,
        ahead_ticks,
        kind: [Plain, Plain, Plain, MovesCArm, BadCArm, OthersName][random.usize(..6)],
    }
}

impl RequestBurst {
    /// Creates its requests at the newest state. `number` counts the requests and connections of the run.
    pub fn requests(&self, controllers: usize, newest_tick: u64, number: &mut u64) -> Vec<SentRequest> {
        let sender = (self.asker < controllers).then_some(ControllerIndex(self.asker as u32));
        let requester = DrrRequest::requester_of(sender);
        let mut asked = Vec::with_capacity((self.connections * self.count) as usize);
        for connection in 0..self.connections {
            // A single connection belongs to the program for good; with several, each is a new one.
            let anew = if self.connections > 1 { *number + connection } else { 0 };
            let from = Connection(u128::from(anew) << 8 | self.asker as u128);
            for _ in 0..self.count {
                *number += 1;
                let mut request = DrrRequest {
                    request_id: *number,
                    tick: self.ahead_ticks.map_or(0, |ahead| newest_tick + ahead),
                    requester,
                    ..DrrRequest::zeroed()
                };
                match self.kind {
                    RequestKind::Plain => {}
                    RequestKind::MovesCArm => {
                        request.use_geometry = GeometryChoice::Request.code();
                        request.geometry.columns = 1 + (*number % 7) as u32;
                    }
                    RequestKind::BadCArm => request.use_geometry = GeometryChoice::Request.code(),
                    RequestKind::OthersName => request.requester = requester.wrapping_add(1),
                }
                asked.push(SentRequest { from, sender, request });
            }
        }
        asked
    }
}
