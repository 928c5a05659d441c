//! Moves tool and free bodies against the contact planes of their whole way.

use nalgebra::Vector3;

use super::{Simulation, SimulationError};
use crate::manipulator::{ManipulatorModel, StepInput, StepReport};
use crate::rigid::ToolDrive;

/// A contact plane takes part in a tick if its gap is within the sphere's travel in the tick plus this margin, m.
const CONTACT_MARGIN_M: f64 = 1.0e-4;

/// Maximum steps of the tool in a tick, each with planes from farther away.
const MAX_ATTEMPTS: usize = 4;
/// Farthest that planes are looked for, m. A tool that is faster moves the length of a hip joint in a tick.
const MAX_REACH_M: f64 = 0.05;

/// Where a sphere was before the tick, and how far its planes are looked for.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reach {
    /// World, m.
    from_m: Vector3<f64>,
    margin_m: f64,
}

impl Reach {
    /// Of a sphere that has not moved yet.
    pub fn none() -> Reach {
        Reach { from_m: Vector3::zeros(), margin_m: 0.0 }
    }
}

impl Simulation<'_> {
    /// Steps tool and free bodies. If a sphere comes farther than its planes were looked for, the tool steps again with those of its whole
    /// way: otherwise a suddenly pulled tool, whose speed at the start of the tick tells nothing, passes through bone.
    pub(super) fn move_tool(&mut self, drive: &ToolDrive) -> Result<StepReport, SimulationError> {
        for (reach, sphere) in self.reach.iter_mut().zip(self.manipulator.proxy_spheres()) {
            reach.from_m = sphere.centre_m;
            reach.margin_m = CONTACT_MARGIN_M + sphere.velocity_m_per_s.norm() * self.dt_s;
        }
        self.find_contacts();
        if let Some(rigid) = &mut self.rigid {
            return Ok(rigid.step(&mut self.manipulator, drive, &mut self.planes)?);
        }
        if self.bone.is_some() {
            self.manipulator.save(&mut self.before);
        }
        let ToolDrive { base, tendon, tip_wrench } = *drive;
        let mut attempt = 1;
        loop {
            let input = StepInput { base, tendon, tip_wrench, contacts: &self.planes };
            let report = self.manipulator.step(self.dt_s, &input)?;
            if attempt == MAX_ATTEMPTS || !self.widen_reach() {
                return Ok(report);
            }
            attempt += 1;
            self.manipulator.restore(&self.before);
            self.find_contacts();
        }
    }

    /// Widens the reach of every sphere that came farther than its own; true if there is any and there is bone.
    fn widen_reach(&mut self) -> bool {
        let mut farther = false;
        for (reach, sphere) in self.reach.iter_mut().zip(self.manipulator.proxy_spheres()) {
            let moved_m = (sphere.centre_m - reach.from_m).norm();
            if moved_m > reach.margin_m && moved_m.is_finite() {
                reach.margin_m = (moved_m + CONTACT_MARGIN_M).min(MAX_REACH_M);
                farther = true;
            }
        }
        farther && self.bone.is_some()
    }

    fn find_contacts(&mut self) {
        self.planes.clear();
        if let Some(bone) = &mut self.bone {
            bone.contacts.clear();
            let spheres = self.manipulator.proxy_spheres().iter().zip(&self.reach);
            for (index, (sphere, reach)) in spheres.enumerate() {
                let (centre, radius_m) = (&sphere.centre_m, sphere.radius_m);
                bone.field.contact_planes_tracked(
                    index,
                    centre,
                    radius_m,
                    reach.margin_m,
                    &mut bone.contacts,
                );
            }
            self.planes.extend_from_slice(bone.contacts.planes());
        }
        if let Some(rigid) = &mut self.rigid {
            rigid.find_contacts(self.manipulator.proxy_spheres(), CONTACT_MARGIN_M, &mut self.planes);
        }
    }
}
