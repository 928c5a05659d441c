//! Mitred links: nothing is missing where links meet at an angle, and nothing counts twice.

use messages::State;
use proptest::prelude::*;
use scene::{STANDARD_HOLDER, STANDARD_RADII};
use xray::ray::WorldRay;
use xray::tool_model::tool_of;
use xray::{Material, PreparedPart, Tool, ToolPart};

const OUTER_M: f64 = 3e-3;
const INNER_M: f64 = 2e-3;

/// Path length in a material on a ray.
#[allow(clippy::unwrap_used, reason = "a helper that fails is a failed test")]
fn metal_m(tool: &Tool, material: Material, from: [f64; 3], to: [f64; 3]) -> f64 {
    let ray = WorldRay::between(from, to);
    let parts = tool.parts.iter().map(|part| PreparedPart::new(part).unwrap());
    parts
        .filter(|part| part.material() == material)
        .filter_map(|part| part.cross(&ray))
        .map(|c| c.metal_m)
        .sum()
}

/// A tool with joints in the xz plane, bent by the angle at every joint: a shaft of 30 mm, then links of 4
/// mm.
fn bent(turn_rad: f64) -> (State, Vec<[f64; 3]>) {
    let mut state = State::zeroed();
    let ahead = |link: usize| [(link as f64 * turn_rad).sin(), 0.0, (link as f64 * turn_rad).cos()];
    let step = |at: [f64; 3], link: usize, by_m: f64| std::array::from_fn(|i| at[i] + by_m * ahead(link)[i]);
    state.joint_count = 4;
    let mut at = step([0.0; 3], 0, 0.03);
    let mut joints = Vec::new();
    for joint in 0..4 {
        state.t_world_link[joint].position_m = at;
        joints.push(at);
        at = step(at, joint + 1, 4e-3);
    }
    state.t_world_burr.position_m = step(at, 4, 0.02);
    for pose in state.t_world_link.iter_mut().chain([&mut state.t_world_base, &mut state.t_world_burr]) {
        pose.orientation_xyzw = [0.0, 0.0, 0.0, 1.0];
    }
    (state, joints)
}

/// In the joint's plane, the tube's section is an ellipse: its chord is the transverse chord divided by the
/// cosine of half the angle.
#[test]
fn the_metal_at_a_joint_is_that_of_the_ellipse_in_its_plane() {
    for turn_rad in [0.02_f64, 0.2, 0.6] {
        let (state, joints) = bent(turn_rad);
        let tool = tool_of(&state, &STANDARD_RADII, &STANDARD_HOLDER, None);
        for (joint, at) in joints.iter().enumerate() {
            let middle = (joint as f64 + 0.5) * turn_rad;
            let (normal, along) = ([middle.sin(), 0.0, middle.cos()], [middle.cos(), 0.0, -middle.sin()]);
            // Just in front of and just behind the plane.
            for beside_m in [-1e-9, 1e-9] {
                let place =
                    |by_m: f64| std::array::from_fn(|i| at[i] + beside_m * normal[i] + by_m * along[i]);
                let wall = metal_m(&tool, Material::Nitinol, place(-0.006), place(0.006));
                let cable = metal_m(&tool, Material::Steel316L, place(-0.006), place(0.006));
                let cosine = (0.5 * turn_rad).cos();
                let want = 2.0 * (OUTER_M - INNER_M) / cosine;
                assert!((wall - want).abs() < 1e-8, "{turn_rad} rad, joint {joint}: {wall}, {want}");
                assert!((cable - 2e-3 / cosine).abs() < 1e-8, "{turn_rad} rad, joint {joint}: {cable}");
                // Across the bending plane nothing changes.
                let across = |by_m: f64| [place(0.0)[0], by_m, place(0.0)[2]];
                let wall = metal_m(&tool, Material::Nitinol, across(-0.01), across(0.01));
                assert!((wall - 2.0 * (OUTER_M - INNER_M)).abs() < 1e-8, "{turn_rad} rad: {wall}");
            }
        }
    }
}

/// A straight tool has flat ends, bit-identical to parts without mitres.
#[test]
fn links_in_line_end_flat() {
    let is_flat =
        |part: &ToolPart| matches!(part, ToolPart::Sphere { .. } | ToolPart::Tube { normals: None, .. });
    // In line, and so oblique that a mitre would protrude by more than the tube's width.
    for turn_rad in [0.0, 2.2] {
        let tool = tool_of(&bent(turn_rad).0, &STANDARD_RADII, &STANDARD_HOLDER, None);
        assert!(tool.parts.len() == 11 && tool.parts.iter().all(is_flat), "{tool:?}");
    }
}

/// With the base 200 mm in front of the flange, the shaft continues to the 60 mm holder: a straight ray along
/// y crosses its two walls.
#[test]
fn the_shaft_goes_on_behind_the_base_to_the_holder() {
    let (mut state, joints) = bent(0.2);
    state.t_world_flange.position_m = [0.0, 0.0, -0.2];
    let tool = tool_of(&state, &STANDARD_RADII, &STANDARD_HOLDER, None);
    let metal = |z: f64, material| metal_m(&tool, material, [0.0, -0.1, z], [0.0, 0.1, z]);
    for (z, nitinol_m, steel_m) in [
        (-0.21, 0.0, 0.0),
        (-0.199, 0.0, 4e-3),
        (-0.141, 0.0, 4e-3),
        (-0.139, 2e-3, 2e-3),
        (-0.001, 2e-3, 2e-3),
        (0.001, 2e-3, 2e-3),
    ] {
        assert!((metal(z, Material::Nitinol) - nitinol_m).abs() < 1e-12, "z {z}");
        assert!((metal(z, Material::Steel316L) - steel_m).abs() < 1e-12, "z {z}");
    }
    assert!(matches!(tool.parts.last(), Some(ToolPart::Sphere { .. })), "the burr is the last part");
    // A base nearer than the holder's length has no bare shaft; a base on the flange has neither.
    for (z, parts) in [(-0.04, 2 * (joints.len() + 1) + 2), (0.0, 2 * (joints.len() + 1) + 1)] {
        state.t_world_flange.position_m = [0.0, 0.0, z];
        assert_eq!(tool_of(&state, &STANDARD_RADII, &STANDARD_HOLDER, None).parts.len(), parts);
    }
}

#[test]
fn an_end_cut_too_obliquely_or_by_no_unit_normal_is_refused() {
    let z = [0.0, 0.0, 1.0];
    for normal in [[0.0, 0.0, -1.0], [0.9, 0.0, 0.19_f64.sqrt()], [0.0, 0.0, 2.0], [f64::NAN, 0.0, 1.0]] {
        for normals in [[normal, z], [z, normal]] {
            let part = ToolPart::Tube {
                start_m: [0.0; 3],
                end_m: [0.0, 0.0, 0.03],
                normals: Some(normals),
                outer_radius_m: OUTER_M,
                inner_radius_m: INNER_M,
                notch: None,
                material: Material::Nitinol,
            };
            assert!(PreparedPart::new(&part).is_err_and(|why| why.contains("normals")), "{normals:?}");
        }
    }
}

proptest! {
    /// Every point of the shell about the bent axis belongs to exactly one link, determined by the sides of
    /// the joint planes.
    #[test]
    fn the_metal_of_a_bent_tool_agrees_with_counting_points_on_the_ray(
        from in prop::array::uniform3(-0.02..0.02_f64), to in prop::array::uniform3(-0.02..0.02_f64),
        turn_rad in 0.05..0.4_f64,
    ) {
        let (state, joints) = bent(turn_rad);
        let tool = tool_of(&state, &STANDARD_RADII, &STANDARD_HOLDER, None);
        let [from, to] = [from, to].map(|p| [p[0] + 4e-3, p[1], p[2] + 0.035]);
        let got = metal_m(&tool, Material::Nitinol, from, to);
        let ends: Vec<[f64; 3]> =
            [[0.0; 3]].into_iter().chain(joints).chain([state.t_world_burr.position_m]).collect();
        let n = 20_000;
        let inside = |t: f64| {
            let p: [f64; 3] = std::array::from_fn(|a| from[a] + t * (to[a] - from[a]));
            (0..5).any(|link| {
                let q: [f64; 3] = std::array::from_fn(|a| p[a] - ends[link][a]);
                let r: [f64; 3] = std::array::from_fn(|a| p[a] - ends[link + 1][a]);
                let at = link as f64 * turn_rad;
                let cut = |angle: f64, v: &[f64; 3]| v[0] * angle.sin() + v[2] * angle.cos();
                let first = if link == 0 { at } else { at - 0.5 * turn_rad };
                let last = if link == 4 { at } else { at + 0.5 * turn_rad };
                let radius = (q[0] * at.cos() - q[2] * at.sin()).hypot(q[1]);
                cut(first, &q) >= 0.0 && cut(last, &r) < 0.0 && (INNER_M..OUTER_M).contains(&radius)
            })
        };
        let count = (0..n).filter(|&i| inside((f64::from(i) + 0.5) / f64::from(n))).count();
        let length_m = WorldRay::between(from, to).length_m;
        let want = count as f64 / f64::from(n) * length_m;
        // At most four boundaries per link, each off by one sample.
        prop_assert!((got - want).abs() <= 20.0 * length_m / f64::from(n), "{} {}", got, want);
    }
}
