//! `trabecula chart stability --random N`: random scenes at the ends of the documented ranges, run in this process and judged.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use hub::in_process::{Answer, InProcess, InProcessError};
use ipc_types::messages::{ArmMode, BurrMode, Command, State, TendonMode};
use nalgebra::Vector3;
use rayon::prelude::*;
use serde_json::json;
use simulation::{CtView, Simulation, SimulationError};

use super::random::{DRIVEN_S, Drawn, REST_S};
use crate::sheet::Sheet;
use trabecula::failure::Failure;

/// Greatest speed of the burr that needs no explanation, m/s.
const FAST_M_PER_S: f64 = 50.0;
/// Greatest motion to and fro at rest, m a tick.
const CHATTER_M: f64 = 10e-6;
/// Share of the ticks at rest that turn back, from which on a motion is chatter and no swing.
const TURNS_BACK: f64 = 0.25;
/// Part of the rest that is judged.
const JUDGED_S: f64 = 0.5 * REST_S;
/// Displacement that bounds the work of a tendon: a channel 2.5 mm off the axis and 27 flexures at 5 degrees, with a margin of two, m.
const TAKE_UP_M: f64 = 12e-3;

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
        watch.look(run.plant().state(), seconds);
    }
    watch.verdict(drawn)
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

/// What is watched of a run.
#[derive(Default)]
struct Watch {
    last: Option<Vector3<f64>>,
    moved: Vector3<f64>,
    fastest_m_per_s: f64,
    not_finite: Option<u64>,
    start: Option<Vector3<f64>>,
    walked_m: f64,
    turned_back: u64,
    ticks: u64,
}

impl Watch {
    fn look(&mut self, state: &State, seconds: f64) {
        if !is_finite(state) {
            self.not_finite.get_or_insert(state.tick);
        }
        let burr = Vector3::from(state.t_world_burr.position_m);
        let moved = self.last.map_or(Vector3::zeros(), |last| burr - last);
        let dt_s = state.sim_time_s / state.tick as f64;
        self.fastest_m_per_s = self.fastest_m_per_s.max(moved.norm() / dt_s);
        if seconds >= DRIVEN_S + REST_S - JUDGED_S {
            self.start.get_or_insert(burr);
            self.walked_m += moved.norm();
            self.turned_back += u64::from(moved.dot(&self.moved) < 0.0);
            self.ticks += 1;
        }
        (self.last, self.moved) = (Some(burr), moved);
    }

    fn verdict(&self, drawn: &Drawn) -> Seen {
        if let Some(tick) = self.not_finite {
            return Seen { class: Class::NotFinite, what: format!("tick {tick}") };
        }
        let explained = explained_m_per_s(drawn).max(FAST_M_PER_S);
        if self.fastest_m_per_s > explained {
            let what = format!("{:.0} m/s, the tendons explain {explained:.0}", self.fastest_m_per_s);
            return Seen { class: Class::Fast, what };
        }
        let net_m = self.start.zip(self.last).map_or(0.0, |(start, last)| (last - start).norm());
        let to_and_fro_m = (self.walked_m - net_m) / self.ticks.max(1) as f64;
        let turned_back = self.turned_back as f64 / self.ticks.max(1) as f64;
        if to_and_fro_m > CHATTER_M && turned_back > TURNS_BACK {
            let what = format!("{:.0} um a tick, {:.0} % turn back", to_and_fro_m * 1e6, turned_back * 100.0);
            return Seen { class: Class::Chatter, what };
        }
        Seen { class: Class::Sound, what: String::new() }
    }
}

/// The speed at which the burr alone would carry all the work that the tendons' greatest tension can do.
fn explained_m_per_s(drawn: &Drawn) -> f64 {
    let mass_scale = drawn.scene.manipulator.mass_scale.unwrap_or(1.0);
    let most_n = drawn.greatest_tension_n();
    let burr_kg = simulation::manipulator::ManipulatorParameters::jhu_27().burr_mass_kg * mass_scale;
    (2.0 * most_n * TAKE_UP_M / burr_kg).sqrt()
}

fn is_finite(state: &State) -> bool {
    let joints = state.joint_count as usize;
    let lists: [&[f64]; 9] = [
        &state.t_world_burr.position_m,
        &state.t_world_tip.position_m,
        &state.t_world_base.position_m,
        &state.flange_wrench.force_n,
        &state.flange_wrench.torque_nm,
        &state.tendon_tension_n,
        &state.tendon_displacement_m,
        &state.joint_position_rad[..joints],
        &state.joint_velocity_rad_per_s[..joints],
    ];
    let single = [
        state.bend_rad,
        state.burr_force_n,
        state.wall_force_n,
        state.strength_share,
        state.contact_residual_m_per_s,
        state.stop_excess_rad,
        state.cutting_energy_j,
        state.crushing_energy_j,
    ];
    lists.iter().all(|list| list.iter().all(|value| value.is_finite()))
        && single.iter().all(|value| value.is_finite())
}
