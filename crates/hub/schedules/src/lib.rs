//! The hub under seeded schedules.
//!
//! [`SchedulePlan::of`] derives everything from a seed: the scene, how fast every program is, and what goes
//! wrong when. [`run`] plays the plan against a [`hub::Hub`] with a clock and queues in memory, and checks
//! every step with an [`oracle`] that knows nothing of the hub except what passes between it and its
//! surroundings. Among these are a DRR process and controllers that decide with [`delivery::x_ray`], and a
//! viewer that decides with [`delivery::viewer`], as the real ones do. [`shrink`] reduces a failing plan to
//! what is needed for the failure.
//!
//! The rules are in [`oracle`]: the order of publication; that a replay gives the same hashes; the latch's
//! rules; that no tick runs while the run is paused, stopped or ending; that no consumer falls too far
//! behind; deadlines and misses; every request answered; every ending with a reason; no reader asleep with a
//! message waiting; no wait without a limit; bounded warnings. For X-ray frames ([`oracle::x_ray`]): which
//! are due at which state, that each request is either refused for the right reason or gets exactly one
//! frame, that each frame lacks exactly the voxels that are removed at its tick, that the last state is
//! shown, and that no request is left without an answer. For controllers ([`oracle::seen_frames`]): which
//! frames each sees before it answers which state, and that it waits for none that has passed. For a viewer's
//! clients ([`oracle::viewer`]): that each one's queue is bounded, that messages arrive in order, that missed
//! ones are counted and reported, and that the newest message of each channel arrives. One schedule in 64, if
//! it has a recorder, also writes its log and cuts it at any byte; the ticks read from it must be a prefix of
//! those published.
//!
//! ```
//! let plan = hub_schedules::SchedulePlan::of(7);
//! assert!(hub_schedules::run(&plan).is_ok());
//! ```

mod actors;
mod drr;
pub mod mutants;
pub mod oracle;
mod plan;
mod plant;
mod recording;
mod viewer;
mod viewer_plan;
mod world;
mod x_ray_plan;

use std::ops::AddAssign;
use std::path::Path;
use std::sync::OnceLock;

use hub::{Hub, Next, Settings};
use messages::Part;
use scene::{Drives, Scene};

pub use plan::{CommandDefect, ControllerPlan, Fault, FaultKind, SchedulePlan};
use plant::{ChainPlant, Handle};
use recording::Recording;
pub use viewer_plan::{SubscriptionChange, ViewerPlan, WatcherPlan};
use world::World;
pub use x_ray_plan::{RequestBurst, RequestKind, XRayPlan};

/// Maximum number of advances of one run; with more, the hub does not come to an end.
const MOST_ADVANCES: u64 = 400_000;

/// Result of a schedule, or sum over several.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ScheduleStats {
    /// Number of ticks.
    pub ticks: u64,
    /// Times that the hub was advanced.
    pub advances: u64,
    /// Schedules that completed, rather than failing with a justified error.
    pub ended: u64,
    /// Logs that were cut and read back.
    pub logs_cut: u64,
    /// X-ray frames.
    pub frames: u64,
    /// Requests for frames that were refused.
    pub frames_refused: u64,
    /// Frames that controllers have seen.
    pub frames_seen: u64,
    /// Messages sent to clients of the viewer.
    pub watched: u64,
    /// Missed messages reported to them.
    pub dropped: u64,
}

impl AddAssign for ScheduleStats {
    fn add_assign(&mut self, more: ScheduleStats) {
        self.ticks += more.ticks;
        self.advances += more.advances;
        self.ended += more.ended;
        self.logs_cut += more.logs_cut;
        self.frames += more.frames;
        self.frames_refused += more.frames_refused;
        self.frames_seen += more.frames_seen;
        self.watched += more.watched;
        self.dropped += more.dropped;
    }
}

/// Plays a schedule.
///
/// # Errors
/// The first violated rule.
pub fn run(plan: &SchedulePlan) -> Result<ScheduleStats, String> {
    let (scene, drives) = scene(plan);
    let handle = Handle::default();
    handle.now_ns.set(1_000_000_000);
    let mut consumers = Vec::new();
    consumers.extend(plan.drr_ns.map(|_| Part::Drr));
    consumers.extend(plan.recorder_ns.map(|_| Part::Recorder));
    let settings = Settings {
        lead_ticks: plan.lead_ticks,
        recorder_lead_ticks: (plan.waits_for_recorder && plan.recorder_ns.is_some())
            .then_some(plan.lead_ticks),
        keyframe_period_ticks: plan.keyframe_period_ticks.filter(|_| plan.recorder_ns.is_some()),
        ..Settings::new(&scene, &consumers)
    };
    let mut world = World::new(plan, &drives, handle.clone());
    let mut hub = Hub::new(&scene, ChainPlant::new(handle.clone()), settings, handle.now_ns.get());
    let mut played = ScheduleStats::default();
    loop {
        played.advances += 1;
        let next = hub.advance(&mut world);
        match &next {
            Ok(Next::Wait(wait)) => world.wait(*wait),
            Ok(Next::GetReady) => {}
            Ok(Next::Ended) => {
                world.oracle.ended(handle.now_ns.get());
                world.finish_frames();
                world.finish_watching();
            }
            Err(cause) => {
                world.oracle.failed(cause, handle.now_ns.get());
                world.finish_watching();
            }
        }
        if played.advances > MOST_ADVANCES {
            world.oracle.fail("the run does not end".to_owned());
        }
        if let Some(failure) = world.take_failure() {
            return Err(failure);
        }
        if !matches!(next, Ok(Next::Wait(_) | Next::GetReady)) {
            played.logs_cut = u64::from(world.recording.is_some());
            world.recording.take().map_or(Ok(()), Recording::check_cut)?;
            (played.frames, played.frames_refused) = (world.frames.frames, world.frames.refused);
            played.frames_seen = world.seen_frames.shown;
            (played.watched, played.dropped) = world.watched();
            return Ok(ScheduleStats { ticks: hub.tick().0, ended: u64::from(next.is_ok()), ..played });
        }
    }
}

/// Creates the plan's scene, with the parts that each of its controllers drives.
fn scene(plan: &SchedulePlan) -> (Scene, Vec<Vec<Drives>>) {
    static BASE: OnceLock<Result<Scene, String>> = OnceLock::new();
    const TEXT: &str = "name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[tool]\n\
         burr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n\
         [[controller]]\nname = \"c0\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\nexternal = true\n\
         connect_limit_s = 1.0\n";
    let base =
        BASE.get_or_init(|| Scene::parse(TEXT, Path::new("schedule")).map_err(|cause| cause.to_string()));
    let mut scene = match base {
        Ok(scene) => scene.clone(),
        Err(cause) => unreachable!("the simulator's scene: {cause}"),
    };
    let drives: Vec<Vec<Drives>> = match plan.controllers.len() {
        1 => vec![vec![Drives::Tendon, Drives::Arm, Drives::Burr, Drives::Tube]],
        2 => vec![vec![Drives::Tendon, Drives::Burr], vec![Drives::Arm, Drives::Tube]],
        _ => vec![vec![Drives::Tendon, Drives::Tube], vec![Drives::Arm], vec![Drives::Burr]],
    };
    scene.run.mode = plan.mode;
    scene.run.hold_ticks = plan.hold_ticks;
    scene.run.controller_limit_ms = plan.controller_limit_ms as f64;
    scene.run.duration_s = plan.tick_count as f64 * scene.dt_s();
    let like = scene.controller[0].clone();
    let controllers = plan.controllers.iter().zip(&drives).enumerate();
    scene.controller = controllers
        .map(|(index, (plan, drives))| scene::Controller {
            name: format!("c{index}"),
            drives: drives.clone(),
            optional: plan.optional,
            ..like.clone()
        })
        .collect();
    (scene, drives)
}

/// Reduces a failing plan by removing faults, controllers' delays and ticks while it still fails; returns it
/// with its failure.
pub fn shrink(plan: &SchedulePlan) -> (SchedulePlan, String) {
    let mut least = plan.clone();
    let mut failure = run(&least).err().unwrap_or_default();
    let mut try_it = |candidate: SchedulePlan, least: &mut SchedulePlan| {
        let outcome = run(&candidate);
        if let Err(cause) = outcome {
            (*least, failure) = (candidate, cause);
            return true;
        }
        false
    };
    let mut again = true;
    while again {
        again = false;
        for index in (0..least.faults.len()).rev() {
            let mut candidate = least.clone();
            candidate.faults.remove(index);
            again |= try_it(candidate, &mut least);
        }
        while least.tick_count > 1 {
            let mut candidate = least.clone();
            candidate.tick_count -= least.tick_count.div_ceil(4);
            if !try_it(candidate, &mut least) {
                break;
            }
            again = true;
        }
        for index in (0..least.x_ray.asks.len()).rev() {
            let mut candidate = least.clone();
            candidate.x_ray.asks.remove(index);
            again |= try_it(candidate, &mut least);
        }
        let without: [fn(&mut SchedulePlan); 9] = [
            |plan| plan.viewer = None,
            |plan| plan.x_ray.watching.clear(),
            |plan| plan.x_ray.period_ticks = None,
            |plan| plan.x_ray.render_ns = 50_000,
            |plan| plan.log_cut = None,
            |plan| plan.drr_ns = None,
            |plan| plan.recorder_ns = None,
            |plan| plan.keyframe_period_ticks = None,
            |plan| plan.controllers.iter_mut().for_each(|c| c.answer_ns = 50_000),
        ];
        for change in without {
            let mut candidate = least.clone();
            change(&mut candidate);
            if format!("{candidate:?}") != format!("{least:?}") {
                again |= try_it(candidate, &mut least);
            }
        }
    }
    (least, failure)
}

/// Results of many schedules.
#[derive(Debug, Clone, Default)]
pub struct Summary {
    /// Schedules played.
    pub schedules: u64,
    /// Sum of their results.
    pub played: ScheduleStats,
    /// The first failing seed, with its failure.
    pub failure: Option<(u64, String)>,
}

/// Plays the schedules of `count` seeds from `first` on, on `threads` threads, up to the first failure of
/// each thread.
pub fn play(first: u64, count: u64, threads: u64) -> Summary {
    let threads = threads.max(1);
    let worker = |offset: u64| {
        let mut summary = Summary::default();
        for seed in (first + offset..first + count).step_by(threads as usize) {
            summary.schedules += 1;
            match run(&SchedulePlan::of(seed)) {
                Ok(played) => summary.played += played,
                Err(cause) => {
                    summary.failure = Some((seed, cause));
                    break;
                }
            }
        }
        summary
    };
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads).map(|offset| scope.spawn(move || worker(offset))).collect();
        let mut sum = Summary::default();
        for worker in workers {
            let one = worker.join().unwrap_or_else(|_| Summary {
                failure: Some((first, "a worker panicked; its message is above".to_owned())),
                ..Summary::default()
            });
            sum.schedules += one.schedules;
            sum.played += one.played;
            let earlier =
                |(seed, _): &(u64, String)| sum.failure.as_ref().is_none_or(|(other, _)| seed < other);
            if one.failure.as_ref().is_some_and(earlier) {
                sum.failure = one.failure;
            }
        }
        sum
    })
}
