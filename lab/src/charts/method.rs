//! The methods compared by charts: the product's rungs with their integrators, and the baselines.

use std::panic::{AssertUnwindSafe, catch_unwind};

use nalgebra::Vector3;
use physics_lab::{ProxyDrive, ProxyTool, RapierChain, RapierJoints, Wall, explicit_chain};
use simulation::manipulator::{
    AnyManipulator, BaseMotion, Integrator, ManipulatorError, ManipulatorModel, ManipulatorParameters, Rung,
    SpatialChain, StepInput, TendonCommand, Wrench,
};

/// Contact planes become active below this gap, m, plus the distance that a sphere travels in a step.
const MARGIN_M: f64 = 1e-3;

/// A burr farther from the flange than this counts as lost, m: the tool is 71 mm long.
const MAX_REACH_M: f64 = 10.0;

/// A method of stepping the tool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// A rung of the ladder.
    Rung(Rung, Integrator),
    /// Semi-implicit Euler with springs as forces.
    Explicit,
    /// Rapier.
    Rapier(RapierJoints),
    /// A proxy of the burr instead of contact.
    Proxy(ProxyDrive),
}

impl Method {
    /// The product's methods first. The arc has one integrator; both integrators are compared on planar and
    /// spatial.
    pub const ALL: [Method; 11] = [
        Method::Rung(Rung::ConstantCurvature, Integrator::LinearlyImplicitEuler),
        Method::Rung(Rung::Modal, Integrator::LinearlyImplicitEuler),
        Method::Rung(Rung::Modal, Integrator::Hybrid),
        Method::Rung(Rung::Planar, Integrator::LinearlyImplicitEuler),
        Method::Rung(Rung::Planar, Integrator::Hybrid),
        Method::Rung(Rung::Spatial, Integrator::LinearlyImplicitEuler),
        Method::Rung(Rung::Spatial, Integrator::Hybrid),
        Method::Rung(Rung::Full, Integrator::Hybrid),
        Method::Explicit,
        Method::Rapier(RapierJoints::Multibody),
        Method::Rapier(RapierJoints::Springs),
    ];

    /// The methods of the stability map, which adds contact by proxies.
    pub const WITH_PROXIES: [Method; 13] = {
        let [a, b, c, d, e, f, g, h, i, j, k] = Method::ALL;
        let (position, force) = (Method::Proxy(ProxyDrive::Position), Method::Proxy(ProxyDrive::Force));
        [a, b, c, d, e, f, g, h, i, j, k, position, force]
    };

    /// Returns the name in charts and tables.
    pub fn name(self) -> String {
        match self {
            Method::Rung(Rung::ConstantCurvature, _) => Rung::ConstantCurvature.name().into(),
            Method::Rung(rung, Integrator::LinearlyImplicitEuler) => format!("{} euler", rung.name()),
            Method::Rung(rung, Integrator::Hybrid) => format!("{} hybrid", rung.name()),
            Method::Explicit => "explicit".into(),
            Method::Rapier(RapierJoints::Multibody) => "rapier_multibody".into(),
            Method::Rapier(RapierJoints::Springs) => "rapier_springs".into(),
            Method::Proxy(ProxyDrive::Position) => "proxy position-set".into(),
            Method::Proxy(ProxyDrive::Force) => "proxy force".into(),
        }
    }

    /// Whether the method is the product's.
    pub fn is_ours(self) -> bool {
        matches!(self, Method::Rung(..))
    }
}

enum Model {
    Ours(Box<AnyManipulator>),
    Explicit(Box<SpatialChain<1>>),
    Rapier(Box<RapierChain>),
    Proxy(Box<ProxyTool>),
}

/// A tool in front of walls, stepped by one method.
pub struct Tool {
    model: Model,
    walls: Vec<Wall>,
    planes: Vec<simulation::contact_plane::ContactPlane>,
    lost: bool,
}

/// Input of a step.
#[derive(Debug, Clone, Copy)]
pub struct Drive {
    /// Base pose at the end of the step.
    pub base: BaseMotion,
    /// Tension of tendon 0, N.
    pub tension_n: f64,
    /// Load on the burr.
    pub tip: Wrench,
}

impl Drive {
    /// Returns a stationary base without loads.
    pub fn still(base: BaseMotion) -> Drive {
        Drive { base, tension_n: 0.0, tip: Wrench::zero() }
    }
}

impl Tool {
    /// Creates a straight tool at rest.
    ///
    /// # Errors
    /// Invalid parameters.
    pub fn new(
        method: Method,
        parameters: &ManipulatorParameters,
        base: &BaseMotion,
        walls: &[Wall],
    ) -> Result<Tool, ManipulatorError> {
        let mut parameters = parameters.clone();
        let model = match method {
            Method::Rung(rung, integrator) => {
                parameters.integrator = integrator;
                Model::Ours(Box::new(AnyManipulator::new(rung, parameters, base)?))
            }
            Method::Explicit => Model::Explicit(Box::new(explicit_chain(parameters, base)?)),
            Method::Proxy(drive) => Model::Proxy(Box::new(ProxyTool::new(drive, parameters, base, walls)?)),
            Method::Rapier(joints) => {
                let hz = SpatialChain::<1>::new(parameters.clone(), base)?.first_natural_frequency_hz();
                Model::Rapier(Box::new(RapierChain::new(joints, &parameters, hz, &base.t_world_base, walls)))
            }
        };
        Ok(Tool { model, walls: walls.to_vec(), planes: Vec::with_capacity(256), lost: false })
    }

    /// Steps once. A lost tool (non-finite, or its step was refused) is not stepped any further.
    pub fn step(&mut self, dt_s: f64, drive: &Drive) {
        if self.lost {
            return;
        }
        self.planes.clear();
        let spheres = match &self.model {
            Model::Ours(tool) => tool.proxy_spheres(),
            Model::Explicit(tool) => tool.proxy_spheres(),
            Model::Rapier(_) | Model::Proxy(_) => &[],
        };
        for wall in &self.walls {
            wall.planes(spheres, MARGIN_M, dt_s, &mut self.planes);
        }
        let tendon = TendonCommand::Force([drive.tension_n, 0.0]);
        let input = StepInput { base: drive.base, tendon, tip_wrench: drive.tip, contacts: &self.planes };
        let refused = match &mut self.model {
            Model::Ours(tool) => tool.step(dt_s, &input).is_err(),
            Model::Explicit(tool) => tool.step(dt_s, &input).is_err(),
            Model::Proxy(tool) => tool.step(dt_s, &input).is_err(),
            // Rapier panics on non-finite values; the tool then counts as lost.
            Model::Rapier(tool) => catch_unwind(AssertUnwindSafe(|| tool.step(dt_s, &input))).is_err(),
        };
        let reach_m = (self.tip_m() - drive.base.t_world_base.translation.vector).norm();
        // Written so that NaN counts as lost too.
        let sound = self.energy_j().is_finite() && reach_m <= MAX_REACH_M;
        self.lost = refused || !sound;
    }

    /// Whether the tool is lost.
    pub fn is_lost(&self) -> bool {
        self.lost
    }

    /// Removes all walls.
    pub fn remove_walls(&mut self) {
        self.walls.clear();
        match &mut self.model {
            Model::Rapier(tool) => tool.remove_walls(),
            Model::Proxy(tool) => tool.remove_walls(),
            Model::Ours(_) | Model::Explicit(_) => {}
        }
    }

    /// Burr centre, world frame, m.
    pub fn tip_m(&self) -> Vector3<f64> {
        match &self.model {
            Model::Ours(tool) => tool.t_world_tip().translation.vector,
            Model::Explicit(tool) => tool.t_world_tip().translation.vector,
            Model::Rapier(tool) => tool.tip_m(),
            Model::Proxy(tool) => tool.tool().t_world_tip().translation.vector,
        }
    }

    /// Sum of the bending angles, rad.
    pub fn bend_rad(&self) -> f64 {
        match &self.model {
            Model::Ours(tool) => tool.bend_rad(),
            Model::Explicit(tool) => tool.joint_positions_rad().iter().sum(),
            Model::Rapier(tool) => tool.joint_positions_rad().iter().sum(),
            Model::Proxy(tool) => tool.tool().bend_rad(),
        }
    }

    /// Kinetic and elastic energy, J.
    pub fn energy_j(&self) -> f64 {
        match &self.model {
            Model::Ours(tool) => tool.energy_j(),
            Model::Explicit(tool) => tool.energy_j(),
            Model::Rapier(tool) => tool.energy_j(),
            Model::Proxy(tool) => tool.tool().energy_j(),
        }
    }
}
