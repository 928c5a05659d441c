//! Geometry drawn into the CT.

use ipc_types::messages::State;
use ipc_types::scene::{Scene, planned_path_mm};
use nalgebra::Vector3;
use simulation::manipulator::ManipulatorParameters;
use simulation::manipulator_parameters;

use crate::failure::Failure;
use crate::prediction::Prediction;

/// Length of the line ahead that is used if no controller drills, mm.
const AHEAD_MM: f64 = 30.0;
/// Distance between points of a tool's centre line, in its radii.
const STEP_RADII: f64 = 1.0 / 3.0;
/// Its lower bound, as a share of the tool's length.
const STEP_SHARE: f64 = 1.0 / 300.0;

/// A capsule: all points within a radius of a polyline.
#[derive(Debug, Clone, PartialEq)]
pub struct Tube {
    pub line_mm: Vec<Vector3<f64>>,
    pub radius_mm: f64,
}

impl Tube {
    /// Returns whether a point is inside.
    pub fn holds(&self, point_mm: &Vector3<f64>) -> bool {
        let most = self.radius_mm * self.radius_mm;
        match self.line_mm.as_slice() {
            [one] => (point_mm - one).norm_squared() <= most,
            line => line.windows(2).any(|piece| from_piece(point_mm, &piece[0], &piece[1]) <= most),
        }
    }
}

/// Returns the squared distance from a segment.
fn from_piece(point: &Vector3<f64>, from: &Vector3<f64>, to: &Vector3<f64>) -> f64 {
    let way = to - from;
    let share = ((point - from).dot(&way) / way.norm_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
    (point - from - way * share).norm_squared()
}

/// A hole between flat ends, as the physics drills it before the run.
#[derive(Debug, Clone, PartialEq)]
pub struct Hole {
    from_mm: Vector3<f64>,
    to_mm: Vector3<f64>,
    radius_mm: f64,
}

impl Hole {
    /// Returns whether a point is inside.
    pub fn holds(&self, point_mm: &Vector3<f64>) -> bool {
        let way = self.to_mm - self.from_mm;
        let share = (point_mm - self.from_mm).dot(&way) / way.norm_squared().max(f64::MIN_POSITIVE);
        (0.0..=1.0).contains(&share)
            && (point_mm - self.from_mm - way * share).norm_squared() <= self.radius_mm * self.radius_mm
    }
}

/// The tool in a pose: its tube and its burr.
#[derive(Debug, Clone, PartialEq)]
pub struct ToolShape {
    /// From the base to the burr's centre.
    pub tube: Tube,
    /// The fixed outer tube that it slides out of.
    pub outer: Option<Tube>,
    /// The burr's balls, from front to back.
    pub burr: Vec<Tube>,
}

impl ToolShape {
    /// Places the tool along a line, with its base at `base_mm`.
    fn of(
        tool: &ManipulatorParameters,
        mut line_mm: Vec<Vector3<f64>>,
        (base_mm, ahead): (&Vector3<f64>, &Vector3<f64>),
    ) -> ToolShape {
        let outer = tool.outer_tube.map(|outer| Tube {
            line_mm: vec![*base_mm, base_mm + ahead * (1e3 * outer.end_m)],
            radius_mm: 1e3 * outer.outer_radius_m,
        });
        let end_mm = line_mm.last().copied().unwrap_or_default();
        let before = line_mm.iter().rev().find(|point| (end_mm - **point).norm() > 1e-6);
        let along = before.map_or_else(Vector3::zeros, |before| (end_mm - before).normalize());
        let behind_mm = |behind_m: f64| end_mm - along * (1e3 * behind_m);
        let burr = tool
            .cutter
            .balls()
            .iter()
            .map(|ball| Tube { line_mm: vec![behind_mm(ball.behind_m)], radius_mm: 1e3 * ball.radius_m });
        let burr = burr.collect();
        let span_mm = 1e3 * tool.cutter.span_m();
        if span_mm > 0.0 {
            line_mm.retain(|point| (end_mm - point).dot(&along) > span_mm);
            line_mm.push(behind_mm(tool.cutter.span_m()));
        }
        ToolShape { tube: Tube { line_mm, radius_mm: 1e3 * tool.tube_radii_m[0] }, outer, burr }
    }

    /// Returns whether a point is inside.
    pub fn holds(&self, point_mm: &Vector3<f64>) -> bool {
        let tubes = self.burr.iter().chain(&self.outer).chain([&self.tube]);
        tubes.into_iter().any(|tube| tube.holds(point_mm))
    }
}

/// All geometry of a scene in the CT.
#[derive(Debug, Clone)]
pub struct Shapes {
    pub holes: Vec<Hole>,
    /// Planned path of the burr's centre from the start of its pilot hole; a line ahead if no controller
    /// drills.
    pub path_mm: Vec<Vector3<f64>>,
    /// Whether a controller drills along the path.
    pub is_planned: bool,
    /// The burr's centre at the start.
    pub start_mm: Vector3<f64>,
    /// Direction of the feed.
    pub along: Vector3<f64>,
    /// Bend direction of the tool, perpendicular to the feed.
    pub toward: Vector3<f64>,
    pub at_start: ToolShape,
    /// The tool with its burr at the end of the path, drawn along the path.
    pub at_end: ToolShape,
    /// Predicted path of the burr's centre, and the tool at its deepest.
    pub predicted: Option<(Vec<Vector3<f64>>, ToolShape)>,
    /// Length of the path from the start.
    pub insertion_mm: f64,
    /// From the tool's base to the burr's centre.
    pub tool_mm: f64,
}

impl Shapes {
    /// Builds the shapes of a scene and of its predicted run.
    pub fn of(scene: &Scene, prediction: Option<&Prediction>) -> Result<Shapes, Failure> {
        let tool = manipulator_parameters(scene).map_err(Failure::bad_input)?;
        let tool_mm = 1e3 * tool.burr_centre_m();
        let start_mm = Vector3::from(scene.tool.burr_start_mm);
        let along = Vector3::from(scene.tool.direction).normalize();
        let bend = Vector3::from(scene.tool.bend_toward);
        let toward = (bend - along * bend.dot(&along)).normalize();
        let planned = planned_path_mm(scene);
        let is_planned = planned.is_some();
        let path_mm: Vec<Vector3<f64>> = match planned {
            Some(path) => path.into_iter().map(Vector3::from).collect(),
            None => (0..=120).map(|step| start_mm + along * (AHEAD_MM * f64::from(step) / 120.0)).collect(),
        };
        let ahead = path_behind(&path_mm, &start_mm);
        let insertion_mm = length(&ahead);
        let base_mm = start_mm - along * tool_mm;
        let step_mm = (1e3 * tool.tube_radii_m[0] * STEP_RADII).max(tool_mm * STEP_SHARE);
        let shape = |line_mm: Vec<Vector3<f64>>| ToolShape::of(&tool, line_mm, (&base_mm, &along));
        // From the base of the tool at the start through the burr, then along the path.
        let mut way = vec![base_mm];
        way.extend(&ahead);
        Ok(Shapes {
            holes: scene.predrill.iter().map(hole).collect(),
            is_planned,
            start_mm,
            along,
            toward,
            at_start: shape(vec![base_mm, start_mm]),
            at_end: shape(last_of(&way, tool_mm, step_mm)),
            predicted: prediction.and_then(|prediction| {
                let state = prediction.course.deepest.as_ref()?;
                let path = prediction.path_m.iter().map(|point_m| Vector3::from(*point_m) * 1e3);
                Some((path.collect(), shape(line_mm(state))))
            }),
            path_mm,
            insertion_mm,
            tool_mm,
        })
    }

    /// Returns the end of the path.
    pub fn target_mm(&self) -> Vector3<f64> {
        self.path_mm.last().copied().unwrap_or(self.start_mm)
    }

    /// Returns the direction of the path at its end.
    pub fn last_direction(&self) -> Vector3<f64> {
        let end = self.target_mm();
        let before = self.path_mm.iter().rev().find(|point| (end - **point).norm() > 1e-6);
        before.map_or(self.along, |before| (end - before).normalize())
    }
}

/// Returns the tool's centre line in a state, from its base to the burr's centre.
fn line_mm(state: &State) -> Vec<Vector3<f64>> {
    let links = state.t_world_link.iter().take(state.joint_count as usize);
    let poses = [&state.t_world_base].into_iter().chain(links).chain([&state.t_world_burr]);
    poses.map(|pose| Vector3::from(pose.position_m) * 1e3).collect()
}

fn hole(hole: &ipc_types::scene::Predrill) -> Hole {
    let [from_mm, to_mm] = [hole.from_mm, hole.to_mm].map(Vector3::from);
    Hole { from_mm, to_mm, radius_mm: 0.5 * hole.diameter_mm }
}

/// Returns the path from the point nearest to the start.
fn path_behind(path: &[Vector3<f64>], start: &Vector3<f64>) -> Vec<Vector3<f64>> {
    let from = |point: &Vector3<f64>| (point - start).norm_squared();
    let nearest = (0..path.len()).min_by(|a, b| from(&path[*a]).total_cmp(&from(&path[*b]))).unwrap_or(0);
    path[nearest..].to_vec()
}

/// Returns the length of a polyline.
pub fn length(line: &[Vector3<f64>]) -> f64 {
    line.windows(2).map(|piece| (piece[1] - piece[0]).norm()).sum()
}

/// Returns the last part of a polyline with this length, resampled at this step.
fn last_of(line: &[Vector3<f64>], wanted_mm: f64, step_mm: f64) -> Vec<Vector3<f64>> {
    let mut points: Vec<Vector3<f64>> = Vec::new();
    let (mut left_mm, mut due_mm) = (wanted_mm, 0.0);
    for piece in line.windows(2).rev() {
        let (to, way) = (piece[1], piece[0] - piece[1]);
        let piece_mm = way.norm();
        let mut at_mm = due_mm;
        while at_mm <= piece_mm.min(left_mm) {
            points.push(to + way * (at_mm / piece_mm.max(f64::MIN_POSITIVE)));
            at_mm += step_mm;
        }
        due_mm = at_mm - piece_mm;
        if left_mm <= piece_mm {
            points.push(to + way * (left_mm / piece_mm.max(f64::MIN_POSITIVE)));
            break;
        }
        left_mm -= piece_mm;
    }
    points.reverse();
    points
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_part_of_a_line_has_its_length_round_every_corner() {
        let line = [[0.0, 0.0, 0.0], [10.3, 0.0, 0.0], [10.3, 5.2, 0.0]].map(Vector3::from);
        let part = last_of(&line, 8.0, 1.0);
        assert!((part.last().unwrap() - line[2]).norm() < 1e-12);
        assert!((part[0] - Vector3::new(7.5, 0.0, 0.0)).norm() < 1e-9, "{}", part[0]);
        // A corner is cut by less than a step.
        assert!((length(&part) - 8.0).abs() < 1.0, "{}", length(&part));
        assert!(last_of(&line, 100.0, 1.0).len() > 15, "a line that is too short is taken whole");
    }

    #[test]
    fn a_tube_has_round_ends_and_a_hole_flat_ones() {
        let (from, to) = (Vector3::zeros(), Vector3::new(0.0, 0.0, 10.0));
        let tube = Tube { line_mm: vec![from, to], radius_mm: 3.0 };
        let hole = Hole { from_mm: from, to_mm: to, radius_mm: 3.0 };
        for (point, in_tube, in_hole) in [
            ([2.9, 0.0, 5.0], true, true),
            ([3.1, 0.0, 5.0], false, false),
            ([0.0, 0.0, 12.0], true, false),
            ([0.0, 0.0, -3.1], false, false),
        ] {
            let point = Vector3::from(point);
            assert_eq!((tube.holds(&point), hole.holds(&point)), (in_tube, in_hole), "{point}");
        }
    }
}
