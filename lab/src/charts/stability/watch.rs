//! Observations of a run in this process: speeds, non-finite numbers, chatter at rest.

use ipc_types::messages::State;
use nalgebra::Vector3;
use simulation::creation_bound_j;

/// Maximum oscillation at rest, m per tick.
const CHATTER_M: f64 = 10e-6;
/// Fraction of the ticks at rest with a reversal above which a motion is chatter rather than a swing.
const TURNS_BACK: f64 = 0.25;
/// Displacement that bounds the work of a tendon: a channel 2.5 mm off the axis and 27 flexures at 5 degrees,
/// with a safety factor of two, m.
const TAKE_UP_M: f64 = 12e-3;

/// Oscillation at rest.
#[derive(Debug, Clone, Copy)]
pub struct Chatter {
    /// Path length beyond the net displacement, m per tick.
    pub to_and_fro_m: f64,
    /// Fraction of the ticks with a reversal.
    pub turned_back: f64,
}

/// Observations of a run.
#[derive(Debug, Default)]
pub struct Watch {
    last: Option<Vector3<f64>>,
    moved: Vector3<f64>,
    start: Option<Vector3<f64>>,
    walked_m: f64,
    turned_back: u64,
    ticks: u64,
    /// Maximum speed of the burr from tick to tick.
    pub fastest_m_per_s: f64,
    /// The first tick with a non-finite published number.
    pub not_finite: Option<u64>,
    /// Largest angle of a flexure past its stop.
    pub past_stop_rad: f64,
    /// Energy that ticks created beyond the integrator's error, J.
    pub created_j: f64,
    /// The tick that created the largest share of the energy that it may create.
    pub worst: Imbalance,
    ledger: Ledger,
}

/// Imbalance of the energy ledger in a tick.
#[derive(Debug, Clone, Copy, Default)]
pub struct Imbalance {
    /// Number of the tick.
    pub tick: u64,
    /// Energy that the tick created, J.
    pub created_j: f64,
    /// Largest energy that it may create without a report, J.
    pub bound_j: f64,
}

impl Imbalance {
    /// Returns the created energy over its bound.
    pub fn share(&self) -> f64 {
        if self.bound_j > 0.0 { self.created_j / self.bound_j } else { 0.0 }
    }
}

/// The ledger's sums after a tick, J.
#[derive(Debug, Clone, Copy, Default)]
struct Ledger {
    /// Works of tendons, arm, gravity, bodies and the cutting's side force.
    works_j: [f64; 5],
    /// What the works left.
    left_j: f64,
    tool_j: f64,
}

impl Ledger {
    fn of(state: &State) -> Ledger {
        let side_j = state.motor_work_j - state.cutting_energy_j;
        let (arm_j, body_j) = (state.arm_work_j, state.body_work_j);
        Ledger {
            works_j: [state.tendon_work_j, arm_j, state.gravity_work_j, body_j, side_j],
            left_j: state.numerical_energy_j + state.friction_energy_j + state.damping_energy_j,
            tool_j: state.tool_energy_j,
        }
    }

    fn imbalance(&self, before: &Ledger, tick: u64) -> Imbalance {
        let works_j = self.works_j.iter().zip(before.works_j);
        let gross_j = works_j.map(|(now_j, before_j)| (now_j - before_j).abs()).sum();
        let bound_j = creation_bound_j(gross_j, self.tool_j.max(before.tool_j));
        Imbalance { tick, created_j: before.left_j - self.left_j, bound_j }
    }
}

impl Watch {
    /// Observes the state after a tick; chatter is evaluated on those at rest.
    pub fn look(&mut self, state: &State, is_at_rest: bool) {
        if !is_finite(state) {
            self.not_finite.get_or_insert(state.tick);
        }
        self.past_stop_rad = self.past_stop_rad.max(state.stop_excess_rad);
        self.created_j = state.energy_created_j;
        let ledger = Ledger::of(state);
        if self.last.is_some() {
            let imbalance = ledger.imbalance(&self.ledger, state.tick);
            if imbalance.share() > self.worst.share() {
                self.worst = imbalance;
            }
        }
        self.ledger = ledger;
        let burr = Vector3::from(state.t_world_burr.position_m);
        let moved = self.last.map_or(Vector3::zeros(), |last| burr - last);
        let dt_s = state.sim_time_s / state.tick as f64;
        self.fastest_m_per_s = self.fastest_m_per_s.max(moved.norm() / dt_s);
        if is_at_rest {
            self.start.get_or_insert(burr);
            self.walked_m += moved.norm();
            self.turned_back += u64::from(moved.dot(&self.moved) < 0.0);
            self.ticks += 1;
        }
        (self.last, self.moved) = (Some(burr), moved);
    }

    /// Returns the chatter at rest, if any.
    pub fn chatter(&self) -> Option<Chatter> {
        let net_m = self.start.zip(self.last).map_or(0.0, |(start, last)| (last - start).norm());
        let to_and_fro_m = (self.walked_m - net_m) / self.ticks.max(1) as f64;
        let turned_back = self.turned_back as f64 / self.ticks.max(1) as f64;
        let is_chatter = to_and_fro_m > CHATTER_M && turned_back > TURNS_BACK;
        is_chatter.then_some(Chatter { to_and_fro_m, turned_back })
    }
}

/// Returns the speed at which the burr alone would carry all the work of a tendon's maximum tension.
pub fn explained_m_per_s(greatest_tension_n: f64, mass_scale: f64) -> f64 {
    let burr_kg = simulation::manipulator::ManipulatorParameters::jhu_27().burr_mass_kg * mass_scale;
    (2.0 * greatest_tension_n * TAKE_UP_M / burr_kg).sqrt()
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
        state.tool_energy_j,
        state.numerical_energy_j,
    ];
    lists.iter().all(|list| list.iter().all(|value| value.is_finite()))
        && single.iter().all(|value| value.is_finite())
}
