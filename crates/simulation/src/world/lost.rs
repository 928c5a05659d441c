//! Checks whether a computed state is physically possible.
//!
//! Extreme parameters can drive any integrator out of its range: numbers grow until they overflow. Such a
//! tick ends the run before its state is published, so that no log contains it and no controller responds to
//! it.

use nalgebra::Vector3;
use thiserror::Error;

use super::{Simulation, numbers};
use crate::manipulator::{ManipulatorModel, ProxySphere};

/// Speed limit for any point of the tool, m/s: three times the speed of sound in air. The lightest and
/// stiffest tool that a scene allows, released when bent, reaches a tenth of it.
const MAX_SPEED_M_PER_S: f64 = 1000.0;
/// Largest distance of any point of the tool from its base, as a multiple of its straight length.
const MAX_STRETCH: f64 = 2.0;

/// Why a computed state is not physically possible.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum LostTool {
    /// A quantity is infinite or NaN.
    #[error("{what} is {value}, not a finite number")]
    NotFinite {
        /// Which quantity.
        what: &'static str,
        /// Its value.
        value: f64,
    },
    /// A point of the tool is too fast.
    #[error("a point on the tool moves at {speed_m_per_s:e} m/s, faster than {MAX_SPEED_M_PER_S} m/s")]
    TooFast {
        /// Its speed.
        speed_m_per_s: f64,
    },
    /// The tool came apart.
    #[error(
        "a point on the tool is {distance_m:e} m from its base, but the straight tool is {length_m:.3} m long"
    )]
    Apart {
        /// Distance from the base.
        distance_m: f64,
        /// Length of the straight tool, shaft to burr.
        length_m: f64,
    },
}

impl Simulation<'_> {
    /// Checks the tool and the free bodies after their step.
    ///
    /// # Errors
    /// The first quantity that is not finite or out of bounds.
    pub(super) fn check_not_lost(&self) -> Result<(), LostTool> {
        let tool = &self.manipulator;
        let joints = tool.joint_positions_rad().iter().chain(tool.joint_velocities_rad_per_s());
        check_finite("a flexure's angle or speed", joints.copied())?;
        let wrench = tool.flange_wrench();
        check_finite("the force on the flange", wrench.force_n.iter().chain(&wrench.torque_nm).copied())?;
        if let Some(rigid) = &self.rigid {
            let places = rigid.poses().flat_map(|pose| numbers(&pose.translation.vector));
            check_finite("a body's place", places)?;
        }
        let base = tool.t_world_link(0).translation.vector;
        let parameters = tool.parameters();
        let length_m = parameters.burr_centre_m() + parameters.cutter.front_radius_m();
        tool.proxy_spheres().iter().try_for_each(|sphere| check_sphere(sphere, &base, length_m))
    }
}

fn check_sphere(sphere: &ProxySphere, base: &Vector3<f64>, length_m: f64) -> Result<(), LostTool> {
    check_finite("the place of a point of the tool", sphere.centre_m.iter().copied())?;
    let distance_m = (sphere.centre_m - base).norm();
    if distance_m > MAX_STRETCH * length_m {
        return Err(LostTool::Apart { distance_m, length_m });
    }
    check_finite("the speed of a point of the tool", sphere.velocity_m_per_s.iter().copied())?;
    let speed_m_per_s = sphere.velocity_m_per_s.norm();
    if speed_m_per_s > MAX_SPEED_M_PER_S {
        return Err(LostTool::TooFast { speed_m_per_s });
    }
    Ok(())
}

fn check_finite(what: &'static str, values: impl IntoIterator<Item = f64>) -> Result<(), LostTool> {
    match values.into_iter().find(|value| !value.is_finite()) {
        Some(value) => Err(LostTool::NotFinite { what, value }),
        None => Ok(()),
    }
}
