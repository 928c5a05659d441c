//! The hard cases of the stability map.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use physics_lab::Wall;
use simulation::manipulator::{
    BaseMotion, Integrator, ManipulatorError, ManipulatorParameters, Rung, Wrench,
};

use crate::charts::method::{Drive, Method, Tool};

/// Half the tunnel's width: the burr's radius plus 50 µm, m.
const TUNNEL_M: f64 = 3.3e-3;
/// Play of the burr to each side in another tool's tunnel, m.
const PLAY_M: f64 = 50e-6;
/// Steps in which another tool comes to rest under its pull, to place its wall.
const SETTLING_STEPS: usize = 4000;
const SETTLING_STEP_S: f64 = 0.25e-3;
/// Distance of the straight tool's burr centre from the flange, m.
const REACH_M: f64 = 0.071_470_28;
/// Euler's buckling load of the tool clamped at its base, N: the smallest axial load at the burr that the
/// flexures cannot resist.
const EULER_N: f64 = 1.306;
/// Axial loads as multiples of Euler's load: one that buckles the tool to 100 degrees, and one that folds it
/// back on itself.
const BUCKLING: [f64; 2] = [1.5, 2.3];
/// Transverse fraction of these loads: 0.4 degrees. No real push is better aligned, and without it the
/// straight shape would also be a solution.
const ACROSS: f64 = 1.0 / 150.0;

/// A pull on tendon 0, N, or for a tool without tendons a force across its burr, N.
#[derive(Debug, Clone, Copy)]
pub struct Pull {
    tension_n: f64,
    across_n: f64,
}

/// Tool-dependent parameters of the cases.
#[derive(Debug, Clone, Copy)]
pub struct Setup {
    /// Euler's buckling load of the tool clamped at its base, N.
    pub euler_n: f64,
    /// Pull of the tension step, of the cases with walls, and while the base moves (the last one for the
    /// tool's own stiffness).
    step: Pull,
    press: Pull,
    moved: Pull,
    /// Positions of the walls in the initial base frame, m: to the side of the axis in the bending plane,
    /// those of the tunnel, in front of the burr (corner), to its side across the plane (corner), and in
    /// front of it (moved base).
    side_m: f64,
    tunnel_m: [f64; 2],
    corner_front_m: f64,
    corner_beside_m: f64,
    front_m: f64,
}

impl Setup {
    /// Setup of the scenes' tool.
    pub const STANDARD: Setup = Setup {
        euler_n: EULER_N,
        step: Pull { tension_n: 30.0, across_n: 0.0 },
        press: Pull { tension_n: 8.0, across_n: 0.0 },
        moved: Pull { tension_n: 2.0, across_n: 0.0 },
        side_m: 8e-3,
        tunnel_m: [-TUNNEL_M, TUNNEL_M],
        corner_front_m: REACH_M + 3.3e-3,
        corner_beside_m: TUNNEL_M,
        front_m: REACH_M + 5e-3,
    };

    /// Returns the setup for another tool: a wall is at half the distance that the pull achieves in free
    /// space; a tunnel is 50 µm wider on each side than the burr at rest. A tool without tendons is pressed
    /// by a tenth of Euler's load across its burr.
    ///
    /// # Errors
    /// Invalid parameters.
    pub fn of(p: &ManipulatorParameters) -> Result<Setup, ManipulatorError> {
        let euler_n = p.euler_load_n();
        let pull = |tension_n: f64| match p.tendon_count() {
            0 => Pull { tension_n: 0.0, across_n: 0.1 * euler_n },
            _ => Pull { tension_n, across_n: 0.0 },
        };
        let method = Method::Rung(Rung::Planar, Integrator::LinearlyImplicitEuler);
        let base = BaseMotion::at_rest(Isometry3::identity());
        let mut tool = Tool::new(method, p, &base, &[])?;
        let rest_m = tool.tip_m();
        let press = pull(8.0);
        let tip = Wrench { force_n: Vector3::x() * press.across_n, ..Wrench::zero() };
        let drive = Drive { tension_n: press.tension_n, tip, ..Drive::still(base) };
        for _ in 0..SETTLING_STEPS {
            tool.step(SETTLING_STEP_S, &drive);
        }
        let burr_m = p.cutter.front_radius_m();
        Ok(Setup {
            euler_n,
            step: pull(30.0),
            press,
            moved: Pull { tension_n: 0.25 * press.tension_n, across_n: 0.25 * press.across_n },
            side_m: 0.5 * (rest_m.x + tool.tip_m().x) + burr_m,
            tunnel_m: [rest_m.x - burr_m - PLAY_M, rest_m.x + burr_m + PLAY_M],
            corner_front_m: rest_m.z + burr_m + PLAY_M,
            corner_beside_m: burr_m + PLAY_M,
            front_m: rest_m.z + burr_m + 1.75e-3,
        })
    }
}

/// A hard case.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Case {
    /// Tension from 0 to 30 N at once.
    TensionStep,
    /// 8 N into a wall 8 mm beside the axis.
    StiffWall,
    /// 8 N between two walls.
    Tunnel,
    /// 8 N into the corner of three walls.
    Corner,
    /// An axial load of 1.5 times Euler's load, applied at once.
    Buckling,
    /// The base approaches at 0.5 m/s and presses the burr onto a transverse wall.
    MovedBase,
    /// The stiff wall, 10 m from the origin and rotated.
    FarAnatomy,
    /// Pressed against a wall that then vanishes.
    Leaving,
    /// An axial load of 2.3 times Euler's load, applied at once.
    FarBuckling,
}

/// Final state of a run.
#[derive(Debug, Clone, Copy)]
pub struct Ending {
    /// Burr centre in the initial base frame, m.
    pub tip_m: Vector3<f64>,
    /// Whether the tool was lost.
    pub lost: bool,
    /// Whether energy grew over the last fifth, in which nothing changes any more.
    pub energy_grew: bool,
}

impl Case {
    /// All cases; the last one is beyond what is claimed for a large step ([`Case::is_claimed`]).
    pub const ALL: [Case; 9] = [
        Case::TensionStep,
        Case::StiffWall,
        Case::Tunnel,
        Case::Corner,
        Case::Buckling,
        Case::MovedBase,
        Case::FarAnatomy,
        Case::Leaving,
        Case::FarBuckling,
    ];

    /// Whether our methods are claimed to be correct at every step size. A dead load on the burr enters a
    /// step with the shape at the step's start, so the operator lacks the load's contribution to the
    /// stiffness. Above twice Euler's load, a step too long for inertia to limit it oscillates between two
    /// shapes.
    pub fn is_claimed(self) -> bool {
        self != Case::FarBuckling
    }

    /// Name in the CSV and in the map.
    pub fn key(self) -> &'static str {
        match self {
            Case::TensionStep => "tension step 0-30 N",
            Case::StiffWall => "stiff wall",
            Case::Tunnel => "two-sided tunnel",
            Case::Corner => "corner",
            Case::Buckling => "1.5 x Euler's load",
            Case::MovedBase => "base at 0.5 m/s",
            Case::FarAnatomy => "10 m from origin",
            Case::Leaving => "burr leaves bone",
            Case::FarBuckling => "2.3 x Euler's load",
        }
    }

    /// Whether the case is defined for a tool: in a straight tunnel a pre-curved one would penetrate the
    /// wall.
    pub fn fits(self, p: &ManipulatorParameters) -> bool {
        self != Case::Tunnel || p.joint_rest_rad.iter().all(|rest| *rest == 0.0)
    }

    fn walls(self, setup: &Setup) -> Vec<Wall> {
        let (x, y, z) = (Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis());
        let side = Wall::new(-x, x.scale(setup.side_m));
        match self {
            Case::TensionStep | Case::Buckling | Case::FarBuckling => Vec::new(),
            Case::StiffWall | Case::FarAnatomy | Case::Leaving => vec![side],
            Case::Tunnel => {
                let [low_m, high_m] = setup.tunnel_m;
                vec![Wall::new(-x, x.scale(high_m)), Wall::new(x, x.scale(low_m))]
            }
            Case::Corner => {
                let front = Wall::new(-z, z.scale(setup.corner_front_m));
                vec![side, front, Wall::new(-y, y.scale(setup.corner_beside_m))]
            }
            Case::MovedBase => vec![Wall::new(-z, z.scale(setup.front_m))],
        }
    }

    /// Returns the initial base frame in the world.
    fn place(self) -> Isometry3<f64> {
        match self {
            Case::FarAnatomy => Isometry3::from_parts(
                Translation3::new(7.0, -4.5, 5.5),
                UnitQuaternion::from_scaled_axis(Vector3::new(0.7, -1.1, 0.4)),
            ),
            _ => Isometry3::identity(),
        }
    }

    fn seconds(self) -> f64 {
        match self {
            // Near Euler's load the tool is soft and oscillates longer.
            Case::Buckling | Case::FarBuckling => 2.0,
            Case::MovedBase => 0.8,
            _ => 0.5,
        }
    }

    fn drive(self, t: f64, dt_s: f64, stiffness: f64, setup: &Setup) -> Drive {
        let place = self.place();
        let mut drive = Drive::still(BaseMotion::at_rest(place));
        let pull = |drive: &mut Drive, pull: Pull, share: f64| {
            drive.tension_n = pull.tension_n * share;
            drive.tip.force_n = place * Vector3::new(pull.across_n * share, 0.0, 0.0);
        };
        match self {
            Case::TensionStep => pull(&mut drive, setup.step, 1.0),
            // Where the shape decides the case, loads scale with the stiffness.
            Case::Buckling | Case::FarBuckling => {
                let load_n = setup.euler_n * BUCKLING[usize::from(self == Case::FarBuckling)] * stiffness;
                drive.tip = Wrench { force_n: Vector3::new(ACROSS, 0.0, -1.0) * load_n, ..Wrench::zero() };
            }
            Case::MovedBase => {
                pull(&mut drive, setup.moved, stiffness.min(10.0));
                let (speed, stop) = (0.5, 8e-3);
                let at = (speed * t).min(stop);
                drive.base.t_world_base.translation.vector.z = at;
                let moving = (at - (speed * (t - dt_s)).clamp(0.0, stop)) / dt_s;
                drive.base.linear_velocity_m_per_s.z = moving;
            }
            _ => pull(&mut drive, setup.press, 1.0),
        }
        drive
    }

    /// Runs the case.
    ///
    /// # Errors
    /// Invalid parameters.
    pub fn play(
        self,
        method: Method,
        p: &ManipulatorParameters,
        setup: &Setup,
        stiffness: f64,
        dt_ms: f64,
    ) -> Result<Ending, ManipulatorError> {
        let dt_s = dt_ms * 1e-3;
        let place = self.place();
        let walls: Vec<Wall> = self.walls(setup).iter().map(|wall| wall.moved(&place)).collect();
        let mut tool = Tool::new(method, p, &BaseMotion::at_rest(place), &walls)?;
        let steps = (self.seconds() / dt_s).round() as usize;
        let (mut early, mut late) = (0.0f64, 0.0f64);
        for k in 0..steps {
            if self == Case::Leaving && k == steps / 2 {
                tool.remove_walls();
            }
            tool.step(dt_s, &self.drive((k + 1) as f64 * dt_s, dt_s, stiffness, setup));
            if tool.is_lost() {
                break;
            }
            // The maximum of each half of the last fifth.
            if k * 10 >= steps * 9 {
                late = late.max(tool.energy_j());
            } else if k * 10 >= steps * 8 {
                early = early.max(tool.energy_j());
            }
        }
        let tip_m = place.inverse_transform_point(&tool.tip_m().into()).coords;
        Ok(Ending { tip_m, lost: tool.is_lost(), energy_grew: tool.is_lost() || late > early * 1.001 + 1e-9 })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn eulers_load_is_that_of_the_tool() {
        let load_n = ManipulatorParameters::jhu_27().euler_load_n();
        assert!((load_n - EULER_N).abs() < 1e-3, "{load_n} N");
    }

    /// Compared with a continuous beam, pi² E I / (4 L²).
    #[test]
    fn eulers_load_of_a_fine_chain_is_that_of_the_beam() {
        let mut p = ManipulatorParameters::jhu_27();
        let count = 400;
        p.joint_positions_m = (0..count).map(|i| (f64::from(i) + 0.5) * 1e-4).collect();
        p.joint_stiffness_nm_per_rad = vec![1.0 / 1e-4; count as usize];
        p.tip_offset_m = 0.5e-4;
        let law = std::f64::consts::PI.powi(2) / (4.0 * 0.04f64.powi(2));
        assert!((p.euler_load_n() / law - 1.0).abs() < 1e-4, "{} {law}", p.euler_load_n());
    }

    /// The rules for any tool put the standard tool's walls close to those of its map.
    #[test]
    fn the_setup_of_the_standard_tool_resembles_that_of_its_map() {
        let (own, map) = (Setup::of(&ManipulatorParameters::jhu_27()).unwrap(), Setup::STANDARD);
        assert!((own.corner_front_m - map.corner_front_m).abs() < 1e-6, "{own:?}");
        assert!((own.front_m - map.front_m).abs() < 1e-6 && (own.euler_n - map.euler_n).abs() < 1e-3);
        assert!((own.tunnel_m[1] - map.tunnel_m[1]).abs() < 1e-9 && own.side_m > map.tunnel_m[1]);
    }
}
