//! `trabecula chart stability --random N`: random scenes at the ends of the documented ranges, run in this process and judged.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use hub::in_process::{Answer, InProcess, InProcessError};
use ipc_types::messages::{ArmMode, BurrMode, Command, TendonMode};
use rayon::prelude::*;
use serde_json::json;
use simulation::{CtView, Simulation, SimulationError};

use super::random::{DRIVEN_S, Drawn, REST_S};
use super::watch::{Watch, explained_m_per_s};
use crate::sheet::Sheet;
use trabecula::failure::Failure;

/// Greatest speed of the burr that needs no explanation, m/s.
const FAST_M_PER_S: f64 = 50.0;
/// Part of the rest that is judged.
const JUDGED_S: f64 = 0.5 * REST_S;

/// What came of a scene.
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
    /// The burr was faster than the tendons' work explains.
    Fast,
    /// It moves to and fro at rest.
    Chatter,
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
        }
    }
}

/// What was seen of a scene.
struct Seen {
    class: Class,
    what: String,
}

/// Runs `count` scenes from `seed` on; prints each that is not sound, and the counts. Returns how many are not finite, fast without a
/// cause, chatter or fail with another error than a lost tool.
///
/// # Errors
/// A scene cannot be drawn.
pub fn run(count: u64, seed: u64, sheet: &mut Sheet) -> Result<usize, Failure> {
    let done = AtomicUsize::new(0);
    let seen: Vec<(u64, Drawn, Seen)> = (seed..seed + count)
        .into_par_iter()
        .map(|seed| {
            let drawn = Drawn::of(seed)?;
            let seen = judge(&drawn);
            if (done.fetch_add(1, Ordering::Relaxed) + 1).is_multiple_of(50) {
                tell!("stability: {} of {count} scenes", done.load(Ordering::Relaxed));
            }
            Ok((seed, drawn, seen))
        })
        .collect::<Result<_, Failure>>()?;
    let mut counts: BTreeMap<Class, usize> = BTreeMap::new();
    for (seed, drawn, seen) in &seen {
        *counts.entry(seen.class).or_default() += 1;
        if seen.class != Class::Sound {
            sheet.line(&format!("{seed:>5} {}: {}; {}", seen.class.name(), seen.what, drawn.line()));
            sheet.push("scenes", json!({"seed": seed, "class": seen.class.name(), "what": seen.what}));
        }
    }
    let counted: Vec<String> =
        counts.iter().map(|(class, count)| format!("{count} {}", class.name())).collect();
    sheet.line(&format!("{count} scenes: {}", counted.join(", ")));
    for (class, count) in &counts {
        sheet.set(class.name(), json!(count));
    }
    let wrong = [Class::Failed, Class::NotFinite, Class::Fast, Class::Chatter];
    Ok(wrong.iter().filter_map(|class| counts.get(class)).sum())
}

fn judge(drawn: &Drawn) -> Seen {
    let ct = drawn.bone.as_ref().map(|block| CtView { geometry: block.geometry, hu: &block.hu });
    let simulation = match Simulation::new(&drawn.scene, ct) {
        Ok(simulation) => simulation,
        Err(cause) => return Seen { class: Class::Refused, what: cause.to_string() },
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
            return Seen { class: if lost { Class::Lost } else { Class::Failed }, what: cause.to_string() };
        }
        watch.look(run.plant().state(), seconds >= DRIVEN_S + REST_S - JUDGED_S);
    }
    verdict(&watch, drawn)
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

fn verdict(watch: &Watch, drawn: &Drawn) -> Seen {
    if let Some(tick) = watch.not_finite {
        return Seen { class: Class::NotFinite, what: format!("tick {tick}") };
    }
    let mass_scale = drawn.scene.manipulator.mass_scale.unwrap_or(1.0);
    let explained = explained_m_per_s(drawn.greatest_tension_n(), mass_scale).max(FAST_M_PER_S);
    if watch.fastest_m_per_s > explained {
        let what = format!("{:.0} m/s, the tendons explain {explained:.0}", watch.fastest_m_per_s);
        return Seen { class: Class::Fast, what };
    }
    watch.chatter().map_or(Seen { class: Class::Sound, what: String::new() }, |chatter| {
        let (um, percent) = (chatter.to_and_fro_m * 1e6, chatter.turned_back * 100.0);
        Seen { class: Class::Chatter, what: format!("{um:.0} um a tick, {percent:.0} % turn back") }
    })
}
