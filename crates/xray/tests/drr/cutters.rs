//! Burrs longer than a ball (the union of their balls, counted once, placed behind the tip), and the outer
//! tube.

use messages::State;
use proptest::prelude::*;
use scene::{Cutter, CutterShape, OuterTubeSize, STANDARD_HOLDER, STANDARD_RADII, ToolBurr, ToolRadii};
use xray::ray::WorldRay;
use xray::tool_model::tool_of;
use xray::{Material, PreparedPart, ToolPart, join_intervals};

fn cutter(shape: CutterShape) -> Cutter {
    let is_bit = shape == CutterShape::Bit;
    let burr = ToolBurr {
        shape: Some(shape),
        diameter_mm: 4.0,
        length_mm: Some(9.0),
        tip_diameter_mm: (shape != CutterShape::Cylinder).then_some(0.8),
        point_deg: is_bit.then_some(118.0),
        rake_deg: None,
        scallop_mm: None,
        offset_mm: 10.0,
        mass_g: 1.0,
        cutting_coefficient: None,
    };
    burr.cutter()
}

/// A straight tool along a tilted axis, and the axis.
fn state() -> (State, [f64; 3]) {
    let (half, length) = (0.35_f64, 0.03);
    let axis = [(2.0 * half).sin(), 0.0, (2.0 * half).cos()];
    let mut state = State::zeroed();
    let place = |along_m: f64| axis.map(|a| a * along_m);
    for (pose, along_m) in [(&mut state.t_world_base, 0.0), (&mut state.t_world_burr, length)] {
        pose.position_m = place(along_m);
        pose.orientation_xyzw = [0.0, half.sin(), 0.0, half.cos()];
    }
    state.t_world_flange = state.t_world_base;
    (state, axis)
}

fn crossed_m(part: &ToolPart, ray: &WorldRay) -> f64 {
    PreparedPart::new(part).map_or(f64::NAN, |part| part.cross(ray).map_or(0.0, |c| c.metal_m))
}

proptest! {
    /// Compares with the balls themselves, whose intervals on the ray are joined.
    #[test]
    fn a_ray_crosses_as_much_of_the_burr_as_of_the_union_of_its_balls(
        shape in prop_oneof![Just(CutterShape::Cylinder), Just(CutterShape::Cone), Just(CutterShape::Bit)],
        from in prop::array::uniform3(-0.3_f64..0.3),
        along in -0.01_f64..0.003,
        aside in prop::array::uniform3(-2.5e-3_f64..2.5e-3),
    ) {
        let (state, axis) = state();
        let cutter = cutter(shape);
        let radii = ToolRadii { cutter, ..STANDARD_RADII };
        let burr_m = state.t_world_burr.position_m;
        let at: [f64; 3] = std::array::from_fn(|i| burr_m[i] + along * axis[i] + aside[i]);
        let ray = WorldRay::between(from, std::array::from_fn(|i| 2.0 * at[i] - from[i]));
        let tool = tool_of(&state, &radii, &STANDARD_HOLDER, None);
        let zones = &tool.parts[tool.parts.len() - cutter.balls().len()..];
        let seen: f64 = zones.iter().map(|zone| crossed_m(zone, &ray)).sum();
        let mut intervals: Vec<(f64, f64)> = cutter.balls().iter().filter_map(|ball| {
            let centre_m = std::array::from_fn(|i| burr_m[i] - ball.behind_m * axis[i]);
            let ball = ToolPart::Sphere { centre_m, radius_m: ball.radius_m, material: Material::Steel316L };
            PreparedPart::new(&ball).ok()?.cross(&ray).map(|crossing| crossing.envelope)
        }).collect();
        let kept = join_intervals(&mut intervals);
        let union: f64 = intervals[..kept].iter().map(|(enter, leave)| (leave - enter) * ray.length_m).sum();
        prop_assert!((seen - union).abs() < 1e-12, "{} {}", seen, union);
    }
}

/// The last link ends at the burr's back, so that it does not run through the burr.
#[test]
fn the_tube_ends_where_a_long_burr_begins() {
    let (state, _) = state();
    let length_m = |cutter: Cutter| {
        let tool = tool_of(&state, &ToolRadii { cutter, ..STANDARD_RADII }, &STANDARD_HOLDER, None);
        let ends = tool.parts.iter().find_map(|part| match part {
            ToolPart::Tube { start_m, end_m, .. } => Some([*start_m, *end_m]),
            _ => None,
        });
        ends.map_or(0.0, |[a, b]| (0..3).map(|i| (b[i] - a[i]).powi(2)).sum::<f64>().sqrt())
    };
    let long = cutter(CutterShape::Cylinder);
    assert!((length_m(Cutter::ball(2e-3)) - 0.03).abs() < 1e-12);
    assert!((length_m(long) - (0.03 - long.span_m())).abs() < 1e-12);
}

/// A ray across the tool crosses both walls of the outer tube and of the tool's own tube where both exist,
/// and only the tool's own beyond.
#[test]
fn an_outer_tube_lies_about_the_tool_up_to_its_end() {
    let (mut state, axis) = state();
    // A base away from the flange: behind it the tube continues to the holder.
    let flange_m = axis.map(|a| -0.2 * a);
    state.t_world_flange.position_m = flange_m;
    let outer_tube = Some(OuterTubeSize { outer_m: 4.5e-3, inner_m: 3.7e-3, end_m: 0.02 });
    let radii = ToolRadii { outer_tube, ..STANDARD_RADII };
    let tool = tool_of(&state, &radii, &STANDARD_HOLDER, None);
    let across_m = |along_m: f64, material: Material| {
        let at: [f64; 3] = std::array::from_fn(|i| along_m * axis[i]);
        let ray = WorldRay::between([at[0], -0.1, at[2]], [at[0], 0.1, at[2]]);
        let of = |part: &&ToolPart| matches!(part, ToolPart::Tube { material: own, .. } if *own == material);
        tool.parts.iter().filter(of).map(|part| crossed_m(part, &ray)).sum::<f64>()
    };
    let cable_m = 2.0 * STANDARD_RADII.drive_cable_m;
    for (along_m, steel_m) in [(-0.1, 1.6e-3), (0.001, 1.6e-3), (0.0199, 1.6e-3), (0.0201, 0.0)] {
        assert!((across_m(along_m, Material::Steel316L) - steel_m - cable_m).abs() < 1e-12, "{along_m}");
        assert!((across_m(along_m, Material::Nitinol) - 2e-3).abs() < 1e-12, "{along_m}");
    }
}

#[test]
fn a_zone_outside_its_ball_is_refused() {
    let zone = |along_m: [f64; 2], axis: [f64; 3]| {
        let centre_m = [0.0; 3];
        PreparedPart::new(&ToolPart::SphereZone {
            centre_m,
            radius_m: 2e-3,
            axis,
            along_m,
            material: Material::Water,
        })
    };
    assert!(zone([-1e-3, 2e-3], [0.0, 0.0, 1.0]).is_ok());
    for along_m in [[-1e-3, 2.1e-3], [1e-3, -1e-3], [f64::NAN, 1e-3]] {
        assert!(
            zone(along_m, [0.0, 0.0, 1.0]).is_err_and(|reason| reason.contains("along_m")),
            "{along_m:?}"
        );
    }
    assert!(zone([-1e-3, 1e-3], [0.0, 0.0, 2.0]).is_err_and(|reason| reason.contains("unit vector")));
}
