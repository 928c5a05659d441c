//! `trabecula-lab chart stability --random N`: random scenes at the ends of the documented ranges, or of the
//! validated ones with `--validated`, run in this process and evaluated.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use hub::in_process::{Answer, InProcess, InProcessError};
use ipc_types::messages::{ArmMode, BurrMode, Command, TendonMode};
use ipc_types::scene::ManipulatorRung;
use rayon::prelude::*;
use serde_json::json;
use simulation::{CtView, Simulation, SimulationError, findings};

use super::random::{DRIVEN_S, Drawn, REST_S, Ranges};
use super::watch::{Imbalance, Watch, explained_m_per_s};
use crate::sheet::Sheet;
use trabecula::failure::Failure;

/// Maximum speed of the burr without an explanation, m/s.
const FAST_M_PER_S: f64 = 50.0;
/// Largest angle past a stop, rad: 0.1 degrees, at which a solve that does not converge ends, and rounding.
const MOST_PAST_STOP_RAD: f64 = (0.1 + 1e-9) * core::f64::consts::PI / 180.0;
/// Evaluated part of the rest.
const JUDGED_S: f64 = 0.5 * REST_S;

/// Outcome of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Class {
    /// Ran to its end, at rest or moving smoothly.
    Sound,
    /// The simulation refuses the scene.
    Refused,
    /// Ended by [`SimulationError::Lost`].
    Lost,
    /// Ended by another error.
    Failed,
    /// A published number is not finite.
    NotFinite,
    /// The burr was faster than the tendons' work can explain.
    Fast,
    /// It oscillates at rest.
    Chatter,
    /// A flexure passed its stop.
    PastStop,
    /// A tick created energy.
    Creating,
}

impl Class {
    fn name(self) -> &'static str {
        match self {
            Class::Sound => "sound",
            Class::Refused => "refused",
            Class::Lost => "lost",
            Class::Failed => "failed",
            Class::NotFinite => "not finite",
            Class::Fast => "fast without a cause",
            Class::Chatter => "chatter at rest",
            Class::PastStop => "past a stop",
            Class::Creating => "energy created",
        }
    }
}

/// Observations of a scene.
struct Seen {
    class: Class,
    what: String,
    worst: Imbalance,
    past_stop_rad: f64,
}

impl Seen {
    /// Returns the observations of a run without a state to evaluate.
    fn ended(class: Class, what: String) -> Seen {
        Seen { class, what, worst: Imbalance::default(), past_stop_rad: 0.0 }
    }
}

/// A scene, its observations, and whether `scene check` warns that nothing is claimed for it.
struct Judged {
    seed: u64,
    drawn: Drawn,
    seen: Seen,
    warned: bool,
}

/// Number of scenes of a class, and how many of them `scene check` warns about.
#[derive(Default)]
struct Count {
    all: usize,
    warned: usize,
}

/// Runs `count` scenes from `seed` on; prints each unsound one, the counts, and the worst imbalance of the
/// energy ledger. Returns the number that are not finite, fail with an error other than a lost tool, or are
/// lost, chatter, are fast without a cause, pass a stop or create energy without a warning.
///
/// # Errors
/// A scene cannot be drawn.
pub fn run(count: u64, seed: u64, ranges: Ranges, sheet: &mut Sheet) -> Result<usize, Failure> {
    let done = AtomicUsize::new(0);
    let judged: Vec<Judged> = (seed..seed + count)
        .into_par_iter()
        .map(|seed| {
            let drawn = Drawn::of(seed, ranges)?;
            let (seen, warned) = (judge(&drawn), is_warned_of(&drawn));
            if (done.fetch_add(1, Ordering::Relaxed) + 1).is_multiple_of(50) {
                tell!("stability: {} of {count} scenes", done.load(Ordering::Relaxed));
            }
            Ok(Judged { seed, drawn, seen, warned })
        })
        .collect::<Result<_, Failure>>()?;
    let mut counts: BTreeMap<Class, Count> = BTreeMap::new();
    for Judged { seed, drawn, seen, warned } in &judged {
        let count = counts.entry(seen.class).or_default();
        count.all += 1;
        count.warned += usize::from(*warned);
        if seen.class != Class::Sound {
            let name = seen.class.name();
            let told = if *warned { "warned" } else { "not warned" };
            sheet.line(&format!("{seed:>5} {name}, {told}: {}; {}", seen.what, drawn.line()));
            sheet.push("scenes", json!({"seed": seed, "class": name, "what": seen.what, "warned": warned}));
        }
    }
    let counted: Vec<String> = counts
        .iter()
        .map(|(class, Count { all, warned })| format!("{all} {} ({warned} with a warning)", class.name()))
        .collect();
    sheet.line(&format!("{count} scenes: {}", counted.join(", ")));
    let unwarned = || judged.iter().filter(|judged| !judged.warned);
    let past_rad = unwarned().map(|judged| judged.seen.past_stop_rad).fold(0.0, f64::max);
    if let Some(judged) = unwarned().max_by(|a, b| a.seen.worst.share().total_cmp(&b.seen.worst.share())) {
        let (seed, Imbalance { tick, created_j, bound_j }) = (judged.seed, judged.seen.worst);
        let [created_mj, bound_mj] = [created_j, bound_j].map(|joules| joules * 1e3);
        sheet.line(&format!(
            "without a warning, at most {:.3} degrees past a stop; worst imbalance of energy in seed {seed}, \
             tick {tick}: {created_mj:.3} mJ created, bound {bound_mj:.3} mJ",
            past_rad.to_degrees()
        ));
        let worst = json!({"seed": seed, "tick": tick, "created_mj": created_mj, "bound_mj": bound_mj});
        sheet.set("worst_imbalance", worst);
        sheet.set("past_stop_rad", json!(past_rad));
    }
    for (class, Count { all, warned }) in &counts {
        sheet.set(class.name(), json!({"all": all, "warned": warned}));
    }
    Ok(counts.iter().map(|(class, count)| wrong(*class, count)).sum())
}

/// Returns the number of unacceptable scenes: a warning excuses all but errors and numbers that are not
/// finite.
fn wrong(class: Class, count: &Count) -> usize {
    match class {
        Class::Sound | Class::Refused => 0,
        Class::Lost | Class::Chatter | Class::Fast | Class::PastStop | Class::Creating => {
            count.all - count.warned
        }
        Class::Failed | Class::NotFinite => count.all,
    }
}

/// Warnings about the tool's start do not predict its motion, except for a hole that is too thin for it.
fn is_warned_of(drawn: &Drawn) -> bool {
    let ct = drawn.bone.as_ref().map(|block| CtView { geometry: block.geometry, hu: &block.hu });
    let found = findings(&drawn.scene, ct, &|_| true).unwrap_or_default();
    let tables = ["manipulator.", "contact.", "predrill.", "run."];
    found.iter().any(|finding| tables.iter().any(|table| finding.key.starts_with(table)))
}

fn judge(drawn: &Drawn) -> Seen {
    let ct = drawn.bone.as_ref().map(|block| CtView { geometry: block.geometry, hu: &block.hu });
    let simulation = match Simulation::new(&drawn.scene, ct) {
        Ok(simulation) => simulation,
        Err(cause) => return Seen::ended(Class::Refused, cause.to_string()),
    };
    let mut run = InProcess::new(&drawn.scene, simulation);
    let mut watch = Watch::default();
    let dt_s = drawn.scene.dt_s();
    for tick in 0..drawn.scene.tick_count() {
        let seconds = tick as f64 * dt_s;
        let made = run.tick(|_, _, command| {
            drive(drawn, seconds, command);
            Answer::Command
        });
        if let Err(cause) = made {
            let lost = matches!(&cause, InProcessError::Plant { cause: SimulationError::Lost(_), .. });
            return Seen::ended(if lost { Class::Lost } else { Class::Failed }, cause.to_string());
        }
        watch.look(run.plant().state(), seconds >= DRIVEN_S + REST_S - JUDGED_S);
    }
    let (class, what) = verdict(&watch, drawn);
    let is_modal = drawn.scene.manipulator.model == Some(ManipulatorRung::Modal);
    let past_stop_rad = if is_modal { 0.0 } else { watch.past_stop_rad };
    Seen { class, what, worst: watch.worst, past_stop_rad }
}

fn drive(drawn: &Drawn, seconds: f64, command: &mut Command) {
    command.tendon_mode = TendonMode::ServoJf.code();
    command.tendon_force_n = drawn.tensions_n(seconds);
    command.burr_mode = BurrMode::Speed.code();
    command.burr_speed_rad_per_s = drawn.burr_speed_rad_per_s;
    if drawn.feed_m_per_s == 0.0 {
        return;
    }
    if seconds < DRIVEN_S {
        command.arm_mode = ArmMode::Insert.code();
        command.arm_axis = [0.0, 0.0, 1.0];
        command.arm_speed_m_per_s = drawn.feed_m_per_s;
        command.arm_depth_m = 2.0 * drawn.feed_m_per_s * DRIVEN_S;
    } else {
        command.arm_mode = ArmMode::Hold.code();
    }
}

fn verdict(watch: &Watch, drawn: &Drawn) -> (Class, String) {
    if let Some(tick) = watch.not_finite {
        return (Class::NotFinite, format!("tick {tick}"));
    }
    let mass_scale = drawn.scene.manipulator.mass_scale.unwrap_or(1.0);
    let explained = explained_m_per_s(drawn.greatest_tension_n(), mass_scale).max(FAST_M_PER_S);
    if watch.fastest_m_per_s > explained {
        let what = format!("{:.0} m/s, the tendons explain {explained:.0}", watch.fastest_m_per_s);
        return (Class::Fast, what);
    }
    if let Some(chatter) = watch.chatter() {
        let (um, percent) = (chatter.to_and_fro_m * 1e6, chatter.turned_back * 100.0);
        return (Class::Chatter, format!("{um:.0} um per tick, {percent:.0} % turn back"));
    }
    // The modal model is known not to hold its stops, and a run says so.
    if watch.past_stop_rad > MOST_PAST_STOP_RAD
        && drawn.scene.manipulator.model != Some(ManipulatorRung::Modal)
    {
        let what = format!("{:.3} degrees", watch.past_stop_rad.to_degrees());
        return (Class::PastStop, what);
    }
    if watch.created_j > 0.0 {
        return (Class::Creating, format!("{:.3} mJ", watch.created_j * 1e3));
    }
    (Class::Sound, String::new())
}
