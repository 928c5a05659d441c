//! The burr's path: as planned, as it was, and how far the one is from the other.

use ipc_types::messages::State;
use ipc_types::scene::{CurvedDrilling, Scene};
use markups::Arc;

/// Distance of the points of a planned path, mm: the chord of an arc of 20 mm radius is within 0.4 micrometres of it.
const STEP_MM: f64 = 0.25;
/// A hole this near to the burr's start, mm, leads to it.
const SAME_MM: f64 = 0.01;
/// A target this near the line, mm, is on it.
const ON_THE_LINE_MM: f64 = 1e-6;

/// A place of the burr's centre.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// When.
    pub tick: u64,
    /// Simulated time.
    pub time_s: f64,
    /// Where, LPS.
    pub burr_mm: [f64; 3],
}

/// A place beside the plan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deviation {
    /// The place.
    pub place: Place,
    /// Length of the planned path up to its nearest point.
    pub along_mm: f64,
    /// Distance from there.
    pub deviation_mm: f64,
}

/// Where the burr was, a place whenever it has come this far from the last one; the first and the last always.
#[derive(Debug)]
pub struct Travelled {
    step_mm: f64,
    places: Vec<Place>,
    last: Option<Place>,
}

impl Travelled {
    /// A path without places.
    pub fn new(step_mm: f64) -> Travelled {
        Travelled { step_mm, places: Vec::new(), last: None }
    }

    /// The next state.
    pub fn see(&mut self, state: &State) {
        let burr_mm = state.t_world_burr.position_m.map(|x| 1e3 * x);
        let place = Place { tick: state.tick, time_s: state.sim_time_s, burr_mm };
        let is_far = |kept: &Place| length(minus(burr_mm, kept.burr_mm)) >= self.step_mm;
        if self.places.last().is_none_or(is_far) {
            self.places.push(place);
        }
        self.last = Some(place);
    }

    /// What has been kept of it until now.
    pub fn so_far(&self) -> &[Place] {
        &self.places
    }

    /// All of it.
    pub fn places(mut self) -> Vec<Place> {
        if let Some(last) = self.last.filter(|last| self.places.last() != Some(last)) {
            self.places.push(last);
        }
        self.places
    }
}

/// The planned path of the burr's centre, LPS, mm: through the pilot hole that leads to its start, straight to where the bend begins, and
/// on the circle that the controller steers for, which leaves the line as its tangent and ends at the target. Without a target: straight.
/// `None`: no built-in controller drills.
pub fn planned_mm(scene: &Scene) -> Option<Vec<[f64; 3]>> {
    let start_mm = scene.tool.burr_start_mm;
    let along = unit(scene.tool.direction);
    let ahead = |length_mm: f64| plus(start_mm, length_mm, along);
    let path = scene.controller.iter().find_map(|controller| {
        let drilling =
            controller.curved_drilling.as_ref().map(|drilling| curve_mm(drilling, start_mm, along));
        let skiving = || controller.skiving.as_ref().map(|skiving| vec![start_mm, ahead(skiving.depth_mm)]);
        drilling.or_else(skiving)
    })?;
    let leads_here = |hole: &&ipc_types::scene::Predrill| length(minus(hole.to_mm, start_mm)) < SAME_MM;
    let hole = scene.predrill.iter().find(leads_here).map(|hole| hole.from_mm);
    Some(dense(&hole.into_iter().chain(path).collect::<Vec<_>>()))
}

/// The same path with points on its straight parts: a program that draws a smooth line through few points leaves them.
fn dense(path: &[[f64; 3]]) -> Vec<[f64; 3]> {
    let mut points: Vec<[f64; 3]> = path.first().copied().into_iter().collect();
    for piece in path.windows(2) {
        let way = minus(piece[1], piece[0]);
        // Chords of the arc are not longer than a step, but for rounding.
        let count = (length(way) / STEP_MM - 1e-9).ceil().max(1.0);
        points.extend((1..count as usize).map(|point| plus(piece[0], point as f64 / count, way)));
        points.push(piece[1]);
    }
    points
}

fn curve_mm(drilling: &CurvedDrilling, start_mm: [f64; 3], along: [f64; 3]) -> Vec<[f64; 3]> {
    let Some(target_mm) = drilling.target_mm else {
        return vec![start_mm, plus(start_mm, drilling.insertion_mm, along)];
    };
    let knee_mm = plus(start_mm, drilling.ramp_start_mm, along);
    let away = minus(target_mm, knee_mm);
    let ahead_mm = dot(away, along);
    let beside = plus(away, -ahead_mm, along);
    let beside_mm = length(beside);
    let mut path = vec![start_mm];
    if beside_mm > ON_THE_LINE_MM {
        let bend = unit(beside);
        let arc = Arc::to(ahead_mm, beside_mm);
        let turn_rad = arc.turn_deg.to_radians();
        let radius_mm = arc.length_mm / turn_rad;
        let pieces = (arc.length_mm / STEP_MM).ceil().max(1.0);
        path.extend((0..pieces as usize).map(|piece| {
            let angle = turn_rad * piece as f64 / pieces;
            plus(plus(knee_mm, radius_mm * angle.sin(), along), radius_mm * (1.0 - angle.cos()), bend)
        }));
    }
    path.push(target_mm);
    path.dedup();
    path
}

/// How far the burr was from the planned path on its way in, up to the place that is farthest along it: what follows is the way out.
pub fn deviations(planned_mm: &[[f64; 3]], places: &[Place]) -> Vec<Deviation> {
    let mut all: Vec<Deviation> = places.iter().filter_map(|place| deviation(planned_mm, *place)).collect();
    let farthest = (0..all.len()).max_by(|a, b| all[*a].along_mm.total_cmp(&all[*b].along_mm));
    all.truncate(farthest.map_or(0, |farthest| farthest + 1));
    all
}

/// The nearest point of the path's pieces.
fn deviation(planned_mm: &[[f64; 3]], place: Place) -> Option<Deviation> {
    let mut passed_mm = 0.0;
    let mut nearest: Option<Deviation> = None;
    for piece in planned_mm.windows(2) {
        let (way, away) = (minus(piece[1], piece[0]), minus(place.burr_mm, piece[0]));
        let long_mm = length(way);
        let share = if long_mm > 0.0 { (dot(away, way) / (long_mm * long_mm)).clamp(0.0, 1.0) } else { 0.0 };
        let deviation_mm = length(plus(away, -share, way));
        if nearest.is_none_or(|nearest| deviation_mm < nearest.deviation_mm) {
            nearest = Some(Deviation { place, along_mm: passed_mm + share * long_mm, deviation_mm });
        }
        passed_mm += long_mm;
    }
    nearest
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn length(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}

fn plus(a: [f64; 3], s: f64, b: [f64; 3]) -> [f64; 3] {
    [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]
}

fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    plus(a, -1.0, b)
}

fn unit(a: [f64; 3]) -> [f64; 3] {
    let length = length(a);
    a.map(|x| x / length)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    const SCENE: &str = "name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[volume]\nphantom = \"block\"\n\
        [[predrill]]\nfrom_mm = [0.0, 0.0, -10.0]\nto_mm = [0.0, 0.0, 40.0]\ndiameter_mm = 7.0\n\
        [tool]\nburr_start_mm = [0.0, 0.0, 40.0]\ndirection = [0.0, 0.0, 2.0]\nbend_toward = [1.0, 0.0, 0.0]\n\
        [[controller]]\nname = \"c\"\ndrives = []\n[controller.curved_drilling]\nfeed_mm_per_s = 1.0\ntension_n = 3.0\nburr_speed_rpm = 1.0\n\
        feedback = \"none\"\nramp_start_mm = 2.0\nramp_end_mm = 17.0\ninsertion_mm = 18.0\ntarget_mm = [5.0, 0.0, 57.0]\n";

    fn scene(text: &str) -> Scene {
        Scene::parse(text, Path::new("a.toml")).unwrap()
    }

    fn at(burr_mm: [f64; 3]) -> Place {
        Place { tick: 0, time_s: 0.0, burr_mm }
    }

    /// 15 mm ahead of the ramp's start and 5 beside: a circle of radius 25 mm around (25, 0, 42).
    #[test]
    fn the_planned_path_is_the_hole_the_line_and_the_controllers_circle() {
        let path = planned_mm(&scene(SCENE)).unwrap();
        // 50 mm and 2 mm in steps of 0.25 mm.
        assert_eq!([path[0], path[200], path[208]], [[0.0, 0.0, -10.0], [0.0, 0.0, 40.0], [0.0, 0.0, 42.0]]);
        assert_eq!(path.last(), Some(&[5.0, 0.0, 57.0]));
        for [x, y, z] in &path[208..] {
            assert!((((x - 25.0).powi(2) + (z - 42.0).powi(2)).sqrt() - 25.0).abs() < 1e-9 && *y == 0.0);
        }
        let arc_mm = 50.0 * (1.0_f64 / 3.0).atan();
        let length_mm: f64 = path.windows(2).map(|piece| length(minus(piece[1], piece[0]))).sum();
        // Chords of 0.25 mm in a radius of 25 mm are shorter than their arcs by 4e-6.
        assert!((length_mm - 52.0 - arc_mm).abs() < 1e-4, "{length_mm}");
        let straight = scene(&SCENE.replace("target_mm = [5.0, 0.0, 57.0]\n", ""));
        assert_eq!(planned_mm(&straight).unwrap().last(), Some(&[0.0, 0.0, 58.0]));
        assert_eq!(planned_mm(&scene(SCENE.split("[[controller]]").next().unwrap())), None);
    }

    #[test]
    fn a_deviation_is_the_distance_from_the_nearest_point_of_the_way_in() {
        let path = planned_mm(&scene(SCENE)).unwrap();
        let places =
            [at([0.0, 0.3, 20.0]), at([0.0, 0.0, 41.0]), at([25.0 - 25.5, 0.0, 42.0]), at([0.0, 1.0, 30.0])];
        let found = deviations(&path, &places);
        let figures: Vec<[f64; 2]> = found.iter().map(|one| [one.along_mm, one.deviation_mm]).collect();
        let expected = [[30.0, 0.3], [51.0, 0.0], [52.0, 0.5]];
        assert_eq!(figures.len(), 3, "without the way back: {figures:?}");
        for (found, expected) in figures.iter().flatten().zip(expected.iter().flatten()) {
            assert!((found - expected).abs() < 1e-9, "{figures:?}");
        }
    }

    #[test]
    fn a_travelled_path_keeps_a_place_a_step_and_both_ends() {
        let mut path = Travelled::new(0.1);
        for tick in 0..=100_u64 {
            let mut state = State::zeroed();
            (state.tick, state.t_world_burr.position_m[0]) = (tick, tick as f64 * 1.3e-5);
            path.see(&state);
        }
        let places = path.places();
        let ticks: Vec<u64> = places.iter().map(|place| place.tick).collect();
        assert_eq!(ticks[..3], [0, 8, 16]);
        assert_eq!(ticks.last(), Some(&100));
    }
}
