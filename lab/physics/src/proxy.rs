//! The haptic method: a proxy (god object) stays outside the walls, and the burr is set to it or pulled
//! toward it.

use nalgebra::{Matrix2, Vector2, Vector3};

use simulation::manipulator::{
    BaseMotion, Manipulator, ManipulatorError, ManipulatorModel, ManipulatorParameters, StepInput, StepReport,
};

use super::wall::Wall;

/// Iterations of the projection onto the walls, and of setting the joints.
const ROUNDS: usize = 8;

/// How the proxy acts on the burr.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProxyDrive {
    /// The burr's position is set to the proxy's and its velocity left unchanged, as in the published
    /// drilling simulators.
    Position,
    /// A spring from the burr to the proxy exerts a force in the next step, as in haptic rendering.
    Force,
}

/// Returns the position of a sphere's proxy: the point nearest to the sphere's centre at which it penetrates
/// no wall. World, m.
pub fn proxy_of(walls: &[Wall], centre_m: &Vector3<f64>, radius_m: f64) -> Vector3<f64> {
    let mut proxy = *centre_m;
    for _ in 0..ROUNDS {
        for wall in walls {
            let gap = wall.normal.dot(&(proxy - wall.point_m)) - radius_m;
            proxy -= wall.normal.into_inner() * gap.min(0.0);
        }
    }
    proxy
}

/// The planar tool with a proxy for its burr instead of contact.
#[derive(Debug, Clone)]
pub struct ProxyTool {
    tool: Manipulator,
    drive: ProxyDrive,
    walls: Vec<Wall>,
}

impl ProxyTool {
    /// Creates a straight tool at rest in front of walls. The spring of [`ProxyDrive::Force`] has the
    /// stiffness of the simulation's own contacts.
    ///
    /// # Errors
    /// A parameter is out of range; the error names it.
    pub fn new(
        drive: ProxyDrive,
        parameters: ManipulatorParameters,
        base: &BaseMotion,
        walls: &[Wall],
    ) -> Result<Self, ManipulatorError> {
        Ok(Self { tool: Manipulator::new(parameters, base)?, drive, walls: walls.to_vec() })
    }

    /// The tool.
    pub fn tool(&self) -> &Manipulator {
        &self.tool
    }

    /// Removes all walls.
    pub fn remove_walls(&mut self) {
        self.walls.clear();
    }

    /// From the burr's centre to its proxy, world, m.
    pub fn offset_m(&self) -> Vector3<f64> {
        let burr = self.tool.t_world_tip().translation.vector;
        proxy_of(&self.walls, &burr, self.tool.parameters().cutter.front_radius_m()) - burr
    }

    /// Advances by `dt_s`; ignores contacts in the input.
    ///
    /// # Errors
    /// The input is not finite or out of range.
    pub fn step(&mut self, dt_s: f64, input: &StepInput) -> Result<StepReport, ManipulatorError> {
        let mut tip_wrench = input.tip_wrench;
        if self.drive == ProxyDrive::Force {
            tip_wrench.force_n += self.offset_m() * self.tool.parameters().contact.stiffness_n_per_m;
        }
        let report = self.tool.step(dt_s, &StepInput { tip_wrench, contacts: &[], ..*input })?;
        if self.drive == ProxyDrive::Position {
            for _ in 0..ROUNDS {
                self.set_to_proxy();
            }
        }
        Ok(report)
    }

    /// Moves the burr to its proxy by the smallest change of the joint angles; leaves every velocity
    /// unchanged.
    fn set_to_proxy(&mut self) {
        let offset = self.tool.base().t_world_base.rotation.inverse() * self.offset_m();
        if offset.norm() < 1e-12 {
            return;
        }
        let place = |point: Vector3<f64>| {
            let base = self.tool.base().t_world_base;
            base.inverse_transform_point(&point.into()).coords
        };
        let burr = place(self.tool.t_world_tip().translation.vector);
        // A joint rotates about +y, so the burr moves by y x arm.
        let columns: Vec<Vector2<f64>> = (0..self.tool.joint_count())
            .map(|i| burr - place(self.tool.t_world_link(i + 1).translation.vector))
            .map(|arm| Vector2::new(arm.z, -arm.x))
            .collect();
        let mobility = columns.iter().fold(Matrix2::identity() * 1e-12, |sum, c| sum + c * c.transpose());
        let Some(inverse) = mobility.try_inverse() else { return };
        let push = inverse * Vector2::new(offset.x, offset.z);
        let mut state = self.tool.snapshot();
        // After the mount's three.
        for (angle, column) in state.position[3..].iter_mut().zip(&columns) {
            *angle += column.dot(&push);
        }
        self.tool.restore(&state);
    }
}
