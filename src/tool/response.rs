//! Response of the tool: its equilibria under each tendon, its bending modes, and the step time of each model
//! rung.

use std::time::Instant;

use ipc_types::scene::Scene;
use nalgebra::Isometry3;
use serde::Serialize;
use simulation::manipulator::{
    AnyManipulator, BaseMotion, MAX_TENDONS, ManipulatorModel, ManipulatorParameters, Rung, StepInput,
    TendonCommand, Wrench,
};
use simulation::{manipulator_parameters, rung};

use crate::failure::Failure;

/// Tensions shown, N.
const TENSIONS_N: [f64; 3] = [2.0, 5.0, 10.0];
/// Further tensions for the workspace, N; the last is the maximum of a command.
const HARD_N: [f64; 3] = [20.0, 40.0, 60.0];
/// Tension of two tendons together, N.
const PAIR_N: f64 = 20.0;
/// Number of bending modes shown.
const MODES: usize = 3;
/// Deployed lengths shown, as fractions of the outer tube's travel.
const DEPLOYED_SHARES: [f64; 5] = [0.0, 0.25, 0.5, 0.75, 1.0];
/// The tool has settled when no flexure turns faster, rad/s; it then moves less than a nanometre per step of
/// 1 ms.
const SETTLED_RAD_PER_S: f64 = 1e-6;
/// Maximum number of 1 ms steps for a critically damped tool to settle.
const MOST_STEPS: usize = 5000;
const STEP_S: f64 = 1e-3;
/// Number of steps timed for each rung.
const TIMED_STEPS: usize = 500;

/// The tool in equilibrium, in its base frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Shape {
    /// Index of the pulled tendon; absent if no tendon is pulled.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tendon: Option<usize>,
    /// Tension of the tendon.
    pub tension_n: f64,
    /// Length of the tool outside its outer tube; absent without an outer tube.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deployed_mm: Option<f64>,
    /// Bend of the whole tool toward `tool.bend_toward`.
    pub bend_deg: f64,
    /// Position of the burr's centre toward `tool.bend_toward`.
    pub toward_mm: f64,
    /// Across that direction.
    pub across_mm: f64,
    /// Along the straight tool, from the flange.
    pub along_mm: f64,
    /// Number of flexures at their stops.
    pub stopped: usize,
    /// Whether the tool has settled; otherwise this is its last shape, whose numbers may have overflowed.
    pub settled: bool,
}

/// Cost of a step of a model rung.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Cost {
    /// Name of the rung.
    pub rung: &'static str,
    /// Median time of a step in free space on this machine, µs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub step_us: Option<f64>,
    /// Why the rung cannot represent the tool.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
}

/// Limits of the tool's reach in free space: with each tendon alone, with every pair at equal tension, or
/// deployed from its outer tube at any roll.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Workspace {
    /// The burr's centre toward `tool.bend_toward`.
    pub toward_mm: [f64; 2],
    /// Across that direction.
    pub across_mm: [f64; 2],
    /// Along the straight tool, from the flange.
    pub along_mm: [f64; 2],
    /// Bend of the whole tool.
    pub bend_deg: [f64; 2],
}

impl Workspace {
    /// Computes the workspace of the settled shapes; a tool in an outer tube can roll by any angle.
    fn of(shapes: &[Shape]) -> Workspace {
        let turns = shapes.iter().any(|shape| shape.deployed_mm.is_some());
        let ends = |of: &dyn Fn(&Shape) -> f64| {
            let settled = shapes.iter().filter(|shape| shape.settled).map(of);
            settled.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], x| [low.min(x), high.max(x)])
        };
        let aside = |shape: &Shape| shape.toward_mm.hypot(shape.across_mm);
        let [_, farthest] = ends(&aside);
        let sides = |of: &dyn Fn(&Shape) -> f64| if turns { [-farthest, farthest] } else { ends(of) };
        Workspace {
            toward_mm: sides(&|shape| shape.toward_mm),
            across_mm: sides(&|shape| shape.across_mm),
            along_mm: ends(&|shape| shape.along_mm),
            bend_deg: ends(&|shape| shape.bend_deg),
        }
    }
}

/// Response of a scene's tool.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Response {
    /// Shapes without load, then under each tendon alone.
    pub shapes: Vec<Shape>,
    /// Reach of the burr's centre and of the bend over all shapes measured.
    pub workspace: Workspace,
    /// First bending mode on a rigid mount while the tool is straight, Hz.
    pub first_frequency_hz: f64,
    /// First three bending modes, Hz.
    pub bending_frequencies_hz: Vec<f64>,
    /// Euler's buckling load of the straight tool, clamped at its base, N.
    pub buckling_load_n: f64,
    /// Costs of all rungs, cheapest first.
    pub costs: Vec<Cost>,
}

/// Measures the tool of a scene in free space, with the scene's rung or the first that can represent it.
///
/// # Errors
/// Bad input: an invalid tool, or the scene's rung cannot represent it.
pub fn response(scene: &Scene) -> Result<Response, Failure> {
    let parameters = manipulator_parameters(scene).map_err(Failure::bad_input)?;
    let by_default = rung(scene.manipulator.model.unwrap_or_default());
    let represents = |rung: &Rung| built(*rung, &parameters).is_ok();
    let own = match scene.manipulator.model {
        Some(_) => by_default,
        None => [by_default, Rung::Spatial].into_iter().find(represents).unwrap_or(by_default),
    };
    let tool = new(own, &parameters).map_err(Failure::bad_input)?;
    let outer = scene.manipulator.outer_tube();
    let mut shapes = match outer {
        None => vec![shape(own, &parameters, None, 0.0)?],
        Some(outer) => DEPLOYED_SHARES
            .into_iter()
            .map(|share| shape_deployed(own, &parameters, share * outer.travel_mm))
            .collect::<Result<_, _>>()?,
    };
    for tendon in 0..parameters.tendon_count() {
        for tension_n in TENSIONS_N {
            shapes.push(shape(own, &parameters, Some(tendon), tension_n)?);
        }
    }
    let mut reached = shapes.clone();
    for tendon in 0..parameters.tendon_count() {
        for tension_n in HARD_N {
            reached.push(shape(own, &parameters, Some(tendon), tension_n)?);
        }
        for other in 0..tendon {
            reached.push(settled(own, &parameters, pulled(&[other, tendon], PAIR_N), None)?);
        }
    }
    let costs = Rung::ALL.map(|rung| cost(rung, &parameters)).to_vec();
    Ok(Response {
        shapes,
        workspace: Workspace::of(&reached),
        first_frequency_hz: tool.first_natural_frequency_hz(),
        bending_frequencies_hz: parameters.bending_frequencies_hz(MODES),
        buckling_load_n: parameters.euler_load_n(),
        costs,
    })
}

type Built = Result<AnyManipulator, simulation::manipulator::ManipulatorError>;

fn new(rung: Rung, parameters: &ManipulatorParameters) -> Built {
    AnyManipulator::new(rung, parameters.clone(), &BaseMotion::at_rest(Isometry3::identity()))
}

/// Builds a model of a tool in its rest shape.
pub fn built(rung: Rung, parameters: &ManipulatorParameters) -> Result<AnyManipulator, String> {
    let tool = new(rung, parameters).map_err(|cause| cause.to_string())?;
    let mut routes = parameters.tendon_routes.iter().flatten();
    if rung < Rung::Spatial && routes.any(|route| route.channel_m[1] != 0.0) {
        return Err("a tendon bends it out of the plane".to_owned());
    }
    Ok(tool)
}

fn pulled(tendons: &[usize], tension_n: f64) -> StepInput<'static> {
    let mut each = [0.0; MAX_TENDONS];
    let pulled = each.iter_mut().enumerate().filter(|(tendon, _)| tendons.contains(tendon));
    pulled.for_each(|(_, place)| *place = tension_n);
    StepInput {
        base: BaseMotion::at_rest(Isometry3::identity()),
        tendon: TendonCommand::EachForce(each),
        tip_wrench: Wrench::zero(),
        contacts: &[],
    }
}

fn shape(
    rung: Rung,
    parameters: &ManipulatorParameters,
    tendon: Option<usize>,
    tension_n: f64,
) -> Result<Shape, Failure> {
    settled(rung, parameters, pulled(tendon.as_slice(), tension_n), None).map(|shape| Shape {
        tendon,
        tension_n,
        ..shape
    })
}

/// Returns the shape without load at a deployed length, relative to the outer tube's base.
fn shape_deployed(
    rung: Rung,
    parameters: &ManipulatorParameters,
    deployed_mm: f64,
) -> Result<Shape, Failure> {
    let shape = settled(rung, parameters, pulled(&[], 0.0), Some(deployed_mm))?;
    Ok(Shape { along_mm: shape.along_mm + deployed_mm, ..shape })
}

fn settled(
    rung: Rung,
    parameters: &ManipulatorParameters,
    input: StepInput,
    deployed_mm: Option<f64>,
) -> Result<Shape, Failure> {
    let damped = ManipulatorParameters { damping_ratio: 1.0, ..parameters.clone() };
    let mut tool = new(rung, &damped).map_err(Failure::bad_input)?;
    tool.set_deployed(1e-3 * deployed_mm.unwrap_or(0.0));
    let mut settled = false;
    for _ in 0..MOST_STEPS {
        tool.step(STEP_S, &input).map_err(Failure::failed)?;
        settled = tool.joint_velocities_rad_per_s().iter().all(|rate| rate.abs() < SETTLED_RAD_PER_S);
        if settled {
            break;
        }
    }
    let burr_m = tool.t_world_tip().translation.vector;
    Ok(Shape {
        tendon: None,
        tension_n: 0.0,
        deployed_mm,
        bend_deg: tool.bend_rad().to_degrees(),
        toward_mm: 1e3 * burr_m.x,
        across_mm: 1e3 * burr_m.y,
        along_mm: 1e3 * burr_m.z,
        stopped: tool.last_report().stopped_joint_count,
        settled,
    })
}

fn cost(rung: Rung, parameters: &ManipulatorParameters) -> Cost {
    let refused = |why: String| Cost { rung: rung.name(), step_us: None, refused: Some(why) };
    let mut tool = match built(rung, parameters) {
        Ok(tool) => tool,
        Err(why) => return refused(why),
    };
    let mut times_us = Vec::with_capacity(TIMED_STEPS);
    for step in 0..TIMED_STEPS {
        // Vary the tension so that the tool moves.
        let input = pulled(&[0], if step / 100 % 2 == 0 { 3.0 } else { 0.0 });
        let start = Instant::now();
        if let Err(why) = tool.step(STEP_S, &input) {
            return refused(why.to_string());
        }
        times_us.push(1e6 * start.elapsed().as_secs_f64());
    }
    times_us.sort_by(f64::total_cmp);
    Cost { rung: rung.name(), step_us: Some(times_us[TIMED_STEPS / 2]), refused: None }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use std::path::Path;

    use ipc_types::scene::{ManipulatorRung, ToolDescription};
    use test_support::scenes::LIMP_TOOL;

    use super::*;
    use crate::scenes::BuiltIn;

    /// Regression: overflowed numbers were printed as a shape without a note. Tension of newtons on flexures
    /// of a micronewton metre.
    #[test]
    fn a_tool_that_does_not_settle_is_said_not_to() {
        let mut scene = BuiltIn::FreeSpace.scene().unwrap();
        let settled = |scene: &Scene| -> Vec<bool> {
            response(scene).unwrap().shapes.iter().map(|shape| shape.settled).collect()
        };
        assert!(settled(&scene).iter().all(|settled| *settled), "the standard tool");
        // The other models hold every flexure at its stop.
        scene.manipulator.model = Some(ManipulatorRung::Modal);
        scene.manipulator.tool = Some(ToolDescription::parse(LIMP_TOOL, Path::new("limp.toml")).unwrap());
        let settled = settled(&scene);
        assert!(settled[0] && settled.contains(&false), "{settled:?}");
    }
}
