//! The choices of a seed: the scene, how fast every program is, and what goes wrong when.

use fastrand::Rng;
use messages::ControlAction;
use scene::Mode;

use crate::viewer_plan::ViewerPlan;
use crate::x_ray_plan::XRayPlan;

/// Microseconds in nanoseconds.
pub const US: u64 = 1_000;
/// Milliseconds in nanoseconds.
pub const MS: u64 = 1_000_000;

/// One in this many schedules has its log written and cut.
const SCHEDULES_PER_CUT: u64 = 64;

/// How much longer the hub waits for controllers that wait for frames, which are rendered after all requested
/// ones.
const FRAMES_LIMIT_MS: u64 = 400;

/// One schedule.
#[derive(Debug, Clone)]
pub struct SchedulePlan {
    /// Its seed, which also seeds the small random choices while it runs.
    pub seed: u64,
    /// Lockstep or real time.
    pub mode: Mode,
    /// Ticks of the run.
    pub tick_count: u64,
    /// `run.hold_ticks`.
    pub hold_ticks: u64,
    /// `run.controller_limit_ms`.
    pub controller_limit_ms: u64,
    /// How far the hub may run ahead of its consumers.
    pub lead_ticks: u64,
    /// Whether it waits for the recorder in real time.
    pub waits_for_recorder: bool,
    /// Ticks between two keyframes.
    pub keyframe_period_ticks: Option<u64>,
    /// The controllers of the scene.
    pub controllers: Vec<ControllerPlan>,
    /// Time that the DRR process needs to process its queue; `None` without a DRR process.
    pub drr_ns: Option<u64>,
    /// As `drr_ns`, for the recorder.
    pub recorder_ns: Option<u64>,
    /// The frames of the DRR process.
    pub x_ray: XRayPlan,
    /// The viewer; `None` without one.
    pub viewer: Option<ViewerPlan>,
    /// The faults.
    pub faults: Vec<Fault>,
    /// Seed of the byte at which the run's log is cut; `None` if no log is written.
    pub log_cut: Option<u64>,
}

/// A controller.
#[derive(Debug, Clone)]
pub struct ControllerPlan {
    /// Whether the run continues without it.
    pub optional: bool,
    /// When it connects.
    pub joins_ns: u64,
    /// Longest time from taking a state to sending the answer.
    pub answer_ns: u64,
    /// Whether it answers only the newest state instead of each.
    pub newest_only: bool,
}

/// A fault, or a request.
#[derive(Debug, Clone, PartialEq)]
pub struct Fault {
    /// When it occurs, after the beginning.
    pub at_ns: u64,
    /// Its kind.
    pub kind: FaultKind,
}

/// The kinds of faults and requests.
#[derive(Debug, Clone, PartialEq)]
pub enum FaultKind {
    /// A controller is killed, and restarted after a time or never.
    ControllerDies {
        /// Its index.
        index: usize,
        /// When it is back; `None` for never.
        back_after_ns: Option<u64>,
    },
    /// A controller stalls.
    ControllerStalls {
        /// Its index.
        index: usize,
        /// How long.
        for_ns: u64,
    },
    /// A controller sends a command that must be refused.
    BadCommand {
        /// Its index.
        index: usize,
        /// The command's defect.
        bad: CommandDefect,
    },
    /// A controller sends many extra commands at once.
    CommandFlood {
        /// Its index.
        index: usize,
        /// How many.
        count: u64,
    },
    /// A consumer stalls.
    ConsumerStalls {
        /// Whether it is the recorder; otherwise the DRR process.
        recorder: bool,
        /// How long.
        for_ns: u64,
    },
    /// A consumer is killed; the launcher notices after a time and asks the run to end.
    ConsumerDies {
        /// Whether it is the recorder; otherwise the DRR process.
        recorder: bool,
        /// When the launcher notices.
        noticed_after_ns: u64,
    },
    /// A client sends run-control requests.
    Control {
        /// One of the `CONTROL_` constants, or an invalid one.
        action: u32,
        /// Ticks of a step.
        ticks: u64,
        /// How many times.
        count: u64,
    },
    /// A client sends run control bytes that are not a request.
    MalformedControl {
        /// How many times.
        count: u64,
    },
    /// A program that is not a consumer reports progress.
    ForeignReport,
    /// The machine stops the hub's process (SIGSTOP, a frozen container, a suspended laptop).
    HubStops {
        /// How long.
        for_ns: u64,
    },
    /// A tick takes longer than others.
    SlowTick {
        /// How long.
        for_ns: u64,
    },
    /// The plant refuses part of the next tick's commands.
    PlantRefuses,
    /// The plant cannot compute the next tick.
    PlantFails,
    /// SIGTERM.
    EndRequest,
}

/// Commands that must be refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CommandDefect {
    /// NaN.
    NotANumber,
    /// A part of the tool that the controller does not drive.
    OthersPart,
    /// A state that does not exist yet.
    Future,
    /// A sequence number that does not increase.
    OldSequence,
    /// An answer to an older state than the one it answered last.
    OldState,
    /// Bytes of the wrong length.
    Malformed,
}

const BAD: [CommandDefect; 6] = [
    CommandDefect::NotANumber,
    CommandDefect::OthersPart,
    CommandDefect::Future,
    CommandDefect::OldSequence,
    CommandDefect::OldState,
    CommandDefect::Malformed,
];

impl Default for SchedulePlan {
    /// Returns the schedule of seed 0.
    fn default() -> SchedulePlan {
        SchedulePlan::of(0)
    }
}

impl SchedulePlan {
    /// Derives the schedule of a seed.
    pub fn of(seed: u64) -> SchedulePlan {
        let mut random = Rng::with_seed(seed);
        let mode = if random.bool() { Mode::Lockstep } else { Mode::Realtime };
        let controllers: Vec<ControllerPlan> =
            (0..random.usize(1..=3)).map(|_| controller(&mut random)).collect();
        let consumer = |random: &mut Rng| (random.u8(..4) > 0).then(|| random.u64(50 * US..3 * MS));
        let mut plan = SchedulePlan {
            seed,
            mode,
            tick_count: random.u64(5..60),
            hold_ticks: random.u64(1..6),
            controller_limit_ms: random.u64(4..30),
            lead_ticks: random.u64(1..6),
            waits_for_recorder: random.bool(),
            keyframe_period_ticks: random.bool().then(|| random.u64(1..20)),
            controllers,
            drr_ns: consumer(&mut random),
            recorder_ns: consumer(&mut random),
            x_ray: XRayPlan::default(),
            viewer: None,
            faults: Vec::new(),
            log_cut: None,
        };
        plan.x_ray = XRayPlan::of(&plan);
        plan.viewer = ViewerPlan::of(&plan);
        if plan.mode == Mode::Lockstep && plan.x_ray.watching.contains(&true) {
            plan.controller_limit_ms += FRAMES_LIMIT_MS;
        }
        let count = [0, 1, 2, 4, 8][random.usize(..5)];
        plan.faults = (0..count).map(|_| fault(&plan, &mut random)).collect();
        if random.u8(..16) == 0 {
            let at_ns = random.u64(..plan.nominal_ns());
            plan.faults.push(Fault { at_ns, kind: FaultKind::PlantFails });
        }
        // Writing and reading a log takes longer than playing the schedule.
        plan.log_cut =
            (seed.is_multiple_of(SCHEDULES_PER_CUT) && plan.recorder_ns.is_some()).then(|| random.u64(..));
        if random.u8(..16) == 0 {
            let faults = stepping(&plan, &mut random);
            plan.faults.extend(faults);
        }
        plan
    }

    /// Returns roughly how long the run takes if nothing goes wrong.
    pub fn nominal_ns(&self) -> u64 {
        match self.mode {
            Mode::Realtime => self.tick_count * MS,
            Mode::Lockstep => self.tick_count * 200 * US,
        }
    }

    /// Returns whether the plan has a fault of a kind.
    pub fn has(&self, kind: impl Fn(&FaultKind) -> bool) -> bool {
        self.faults.iter().any(|fault| kind(&fault.kind))
    }
}

fn controller(random: &mut Rng) -> ControllerPlan {
    ControllerPlan {
        optional: random.u8(..3) == 0,
        joins_ns: random.u64(..5 * MS),
        // Most are quick, some as slow as several ticks.
        answer_ns: [50 * US, 300 * US, 900 * US, 4 * MS][random.usize(..4)],
        newest_only: random.bool(),
    }
}

/// A user pauses, requests steps, pauses again in the middle of them, and resumes a while later. Four
/// requests drawn independently hardly ever arrive in this order.
fn stepping(plan: &SchedulePlan, random: &mut Rng) -> [Fault; 4] {
    let mut at_ns = random.u64(..plan.nominal_ns());
    let asked = [
        (ControlAction::Pause, 0, 0),
        (ControlAction::Step, random.u64(2..10), random.u64(..MS)),
        (ControlAction::Pause, 0, random.u64(..5 * MS)),
        (ControlAction::Resume, 0, random.u64(5 * MS..50 * MS)),
    ];
    asked.map(|(action, ticks, later_ns)| {
        at_ns += later_ns;
        Fault { at_ns, kind: FaultKind::Control { action: action.code(), ticks, count: 1 } }
    })
}

fn fault(plan: &SchedulePlan, random: &mut Rng) -> Fault {
    let index = random.usize(..plan.controllers.len());
    let recorder = random.bool();
    let a_while = |random: &mut Rng| {
        [random.u64(..2 * MS), random.u64(..20 * MS), random.u64(..300 * MS)][random.usize(..3)]
    };
    let kind = match random.u8(..40) {
        0..=5 => {
            let back_after_ns = (random.u8(..4) > 0).then(|| a_while(random));
            FaultKind::ControllerDies { index, back_after_ns }
        }
        6..=9 => FaultKind::ControllerStalls { index, for_ns: a_while(random) },
        10..=14 => FaultKind::BadCommand { index, bad: BAD[random.usize(..BAD.len())] },
        15..=16 => FaultKind::CommandFlood { index, count: random.u64(1..200) },
        17..=20 => FaultKind::ConsumerStalls { recorder, for_ns: a_while(random) },
        21 => FaultKind::ConsumerDies { recorder, noticed_after_ns: random.u64(..300 * MS) },
        22..=30 => {
            // Pauses must end, or every paused run would only wait for its end.
            let action = [1, 1, 2, 2, 3, 3, 4, 4, 5, 9][random.usize(..10)];
            let count = [1, 1, 1, 2, 100, 300][random.usize(..6)];
            FaultKind::Control { action, ticks: random.u64(..4), count }
        }
        31 => FaultKind::MalformedControl { count: random.u64(1..200) },
        32 => FaultKind::ForeignReport,
        33..=34 => FaultKind::HubStops { for_ns: [a_while(random), 30_000 * MS][random.usize(..2)] },
        35..=36 => FaultKind::SlowTick { for_ns: random.u64(..5 * MS) },
        37..=38 => FaultKind::PlantRefuses,
        _ => FaultKind::EndRequest,
    };
    Fault { at_ns: random.u64(..plan.nominal_ns() + 3 * MS), kind }
}
