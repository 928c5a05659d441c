//! The parts of a scene that make up its tool.

use ipc_types::scene::{Drives, Manipulator, Scene, StartShape, Tendon, ToolOuterTube};
use serde::Serialize;
use simulation::manipulator::{AnyManipulator, BaseMotion, ManipulatorModel, Rung};
use simulation::manipulator_parameters;

use crate::failure::Failure;
use crate::plan::load::tendons_leave_the_plane;
use crate::plan::measure::trials::{PULL_S, Trial};
use crate::plan::table::own_links;

/// Gravity under which every tool is measured, m/s²; more if the scene has more.
const WEIGHT_M_PER_S2: f64 = 9.81;
/// Longest duration of a pull, s.
const LONGEST_PULL_S: f64 = 4.0;
/// Clearance of the pilot hole of a tunnel around the burr, mm in diameter: as for the standard tool.
const PLAY_MM: f64 = 0.5;
/// Smallest roll speed at which a tool in an outer tube is measured.
pub const LEAST_ROLL_DEG_PER_S: f64 = 90.0;
/// A swing has decayed to 5 % after this many time constants.
const TIME_CONSTANTS: f64 = 3.0;

/// The tool of a scene, as far as errors depend on it: the simulated one, whatever the plan assumes
/// (`[truth]`).
#[derive(Debug, Clone, PartialEq)]
pub struct OwnTool {
    /// Its name in messages.
    pub name: String,
    parts: Parts,
}

/// Contents of a tool's hash.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Parts {
    start_shape: StartShape,
    weight_m_per_s2: f64,
    manipulator: Manipulator,
    tendon: Vec<Tendon>,
}

impl OwnTool {
    /// Extracts the tool of a scene, without the settings that a plan chooses.
    pub fn of(scene: &Scene) -> OwnTool {
        let scene = scene.as_it_is();
        let mut manipulator =
            Manipulator { file: None, model: None, links: None, integrator: None, ..scene.manipulator };
        let name = match &mut manipulator.tool {
            Some(tool) => {
                tool.description.clear();
                std::mem::replace(&mut tool.name, "tool".to_owned())
            }
            None => "standard, changed".to_owned(),
        };
        let weight_m_per_s2 =
            scene.gravity_m_per_s2.iter().map(|g| g * g).sum::<f64>().sqrt().max(WEIGHT_M_PER_S2);
        let start_shape = scene.tool.start_shape.unwrap_or_default();
        OwnTool { name, parts: Parts { start_shape, weight_m_per_s2, manipulator, tendon: scene.tendon } }
    }

    /// The tube that it slides out of, if any.
    pub fn outer_tube(&self) -> Option<&ToolOuterTube> {
        self.parts.manipulator.outer_tube()
    }

    /// Everything its errors depend on, as text: tools with the same text have the same errors.
    ///
    /// # Errors
    /// It cannot be written as TOML, which has not happened for any tool read from TOML.
    pub fn text(&self) -> Result<String, Failure> {
        toml::to_string(&self.parts)
            .map_err(|cause| Failure::failed(format!("tool `{}`: {cause}", self.name)))
    }

    /// Number of its tendons that commands address.
    pub fn tendons(&self) -> usize {
        match (&self.parts.tendon[..], &self.parts.manipulator.tool) {
            ([], None) => 2,
            ([], Some(tool)) => tool.tendon.len(),
            (tendons, _) => tendons.len(),
        }
    }

    /// Whether a tendon bends it out of its plane.
    pub fn bends_across(&self) -> bool {
        tendons_leave_the_plane(&self.parts.tendon, self.parts.manipulator.tool.as_ref())
    }

    /// Whether it is bent without load.
    pub fn is_pre_curved(&self) -> bool {
        let tool = self.parts.manipulator.tool.as_ref();
        tool.is_some_and(|tool| tool.flexure.iter().any(|flexure| flexure.rest_deg != 0.0))
    }

    /// Gravity under which it is measured, m/s².
    pub fn weight_m_per_s2(&self) -> f64 {
        self.parts.weight_m_per_s2
    }

    /// Radius of the ball at its front, mm.
    pub fn burr_radius_mm(&self) -> f64 {
        let radii = self.parts.manipulator.radii();
        radii.cutter.balls().first().map_or(0.0, |ball| 1e3 * ball.radius_m)
    }

    /// Diameter of a hole that it fits in, mm.
    pub fn hole_mm(&self) -> f64 {
        let radii = self.parts.manipulator.radii();
        let widest_m =
            radii.cutter.balls().iter().map(|ball| ball.radius_m).fold(radii.widest_tube_m(), f64::max);
        2e3 * widest_m + PLAY_MM
    }

    /// Builds a trial with this tool: in free space as in the scene, in bone straight in its pilot hole, as
    /// at the start of a tunnel.
    ///
    /// # Errors
    /// A parameter of the trial is out of range.
    pub fn scene(&self, trial: &Trial, is_in_bone: bool) -> Result<Scene, Failure> {
        let (mut scene, _) = trial.scene("", is_in_bone)?;
        self.put_into(&mut scene);
        if let Some(deployment) = &trial.deployment {
            for entry in &mut scene.controller {
                (entry.external, entry.tube_deployment) = (false, Some(deployment.clone()));
                entry.drives.push(Drives::Tube);
            }
            // A slow drive would take too long to measure; a faster one is the harder trial.
            if let Some(outer) = scene.manipulator.tool.as_mut().and_then(|tool| tool.outer_tube.as_mut()) {
                outer.speed_mm_per_s = outer.speed_mm_per_s.max(deployment.feed_mm_per_s);
                outer.roll_speed_deg_per_s = outer.roll_speed_deg_per_s.max(LEAST_ROLL_DEG_PER_S);
            }
        }
        if is_in_bone {
            scene.tool.start_shape = Some(StartShape::Straight);
            scene.predrill.iter_mut().for_each(|hole| hole.diameter_mm = self.hole_mm());
        }
        Ok(scene)
    }

    /// Replaces the tool of a scene.
    pub fn put_into(&self, scene: &mut Scene) {
        scene.manipulator = self.parts.manipulator.clone();
        if let Some(tool) = &mut scene.manipulator.tool {
            tool.name.clone_from(&self.name);
        }
        scene.tendon.clone_from(&self.parts.tendon);
        scene.tool.start_shape = Some(self.parts.start_shape);
    }

    /// Duration of a pull: until the slowest swing has decayed, but at least as long as the standard tool's.
    ///
    /// # Errors
    /// Bad input: the reference refuses the tool.
    pub fn pull_s(&self) -> Result<f64, Failure> {
        let scene = self.scene(&Trial::hold(0.0, 0.0), false)?;
        let refused = |cause| Failure::bad_input(format!("tool `{}`: manipulator: {cause}", self.name));
        let parameters = manipulator_parameters(&scene).map_err(refused)?;
        let damping_ratio = parameters.damping_ratio;
        let base = BaseMotion::at_rest(nalgebra::Isometry3::identity());
        let tool = AnyManipulator::new(Rung::Full, parameters, &base).map_err(refused)?;
        let rate_per_s = damping_ratio * core::f64::consts::TAU * tool.first_natural_frequency_hz();
        Ok((TIME_CONSTANTS / rate_per_s).clamp(PULL_S, LONGEST_PULL_S))
    }

    /// Number of its flexures.
    ///
    /// # Errors
    /// A trial cannot be built.
    pub fn flexures(&self) -> Result<usize, Failure> {
        Ok(own_links(&self.scene(&Trial::hold(0.0, 0.0), false)?))
    }
}
