//! Definition of a rigid body.

use nalgebra::{Isometry3, Vector3};

use super::error::RigidError;
use crate::manipulator::Wrench;

/// Convex shape, centred at the body's origin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum BodyShape {
    /// A cuboid.
    Box {
        /// Half extents along the body's x, y and z, m.
        half_extents_m: Vector3<f64>,
    },
    /// A ball.
    Ball {
        /// Radius, m.
        radius_m: f64,
    },
    /// A capsule along the body's z.
    Capsule {
        /// Half of the distance between the centres of its ends, m.
        half_height_m: f64,
        /// Radius, m.
        radius_m: f64,
    },
}

/// Whether a body can move.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BodyMotion {
    /// Stationary, like a clamp.
    Fixed,
    /// Moves under forces, like a bone fragment.
    Free,
    /// Moves as commanded, like a table: nothing that pushes it changes its motion.
    Driven,
}

/// What a controller commands of a body, until its next command.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum BodyDrive {
    /// A wrench on a free body about its centre of mass, world axes.
    Wrench(Wrench),
    /// The pose of a driven body, which it reaches within the tick at up to [`FASTEST_DRIVEN`].
    Pose(Isometry3<f64>),
}

/// Largest speed and angular speed of a driven body, m/s and rad/s; it follows a goal farther away at these.
pub const FASTEST_DRIVEN: [f64; 2] = [1.0, core::f64::consts::PI];

/// Complete definition of a body.
#[derive(Debug, Clone, PartialEq)]
pub struct BodyParameters {
    /// Name, for messages.
    pub name: String,
    /// Shape.
    pub shape: BodyShape,
    /// Initial pose.
    pub t_world_body: Isometry3<f64>,
    /// Fixed, free or driven.
    pub motion: BodyMotion,
    /// Density of a free body, kg/m^3.
    pub density_kg_per_m3: f64,
    /// Coulomb coefficient against other bodies; Rapier takes the mean of the two. The tool's contacts use
    /// the tool's coefficient.
    pub friction: f64,
}

impl BodyParameters {
    /// Checks every value. The error names the first invalid one.
    ///
    /// # Errors
    /// [`RigidError::OutOfRange`].
    pub fn validate(&self) -> Result<(), RigidError> {
        const LENGTH: &str = "1e-5 to 10 m";
        let length = |x: f64| (1e-5..=10.0).contains(&x);
        match self.shape {
            BodyShape::Box { half_extents_m } => {
                for value in half_extents_m.iter() {
                    self.check("half_extents_m", *value, LENGTH, length)?;
                }
            }
            BodyShape::Ball { radius_m } => self.check("radius_m", radius_m, LENGTH, length)?,
            BodyShape::Capsule { half_height_m, radius_m } => {
                self.check("half_height_m", half_height_m, LENGTH, length)?;
                self.check("radius_m", radius_m, LENGTH, length)?;
            }
        }
        for value in self.t_world_body.translation.vector.iter() {
            self.check("t_world_body position", *value, "-1000 to 1000 m", |x| x.abs() <= 1000.0)?;
        }
        let norm = self.t_world_body.rotation.norm();
        self.check("t_world_body rotation norm", norm, "1", |x| (x - 1.0).abs() < 1e-9)?;
        let density = |x: f64| (1.0..=1e6).contains(&x);
        self.check("density_kg_per_m3", self.density_kg_per_m3, "1 to 1e6 kg/m^3", density)?;
        self.check("friction", self.friction, "0 to 10", |x| (0.0..=10.0).contains(&x))
    }

    fn check(
        &self,
        field: &'static str,
        value: f64,
        allowed: &'static str,
        accept: impl Fn(f64) -> bool,
    ) -> Result<(), RigidError> {
        // NaN is in no range, so this rejects it too.
        if accept(value) {
            return Ok(());
        }
        Err(RigidError::OutOfRange { body: self.name.clone(), field, value, allowed })
    }
}
