//! `trabecula-lab chart stability --bone`: hard cases in bone with the complete simulation, every rung at
//! every step size.

use hub::in_process::{Answer, InProcess};
use ipc_types::messages::{ArmMode, BurrMode, Command, State, TendonMode};
use nalgebra::Vector3;
use rayon::prelude::*;
use serde_json::json;
use simulation::{CtView, Simulation};

use super::bone_cases::{BoneCase, CASES, Drive};
use super::watch::{Watch, explained_m_per_s};
use crate::sheet::Sheet;
use trabecula::failure::Failure;

const MODELS: [&str; 3] = ["planar", "spatial", "full"];
/// Steps, ms.
const DT_MS: [f64; 5] = [0.2, 1.0, 2.0, 5.0, 10.0];
/// Step of the reference runs, ms; divides all other steps.
const REFERENCE_MS: f64 = 0.1;
/// Time for which a case rests under its last command, s; its second half is evaluated.
const REST_S: f64 = 0.3;
/// Maximum distance of the burr's final position from that at the reference's step, m.
const MOVED_M: f64 = 0.2e-3;
/// Maximum ratio of a contact's force to its strength, and maximum excess of a flexure beyond its stop, rad.
const MOST_SHARE: f64 = 1.05;
const MOST_PAST_STOP_RAD: f64 = 0.1 * core::f64::consts::PI / 180.0;
/// A tick has converged if its residual is at most this, m/s; and the minimum fraction of converged ticks.
const RESIDUAL_M_PER_S: f64 = 1e-6;
const LEAST_CONVERGED: f64 = 0.999;
/// A jump is a change of the flange's force by more than this fraction of itself, above this force, N; and
/// the maximum fraction of ticks in contact with a jump, beyond the reference's fraction between the same
/// instants: if the command itself jumps, a correct solution does too.
const JUMP: f64 = 0.5;
const JUMP_FROM_N: f64 = 0.5;
const MOST_JUMPS: f64 = 0.01;
/// Maximum speed of the burr without an explanation, m/s.
const FAST_M_PER_S: f64 = 1.0;

/// Observations of a run.
#[derive(Default)]
struct Seen {
    watch: Watch,
    ended: Option<String>,
    burr_m: Vector3<f64>,
    most_share: f64,
    past_stop_rad: f64,
    ticks: u64,
    converged: u64,
    /// The flange's force after each tick, N, and whether the tool was in contact.
    flange: Vec<(f64, bool)>,
    greatest_tension_n: f64,
}

impl Seen {
    fn look(&mut self, state: &State, is_at_rest: bool) {
        self.watch.look(state, is_at_rest);
        self.burr_m = Vector3::from(state.t_world_burr.position_m);
        self.most_share = self.most_share.max(state.strength_share);
        self.past_stop_rad = self.past_stop_rad.max(state.stop_excess_rad);
        self.ticks += 1;
        self.converged += u64::from(state.contact_residual_m_per_s <= RESIDUAL_M_PER_S);
        let flange_n = Vector3::from(state.flange_wrench.force_n).norm();
        self.flange.push((flange_n, state.contact_count > 0));
    }

    /// Returns the fraction of ticks in contact in which the flange's force jumps, sampled every `every`
    /// ticks.
    fn jump_share(&self, every: usize) -> f64 {
        let (mut last_n, mut jumps, mut in_contact) = (0.0, 0u32, 0u32);
        for (flange_n, touches) in self.flange.iter().skip(every - 1).step_by(every) {
            let larger_n = flange_n.max(last_n);
            let jumped = larger_n > JUMP_FROM_N && (flange_n - last_n).abs() > JUMP * larger_n;
            in_contact += u32::from(*touches);
            jumps += u32::from(*touches && jumped);
            last_n = *flange_n;
        }
        f64::from(jumps) / f64::from(in_contact.max(1))
    }

    /// Returns the faults, compared with a reference that takes several ticks for each of these.
    fn faults(&self, reference: Option<(&Seen, usize)>) -> Vec<String> {
        if let Some(cause) = &self.ended {
            return vec![cause.clone()];
        }
        if let Some(tick) = self.watch.not_finite {
            return vec![format!("not finite from tick {tick}")];
        }
        let mut faults = Vec::new();
        let explained = FAST_M_PER_S.max(explained_m_per_s(self.greatest_tension_n, 1.0));
        if self.watch.fastest_m_per_s > explained {
            faults.push(format!("{:.1} m/s", self.watch.fastest_m_per_s));
        }
        if let Some(chatter) = self.watch.chatter() {
            faults.push(format!("chatter {:.0} um a tick", chatter.to_and_fro_m * 1e6));
        }
        if self.most_share > MOST_SHARE {
            faults.push(format!("{:.2} of the strength", self.most_share));
        }
        if self.past_stop_rad > MOST_PAST_STOP_RAD {
            faults.push(format!("{:.2} deg past a stop", self.past_stop_rad.to_degrees()));
        }
        let converged = self.converged as f64 / self.ticks.max(1) as f64;
        if converged < LEAST_CONVERGED {
            faults.push(format!("{:.1} % converged", converged * 100.0));
        }
        let jumps = [self.jump_share(1), reference.map_or(0.0, |(seen, every)| seen.jump_share(every))];
        if jumps[0] - jumps[1] > MOST_JUMPS {
            let [own, right] = jumps.map(|share| share * 100.0);
            faults.push(format!("force jumps in {own:.1} %, {right:.1} in the reference"));
        }
        let moved_m = reference.map_or(0.0, |(seen, _)| (self.burr_m - seen.burr_m).norm());
        if moved_m > MOVED_M {
            faults.push(format!("ends {:.2} mm off", moved_m * 1e3));
        }
        faults
    }
}

/// Runs every case, prints faults and counts. Returns the number of runs with a fault.
///
/// # Errors
/// A case is refused.
pub fn run(sheet: &mut Sheet) -> Result<usize, Failure> {
    let of_models: Vec<(usize, &str)> =
        (0..CASES.len()).flat_map(|case| MODELS.map(|model| (case, model))).collect();
    // Each with its reference first.
    let seen: Vec<Vec<Seen>> = of_models
        .par_iter()
        .map(|(case, model)| {
            let all_ms = core::iter::once(REFERENCE_MS).chain(DT_MS);
            all_ms.map(|dt_ms| play(&CASES[*case], model, dt_ms)).collect()
        })
        .collect::<Result<_, Failure>>()?;
    let mut right_at = [0; DT_MS.len()];
    for ((case, model), seen) in of_models.iter().zip(&seen) {
        let case = &CASES[*case];
        if *model == MODELS[0] {
            sheet.line(&format!("{}: {}", case.name, case.what));
        }
        let Some((reference, seen)) = seen.split_first() else { continue };
        let mut cells = Vec::new();
        for ((dt_ms, seen), right) in DT_MS.iter().zip(seen).zip(&mut right_at) {
            let every = (dt_ms / REFERENCE_MS).round() as usize;
            let of_reference = reference.ended.is_none().then_some((reference, every));
            let faults = seen.faults(of_reference);
            *right += usize::from(faults.is_empty());
            let said = if faults.is_empty() { "ok".to_owned() } else { faults.join(", ") };
            cells.push(format!("{dt_ms} ms {said}"));
            sheet.push(
                "runs",
                json!({"case": case.name, "model": model, "dt_ms": dt_ms, "faults": faults,
                       "burr_mm": (seen.burr_m * 1e3).as_slice(),
                       "share_of_strength": seen.most_share, "stop_excess_rad": seen.past_stop_rad,
                       "jump_share": seen.jump_share(1),
                       "jump_share_of_reference": reference.jump_share(every),
                       "off_mm": (seen.burr_m - reference.burr_m).norm() * 1e3,
                       "converged": seen.converged as f64 / seen.ticks.max(1) as f64}),
            );
        }
        sheet.line(&format!("  {model:<8} {}", cells.join("; ")));
    }
    let counted = DT_MS.iter().zip(right_at).map(|(dt_ms, right)| format!("{right} at {dt_ms} ms"));
    let counted: Vec<String> = counted.collect();
    sheet.line(&format!("right of {} each: {}", of_models.len(), counted.join(", ")));
    Ok(DT_MS.len() * of_models.len() - right_at.iter().sum::<usize>())
}

fn play(case: &BoneCase, model: &str, dt_ms: f64) -> Result<Seen, Failure> {
    let failed = |cause: &dyn core::fmt::Display| Failure::failed(format!("{}: {cause}", case.name));
    let (block, scene) = (case.block(), case.scene(model, dt_ms, case.driven_s + REST_S)?);
    let ct = CtView { geometry: block.geometry, hu: &block.hu };
    let simulation = Simulation::new(&scene, Some(ct)).map_err(|cause| failed(&cause))?;
    let mut run = InProcess::new(&scene, simulation);
    let mut seen = Seen::default();
    for tick in 0..scene.tick_count() {
        let seconds = tick as f64 * scene.dt_s();
        let drive = (case.drive)(seconds.min(case.driven_s));
        seen.greatest_tension_n = drive.tension_n.into_iter().fold(seen.greatest_tension_n, f64::max);
        let made = run.tick(|_, _, command| {
            ask(&drive, command);
            Answer::Command
        });
        if let Err(cause) = made {
            seen.ended = Some(cause.to_string());
            return Ok(seen);
        }
        if let Some(refusal) = run.plant().refusals().first() {
            return Err(failed(&refusal.reason));
        }
        seen.look(run.plant().state(), seconds >= case.driven_s + 0.5 * REST_S);
    }
    Ok(seen)
}

fn ask(drive: &Drive, command: &mut Command) {
    command.tendon_mode = TendonMode::ServoJf.code();
    command.tendon_force_n[..2].copy_from_slice(&drive.tension_n);
    command.burr_mode = BurrMode::Speed.code();
    command.burr_speed_rad_per_s = drive.burr_rad_per_s;
    command.arm_mode = ArmMode::Insert.code();
    command.arm_axis = [0.0, 0.0, 1.0];
    (command.arm_depth_m, command.arm_speed_m_per_s) = (drive.depth_m, drive.feed_m_per_s);
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn a_case_is_right_at_a_millisecond_and_a_run_that_is_not_says_what() {
        let case = CASES.iter().find(|case| case.name == "shell of one voxel").unwrap();
        let mut seen = play(case, "planar", 1.0).unwrap();
        let end_at = |burr_m| Seen { burr_m, flange: seen.flange.clone(), ..Seen::default() };
        let [same, other] = [Vector3::zeros(), Vector3::x() * 0.3e-3].map(|by_m| end_at(seen.burr_m + by_m));
        assert_eq!(seen.faults(Some((&same, 1))), Vec::<String>::new());
        assert_eq!(seen.faults(Some((&other, 1))), ["ends 0.30 mm off"]);
        (seen.most_share, seen.past_stop_rad, seen.converged) = (1.2, 0.01, 0);
        let said = ["1.20 of the strength", "0.57 deg past a stop", "0.0 % converged"];
        assert_eq!(seen.faults(None), said);
    }

    /// A force that alternates between 1 and 4 N jumps in every tick. This is a fault unless the reference,
    /// sampled every second tick, jumps as well.
    #[test]
    fn a_jump_is_a_fault_unless_the_reference_jumps_as_well() {
        let of = |forces_n: &[f64]| Seen {
            flange: forces_n.iter().map(|force_n| (*force_n, true)).collect(),
            ticks: 1,
            converged: 1,
            ..Seen::default()
        };
        let jumpy = of(&[1.0, 4.0, 1.0, 4.0]);
        assert_eq!([jumpy.jump_share(1), jumpy.jump_share(2)], [1.0, 0.5]);
        let explains = of(&[1.0, 1.0, 2.0, 4.0, 2.0, 1.0, 3.0, 4.0]);
        assert_eq!(jumpy.faults(Some((&explains, 2))), Vec::<String>::new());
        let steady = of(&[1.0; 8]);
        assert_eq!(jumpy.faults(Some((&steady, 2))), ["force jumps in 100.0 %, 25.0 in the reference"]);
        assert_eq!(jumpy.faults(None), ["force jumps in 100.0 %, 0.0 in the reference"]);
    }
}
