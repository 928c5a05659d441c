//! The path that a scene plans for its burr.

use markups::Arc;
use markups::vector::{across, cross, dot, length, minus, plus, unit};

use crate::{CurvedDrilling, Predrill, Scene, ToolDescription, ToolOuterTube, TubeDeployment};

/// Spacing of the points of a planned path, mm: the chord of an arc of 20 mm radius deviates by less than 0.4
/// micrometres.
const STEP_MM: f64 = 0.25;
/// A hole that ends this close to the burr's start, mm, leads to it.
const SAME_MM: f64 = 0.01;
/// A target this close to the line, mm, is on it.
const ON_THE_LINE_MM: f64 = 1e-6;

/// Planned path of the burr's centre, LPS, mm: through the pilot hole that leads to its start, straight to
/// where the bend begins, then along the controller's circle, which is tangent to the line and ends at the
/// target; straight without a target. For a tool that slides out of an outer tube: the path of its burr along
/// the rest shape of the deployed part. `None` if no built-in controller drills.
pub fn planned_path_mm(scene: &Scene) -> Option<Vec<[f64; 3]>> {
    let start_mm = scene.tool.burr_start_mm;
    let along = unit(scene.tool.direction);
    let ahead = |length_mm: f64| plus(start_mm, length_mm, along);
    let path = scene.controller.iter().find_map(|controller| {
        let drilling =
            controller.curved_drilling.as_ref().map(|drilling| curve_mm(drilling, start_mm, along));
        let skiving = || controller.skiving.as_ref().map(|skiving| vec![start_mm, ahead(skiving.depth_mm)]);
        let deployment = || deployment_mm(controller.tube_deployment.as_ref()?, scene, along);
        drilling.or_else(skiving).or_else(deployment)
    })?;
    let leads_here = |hole: &&Predrill| length(minus(hole.to_mm, start_mm)) < SAME_MM;
    let hole = scene.predrill.iter().find(leads_here).map(|hole| hole.from_mm);
    Some(dense(&hole.into_iter().chain(path).collect::<Vec<_>>()))
}

/// Adds points on the straight parts: a program that draws a smooth curve through few points would leave
/// them.
fn dense(path: &[[f64; 3]]) -> Vec<[f64; 3]> {
    let mut points: Vec<[f64; 3]> = path.first().copied().into_iter().collect();
    for piece in path.windows(2) {
        let way = minus(piece[1], piece[0]);
        // Chords of the arc are no longer than a step, up to rounding.
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

/// Path of the burr while the tool slides out: each flexure bends by its deployed fraction; the outer tube
/// does not bend.
fn deployment_mm(plan: &TubeDeployment, scene: &Scene, along: [f64; 3]) -> Option<Vec<[f64; 3]>> {
    let tool = scene.manipulator.tool.as_ref()?;
    let outer = tool.outer_tube.as_ref()?;
    let toward = unit(across(scene.tool.bend_toward, along));
    let (sin, cos) = plan.roll_deg.to_radians().sin_cos();
    let bend = plus(cross(along, toward).map(|part| part * sin), cos, toward);
    let start = burr_mm(tool, outer, 0.0);
    let steps = (plan.deployed_mm / STEP_MM).ceil().max(1.0);
    let way = (0..=steps as usize).map(|step| {
        let [beside_mm, ahead_mm] = burr_mm(tool, outer, plan.deployed_mm * step as f64 / steps);
        let ahead = plus(scene.tool.burr_start_mm, ahead_mm - start[1], along);
        plus(ahead, beside_mm - start[0], bend)
    });
    Some(way.collect())
}

/// The burr's centre from the tool's base, lateral and axial, with a given length of the tool deployed.
fn burr_mm(tool: &ToolDescription, outer: &ToolOuterTube, deployed_mm: f64) -> [f64; 2] {
    let places = tool.flexures();
    let (mut place, mut angle, mut along_mm) = ([0.0, deployed_mm], 0.0_f64, 0.0);
    for (index, flexure) in places.iter().enumerate() {
        let ahead_mm = flexure.at_mm - along_mm;
        place = [place[0] + ahead_mm * angle.sin(), place[1] + ahead_mm * angle.cos()];
        along_mm = flexure.at_mm;
        let length_mm = ToolDescription::length_mm(&places, index).unwrap_or(f64::MIN_POSITIVE);
        let out_mm = flexure.at_mm + 0.5 * length_mm + deployed_mm - outer.end_mm;
        angle += flexure.flexure.rest_deg.to_radians() * (out_mm / length_mm).clamp(0.0, 1.0);
    }
    let offset_mm = tool.burr.offset_mm;
    [place[0] + offset_mm * angle.sin(), place[1] + offset_mm * angle.cos()]
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    const SCENE: &str = "name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[volume]\nphantom \
                         = \"block\"\n\
        [[predrill]]\nfrom_mm = [0.0, 0.0, -10.0]\nto_mm = [0.0, 0.0, 40.0]\ndiameter_mm = 7.0\n\
        [tool]\nburr_start_mm = [0.0, 0.0, 40.0]\ndirection = [0.0, 0.0, 2.0]\nbend_toward = [1.0, 0.0, \
        0.0]\n\
        [[controller]]\nname = \"c\"\ndrives = []\n[controller.curved_drilling]\nfeed_mm_per_s = \
        1.0\ntension_n = 3.0\nburr_speed_rpm = 1.0\n\
        feedback = \"none\"\nramp_start_mm = 2.0\nramp_end_mm = 17.0\ninsertion_mm = 18.0\ntarget_mm = [5.0, \
        0.0, 57.0]\n";

    fn scene(text: &str) -> Scene {
        Scene::parse(text, Path::new("a.toml")).unwrap()
    }

    /// 15 mm ahead of the ramp's start and 5 beside: a circle of radius 25 mm around (25, 0, 42).
    #[test]
    fn the_planned_path_is_the_hole_the_line_and_the_controllers_circle() {
        let path = planned_path_mm(&scene(SCENE)).unwrap();
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
        assert_eq!(planned_path_mm(&straight).unwrap().last(), Some(&[0.0, 0.0, 58.0]));
        assert_eq!(planned_path_mm(&scene(SCENE.split("[[controller]]").next().unwrap())), None);
    }
}
