//! The tool and its contacts as `foxglove.SceneUpdate`, for the 3D panel of Lichtblick and Foxglove.

use std::time::{Duration, Instant};

use ipc_types::messages::{Pose, State};
use ipc_types::scene::{Cutter, OuterTubeSize};
use serde_json::{Value, json};

use crate::board::Board;
use crate::channels::SCENE;
use crate::info::ToolShape;

const PERIOD: Duration = Duration::from_millis(33);
/// Length of a contact's line per newton of force.
const METRES_PER_NEWTON: f64 = 2e-3;

/// Draws the tool at up to 30 Hz, and only if a client subscribes.
#[derive(Debug)]
pub struct Drawer {
    outer_radius_m: f64,
    outer_tube: Option<OuterTubeSize>,
    cutter: Cutter,
    last: Option<Instant>,
}

impl Drawer {
    /// Creates a drawer for this tool.
    pub fn new(tool: &ToolShape) -> Drawer {
        Drawer {
            outer_radius_m: tool.outer_radius_m,
            outer_tube: tool.outer_tube,
            cutter: tool.cutter,
            last: None,
        }
    }

    /// Whether a client subscribes and the last drawing is old enough.
    pub fn is_due(&self, board: &Board) -> bool {
        board.wants(SCENE) && self.last.is_none_or(|last| last.elapsed() >= PERIOD)
    }

    /// Publishes a drawing of the state if one is due.
    pub fn draw(&mut self, state: &State, time_ns: u64, board: &Board) {
        if self.is_due(board) {
            self.last = Some(Instant::now());
            board.publish(SCENE, time_ns, 0, self.update(state, time_ns).into_bytes());
        }
    }

    /// Returns the drawing of a state as JSON.
    pub fn update(&self, state: &State, time_ns: u64) -> String {
        let links = &state.t_world_link[..(state.joint_count as usize).min(state.t_world_link.len())];
        let starts = core::iter::once(&state.t_world_base).chain(links);
        let mut burr_end = state.t_world_burr;
        burr_end.position_m = on_axis(&state.t_world_burr, -self.cutter.span_m());
        let ends = links.iter().chain(core::iter::once(&burr_end));
        let link = |(start, end): (&Pose, &Pose)| cylinder(self.outer_radius_m, start, end.position_m);
        let outer = self.outer_tube.map(|tube| {
            let base = &state.t_world_base;
            cylinder(tube.outer_m, base, on_axis(base, tube.end_m))
        });
        let cylinders: Vec<Value> = starts.zip(ends).map(link).chain(outer).collect();
        let balls = self.cutter.balls().iter();
        let burr: Vec<Value> = balls
            .map(|ball| {
                let centre_m = on_axis(&state.t_world_burr, -ball.behind_m);
                json!({"pose": pose(&state.t_world_burr, centre_m), "size": point([2.0 * ball.radius_m; 3]),
                    "color": colour(0.8, 0.4, 0.0)})
            })
            .collect();
        let contacts = &state.contacts[..(state.contact_count as usize).min(state.contacts.len())];
        let lines: Vec<Value> = contacts
            .iter()
            .map(|contact| {
                let length_m = METRES_PER_NEWTON * contact.normal_force_n;
                let end: [f64; 3] =
                    core::array::from_fn(|axis| contact.point_m[axis] + length_m * contact.normal[axis]);
                json!({"type": 0, "pose": identity(), "thickness": 3.0, "scale_invariant": true,
                    "points": [point(contact.point_m), point(end)], "color": colour(0.8, 0.0, 0.5),
                    "colors": [], "indices": []})
            })
            .collect();
        entity("tool", time_ns, &json!(burr), &json!(cylinders), &json!(lines))
    }
}

/// Returns a point on a pose's z axis.
fn on_axis(pose: &Pose, ahead_m: f64) -> [f64; 3] {
    let [x, y, z, w] = pose.orientation_xyzw;
    let axis = [2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)];
    core::array::from_fn(|i| pose.position_m[i] + ahead_m * axis[i])
}

/// Returns a cylinder along a pose's z axis, from its origin to a point.
fn cylinder(radius_m: f64, start: &Pose, end_m: [f64; 3]) -> Value {
    let from_m = start.position_m;
    let length_m = (0..3).map(|axis| (end_m[axis] - from_m[axis]).powi(2)).sum::<f64>().sqrt();
    let middle = core::array::from_fn(|axis| 0.5 * (from_m[axis] + end_m[axis]));
    let diameter = 2.0 * radius_m;
    json!({"pose": pose(start, middle), "size": point([diameter, diameter, length_m]),
        "bottom_scale": 1.0, "top_scale": 1.0, "color": colour(0.6, 0.65, 0.7)})
}

/// Returns a line through points as a separate drawing, as JSON.
pub fn curve(id: &str, time_ns: u64, points_m: &[[f64; 3]], [r, g, b]: [f64; 3]) -> String {
    let points: Vec<Value> = points_m.iter().map(|place| point(*place)).collect();
    let line = json!({"type": 0, "pose": identity(), "thickness": 2.0, "scale_invariant": true,
        "points": points, "color": colour(r, g, b), "colors": [], "indices": []});
    entity(id, time_ns, &json!([]), &json!([]), &json!([line]))
}

/// Returns a `foxglove.SceneUpdate` with one entity in the world frame.
fn entity(id: &str, time_ns: u64, spheres: &Value, cylinders: &Value, lines: &Value) -> String {
    let stamp = json!({"sec": time_ns / 1_000_000_000, "nsec": time_ns % 1_000_000_000});
    let update = json!({"deletions": [], "entities": [{
        "timestamp": stamp, "frame_id": "world", "id": id, "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": false, "metadata": [], "arrows": [], "cubes": [], "spheres": spheres,
        "cylinders": cylinders, "lines": lines, "triangles": [], "texts": [], "models": [],
    }]});
    update.to_string()
}

fn point([x, y, z]: [f64; 3]) -> Value {
    json!({"x": x, "y": y, "z": z})
}

fn pose(axes: &Pose, position_m: [f64; 3]) -> Value {
    let [x, y, z, w] = axes.orientation_xyzw;
    json!({"position": point(position_m), "orientation": {"x": x, "y": y, "z": z, "w": w}})
}

fn identity() -> Value {
    json!({"position": point([0.0; 3]), "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}})
}

fn colour(r: f64, g: f64, b: f64) -> Value {
    json!({"r": r, "g": g, "b": b, "a": 1.0})
}
