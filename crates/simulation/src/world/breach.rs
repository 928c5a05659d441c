//! Detects where the burr or the tube leaves the bone elsewhere than through the hole that it came by.
//!
//! Along the tool, from its base to the burr, a tool in its own hole is first outside of the bone and then
//! inside. Where it is outside again, it has breached the bone. This is checked along lines on a cylinder of
//! the burr's radius around the tool's centre line, and on the centre line itself, so that a hole that enters
//! at a slant is no breach: each line enters the bone once. A line must have passed the burr's radius in bone
//! before, which the roughness of a surface does not give it. The outside is that of the CT
//! ([`crate::bone::Outside`]); a pilot hole is part of the bone.
//!
//! A check takes one line for the tube, and those on which the burr reaches the outside.

use core::f64::consts::{FRAC_1_SQRT_2, TAU};

use messages::Breach;
use nalgebra::Vector3;

use super::{Simulation, pose};
use crate::bone::Outside;
use crate::manipulator::{ManipulatorModel, SphereKind};

/// Lines on the cylinder, besides the centre line.
const SIDES: usize = 8;
/// Ticks between checks.
const TICKS_PER_CHECK: u64 = 8;
/// Ticks without a breach after which another one is reported.
const REST_TICKS: u64 = 1000;

/// A part of the tool that can leave the bone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Part {
    Tube = 0,
    Burr = 1,
}

impl Part {
    fn name(self) -> &'static str {
        match self {
            Part::Tube => "tube",
            Part::Burr => "burr",
        }
    }
}

/// Which parts have left the bone, and the one that left it in the last tick.
#[derive(Debug, Default)]
pub(super) struct BreachWatch {
    /// Until which tick each part counts as outside.
    out_until: [Option<u64>; 2],
    breach: Option<Breach>,
}

impl BreachWatch {
    /// Returns the breach found in the last tick.
    pub(super) fn breach(&self) -> Option<&Breach> {
        self.breach.as_ref()
    }
}

/// A place, m, with its direction from the tool's axis.
type Place = (Vector3<f64>, Vector3<f64>);
/// The places, one for each part, at which a line is outside after it was inside, nearest the tip.
type Exits = [Option<Place>; 2];

/// A walk along a line from the base to the tip.
struct Walk<'a> {
    outside: &'a Outside,
    /// Length in bone after which the outside is a breach.
    least_m: f64,
    inside_from_m: Option<f64>,
    exits: Exits,
}

impl Walk<'_> {
    fn visit(&mut self, part: Part, (place_m, direction): Place, along_m: f64) {
        if !self.outside.holds(&place_m) {
            self.inside_from_m.get_or_insert(along_m);
        } else if self.inside_from_m.is_some_and(|from_m| along_m - from_m >= self.least_m) {
            self.exits[part as usize] = Some((place_m, direction));
        }
    }
}

impl Simulation<'_> {
    /// Checks whether a part has left the bone if a check is due. Changes no state.
    pub(super) fn watch_breach(&mut self) {
        self.breach_watch.breach = None;
        if !self.state.tick.is_multiple_of(TICKS_PER_CHECK) {
            return;
        }
        let Some(outside) = self.bone.as_ref().map(|bone| &bone.outside) else { return };
        let turn = (self.state.tick / TICKS_PER_CHECK) as usize % (SIDES + 1);
        let tube = self.exits(outside, turn)[Part::Tube as usize];
        let burr = (0..=SIDES)
            .filter(|line| {
                let mut points = self.burr_points(*line).into_iter().flatten();
                points.any(|((place_m, _), _)| outside.holds(&place_m))
            })
            .find_map(|line| self.exits(outside, line)[Part::Burr as usize]);
        for (part, exit) in [(Part::Burr, burr), (Part::Tube, tube)] {
            self.note_exit(part, exit);
        }
    }

    fn note_exit(&mut self, part: Part, exit: Option<Place>) {
        let (tick, watch) = (self.state.tick, &mut self.breach_watch);
        let until = &mut watch.out_until[part as usize];
        let Some((place_m, direction)) = exit else { return };
        if until.is_none_or(|until| tick >= until) {
            if watch.breach.is_some() {
                // One report a tick; this part's follows with the next check.
                return;
            }
            let (place_m, direction) = (place_m.into(), direction.into());
            watch.breach = Some(Breach { part: part.name(), place_m, direction });
        }
        *until = Some(tick + REST_TICKS);
    }

    /// Resets the detector from the present state alone, as after a keyframe.
    pub(super) fn note_breach(&mut self) {
        self.breach_watch = BreachWatch::default();
        let Some(outside) = self.bone.as_ref().map(|bone| &bone.outside) else { return };
        let mut is_out = [false; 2];
        for line in 0..=SIDES {
            let exits = self.exits(outside, line);
            is_out = [0, 1].map(|part| is_out[part] || exits[part].is_some());
        }
        let until = self.state.tick + REST_TICKS;
        self.breach_watch.out_until = is_out.map(|is_out| is_out.then_some(until));
    }

    /// Returns the places at which a line along the tool is outside after it was inside.
    fn exits(&self, outside: &Outside, line: usize) -> Exits {
        let tool = &self.manipulator;
        let radius_m = self.tunnel_radius_m();
        let mut walk = Walk { outside, least_m: 0.99 * radius_m, inside_from_m: None, exits: [None; 2] };
        let side = |orientation_xyzw: [f64; 4]| turned(orientation_xyzw, side(line));
        let base = pose(&tool.t_world_link(0));
        let (mut last_m, mut along_m) = (Vector3::from(base.position_m), 0.0);
        let shaft = side(base.orientation_xyzw);
        walk.visit(Part::Tube, (last_m + radius_m * shaft, shaft), along_m);
        for sphere in tool.proxy_spheres() {
            let direction = match sphere.kind {
                SphereKind::Shaft => shaft,
                SphereKind::Segment(index) => side(self.state.t_world_link[index].orientation_xyzw),
                SphereKind::Burr => continue,
            };
            along_m += (sphere.centre_m - last_m).norm();
            last_m = sphere.centre_m;
            walk.visit(Part::Tube, (last_m + radius_m * direction, direction), along_m);
        }
        let centre_m = Vector3::from(self.state.t_world_burr.position_m);
        along_m += (centre_m - last_m).norm();
        if line == SIDES {
            walk.visit(Part::Burr, (centre_m, Vector3::zeros()), along_m);
        }
        for (place, beyond_m) in self.burr_points(line).into_iter().flatten() {
            walk.visit(Part::Burr, place, along_m + beyond_m);
        }
        walk.exits
    }

    /// Returns the radius of the hole that the burr drills, m, or that of the tube where it is wider.
    fn tunnel_radius_m(&self) -> f64 {
        let tool = self.manipulator.parameters();
        tool.cutter.widest_radius_m().max(tool.widest_tube_m())
    }

    /// Returns the burr's points on a line with their directions from its centre, and how far they are ahead
    /// of it: its front on the centre line, and on the others the points beside the centre and between there
    /// and the front.
    fn burr_points(&self, line: usize) -> [Option<(Place, f64)>; 2] {
        let burr = &self.state.t_world_burr;
        let (centre_m, ahead) = (Vector3::from(burr.position_m), turned(burr.orientation_xyzw, Vector3::z()));
        let cutter = &self.manipulator.parameters().cutter;
        if line == SIDES {
            let front_m = cutter.front_radius_m();
            return [Some(((centre_m + front_m * ahead, ahead), front_m)), None];
        }
        let radius_m = cutter.widest_radius_m();
        let beside = turned(burr.orientation_xyzw, side(line));
        let halfway = FRAC_1_SQRT_2 * (beside + ahead);
        let front_m = cutter.front_radius_m();
        [
            Some(((centre_m + radius_m * beside, beside), 0.0)),
            Some(((centre_m + front_m * halfway, halfway), FRAC_1_SQRT_2 * front_m)),
        ]
    }
}

/// Returns the unit vector from the tool's axis to a line, in the frame of a link; zero for the centre line,
/// which is the last.
fn side(line: usize) -> Vector3<f64> {
    if line >= SIDES {
        return Vector3::zeros();
    }
    let (sine, cosine) = libm::sincos(TAU * line as f64 / SIDES as f64);
    Vector3::new(cosine, sine, 0.0)
}

/// Rotates a vector by a quaternion x y z w: v + 2w (u x v) + 2 u x (u x v).
fn turned([x, y, z, w]: [f64; 4], vector: Vector3<f64>) -> Vector3<f64> {
    let axis = Vector3::new(x, y, z);
    let across = axis.cross(&vector);
    vector + 2.0 * (w * across + axis.cross(&across))
}
