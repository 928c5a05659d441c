//! The hard cases of the stability map.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use simulation::baselines::Wall;
use simulation::manipulator::{BaseMotion, ManipulatorError, ManipulatorParameters, Wrench};

use crate::charts::method::{Drive, Method, Tool};

/// Half the tunnel's width: the burr's radius plus 50 µm, m.
const TUNNEL_M: f64 = 3.3e-3;
/// Distance of the straight tool's burr centre from the flange, m.
const REACH_M: f64 = 0.071_470_28;
/// Euler's buckling load of the tool clamped at its base, N: the smallest axial load at the burr that the flexures
/// cannot resist.
const EULER_N: f64 = 1.306;
/// Axial loads as multiples of Euler's load: one that buckles the tool to 100 degrees, and one that folds it back on
/// itself.
const BUCKLING: [f64; 2] = [1.5, 2.3];
/// Transverse fraction of these loads: 0.4 degrees. No real push is better aligned, and without it the straight shape
/// would be a solution too.
const ACROSS: f64 = 1.0 / 150.0;

/// What happens to the tool.
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

/// How a run ended.
#[derive(Debug, Clone, Copy)]
pub struct Ending {
    /// Burr centre in the initial base frame, m.
    pub tip_m: Vector3<f64>,
    /// Whether the tool was lost.
    pub lost: bool,
    /// Whether energy grew over the last fifth, when nothing changes any more.
    pub energy_grew: bool,
}

impl Case {
    /// All cases; the last one is beyond what a large step is claimed to handle ([`Case::is_claimed`]).
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

    /// Whether our methods are claimed to be right at every step size. A dead load on the burr enters a step with the
    /// shape at the step's start, so the operator lacks the load's contribution to the stiffness. Above twice Euler's
    /// load, a step too long for inertia to limit it oscillates between two shapes.
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

    fn walls(self) -> Vec<Wall> {
        let (x, y, z) = (Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis());
        let side = Wall::new(-x, x.scale(8e-3));
        match self {
            Case::TensionStep | Case::Buckling | Case::FarBuckling => Vec::new(),
            Case::StiffWall | Case::FarAnatomy | Case::Leaving => vec![side],
            Case::Tunnel => vec![Wall::new(-x, x.scale(TUNNEL_M)), Wall::new(x, x.scale(-TUNNEL_M))],
            Case::Corner => {
                vec![side, Wall::new(-z, z.scale(REACH_M + 3.3e-3)), Wall::new(-y, y.scale(TUNNEL_M))]
            }
            Case::MovedBase => vec![Wall::new(-z, z.scale(REACH_M + 5e-3))],
        }
    }

    /// Initial base frame in the world.
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
            // Near Euler's load the tool is soft and oscillates for longer.
            Case::Buckling | Case::FarBuckling => 2.0,
            Case::MovedBase => 0.8,
            _ => 0.5,
        }
    }

    fn drive(self, t: f64, dt_s: f64, stiffness: f64) -> Drive {
        let place = self.place();
        let mut drive = Drive::still(BaseMotion::at_rest(place));
        match self {
            Case::TensionStep => drive.tension_n = 30.0,
            // Where the shape decides the case, loads scale with the stiffness.
            Case::Buckling | Case::FarBuckling => {
                let load_n = EULER_N * BUCKLING[usize::from(self == Case::FarBuckling)] * stiffness;
                drive.tip = Wrench { force_n: Vector3::new(ACROSS, 0.0, -1.0) * load_n, ..Wrench::zero() };
            }
            Case::MovedBase => {
                drive.tension_n = 2.0 * stiffness.min(10.0);
                let (speed, stop) = (0.5, 8e-3);
                let at = (speed * t).min(stop);
                drive.base.t_world_base.translation.vector.z = at;
                let moving = (at - (speed * (t - dt_s)).clamp(0.0, stop)) / dt_s;
                drive.base.linear_velocity_m_per_s.z = moving;
            }
            _ => drive.tension_n = 8.0,
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
        stiffness: f64,
        dt_ms: f64,
    ) -> Result<Ending, ManipulatorError> {
        let dt_s = dt_ms * 1e-3;
        let place = self.place();
        let walls: Vec<Wall> = self.walls().iter().map(|wall| wall.moved(&place)).collect();
        let mut tool = Tool::new(method, p, &BaseMotion::at_rest(place), &walls)?;
        let steps = (self.seconds() / dt_s).round() as usize;
        let (mut early, mut late) = (0.0f64, 0.0f64);
        for k in 0..steps {
            if self == Case::Leaving && k == steps / 2 {
                tool.remove_walls();
            }
            tool.step(dt_s, &self.drive((k + 1) as f64 * dt_s, dt_s, stiffness));
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
    use super::*;

    /// The load at which its linearised moments, `P (x_tip - x_i)`, equal those of the flexures: power iteration.
    #[test]
    fn eulers_load_is_that_of_the_tool() {
        let p = ManipulatorParameters::jhu_27();
        let mut ends: Vec<f64> = p.joint_positions_m.clone();
        ends.push(ends[ends.len() - 1] + p.tip_offset_m);
        let (mut shape, mut load_n) = (vec![1.0; p.joint_positions_m.len()], 0.0);
        for _ in 0..200 {
            let mut across = vec![0.0];
            let mut angle = 0.0;
            for (i, q) in shape.iter().enumerate() {
                angle += q;
                across.push(across[i] + angle * (ends[i + 1] - ends[i]));
            }
            let tip = across[shape.len()];
            let next: Vec<f64> =
                p.joint_stiffness_nm_per_rad.iter().zip(&across).map(|(k, x)| (tip - x) / k).collect();
            let (before, after) = (shape.iter().sum::<f64>(), next.iter().sum::<f64>());
            load_n = before / after;
            shape = next.iter().map(|q| q * load_n).collect();
        }
        assert!((load_n - EULER_N).abs() < 1e-3, "{load_n} N");
    }
}
