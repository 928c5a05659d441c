//! Cutters longer than a ball, against closed forms: the volume that they sweep and the feed force.
//!
//! A cutter fed at speed v into bone of specific energy u needs the power `u A v`, where A is the swept
//! cross-section. It delivers `mu w L N`, where N is the sum of its normal forces. For a cylinder pressed
//! sideways L = R, since its whole surface is R from the axis, and N is the force against the feed. For a
//! drill bit boring its hole, L = 2R/3 under even pressure (the mean distance of a disc's points from its
//! centre), and without friction along the flanks, at the half point angle a from the axis, the thrust is `N
//! sin a`. Both cut `reach` beyond their surface.

#![allow(clippy::unwrap_used, reason = "a scene that cannot be built fails the test")]

use core::f64::consts::PI;
use std::path::Path;

use crate::common::latched;
use messages::{ArmMode, BurrMode, Command, ContactPart, Latched, SOURCE_FRESH, State};
use nalgebra::Vector3;
use scene::{Cutter, Scene};
use simulation::bone::{CuttingLaw, GridGeometry};
use simulation::manipulator::ManipulatorParameters;
use simulation::{CtView, Simulation, findings, manipulator_parameters};

const COEFFICIENT: f64 = 0.3;
const ENERGY_J_PER_M3: f64 = 5.0e7;
const SPEED_RAD_S: f64 = 800.0;
const RADIUS_M: f64 = 2.0e-3;

/// A 3 mm steel rod with this cutter; `more` holds further keys of the scene.
fn scene(burr: &str, more: &str) -> Scene {
    let text = format!(
        "name = \"cutter\"\n[run]\nmode = \"lockstep\"\nduration_s = 60.0\n[volume]\nphantom = \"block\"\n\
         [drilling]\nspecific_energy_j_per_mm3 = {:?}\ndensity_exponent = 0.0\n\
         cutting_coefficient = {COEFFICIENT:?}\n{more}\
         [tool]\nburr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\n\
         bend_toward = [1.0, 0.0, 0.0]\n\
         [[controller]]\nname = \"feed\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\nexternal = true\n\
         [manipulator]\nmodel = \"spatial\"\n[manipulator.tool]\nname = \"rod\"\n\
         [manipulator.tool.tube]\nouter_diameter_mm = 3.0\ninner_diameter_mm = 0.0\n\
         linear_density_kg_per_m = 0.056\nyoungs_modulus_gpa = 200.0\n\
         [[manipulator.tool.flexure]]\nat_mm = 40.0\ncount = 3\npitch_mm = 5.0\n\
         [manipulator.tool.burr]\n{burr}mass_g = 1.0\n",
        ENERGY_J_PER_M3 * 1e-9,
    );
    Scene::parse(&text, Path::new("cutter.toml")).unwrap()
}

/// Half the point angle of the bit.
const FLANK_DEG: f64 = 59.0;
const BIT: &str = "shape = \"bit\"\ndiameter_mm = 4.0\nlength_mm = 8.0\ntip_diameter_mm = 0.6\n\
                   point_deg = 118.0\noffset_mm = 12.0\n";

fn cylinder(scallop_mm: f64) -> String {
    format!(
        "shape = \"cylinder\"\ndiameter_mm = 4.0\nlength_mm = 12.0\nscallop_mm = {scallop_mm:?}\n\
         offset_mm = 14.0\n"
    )
}

/// Uniform bone between two corners.
fn block(low_m: [f64; 3], high_m: [f64; 3], voxel_m: f64) -> (GridGeometry, Vec<i16>) {
    let dims: [usize; 3] = core::array::from_fn(|a| ((high_m[a] - low_m[a]) / voxel_m).round() as usize);
    let origin = Vector3::from(low_m).add_scalar(0.5 * voxel_m);
    let geometry = GridGeometry::axis_aligned(dims, [voxel_m; 3], origin);
    (geometry, vec![600; geometry.voxel_count()])
}

fn feed(axis: [f64; 3], length_m: f64, feed_m_per_s: f64) -> Latched {
    let command = Command {
        sequence: 1,
        arm_mode: ArmMode::Insert.code(),
        arm_axis: axis,
        arm_depth_m: length_m,
        arm_speed_m_per_s: feed_m_per_s,
        burr_mode: BurrMode::Speed.code(),
        burr_speed_rad_per_s: SPEED_RAD_S,
        ..Command::zeroed()
    };
    latched(0, SOURCE_FRESH, 0, command)
}

/// Result of a feed.
struct Fed {
    /// Mean force against the feed between 60 and 95 % of its length, N.
    force_n: f64,
    /// Volume of the removed voxels, m^3.
    removed_m3: f64,
    /// The same from the energy absorbed by bone, including partly cut voxels.
    cut_m3: f64,
    end: State,
}

/// Feeds along a world axis; `[0, 0, 1]` is the tool's own axis.
fn fed(
    scene: &Scene,
    bone: &(GridGeometry, Vec<i16>),
    along: [f64; 3],
    length_m: f64,
    feed_m_per_s: f64,
) -> Fed {
    let (geometry, hu) = bone;
    let mut simulation = Simulation::new(scene, Some(CtView { geometry: *geometry, hu })).unwrap();
    let ticks = (1e3 * length_m / feed_m_per_s) as u64;
    let latched = feed(along, length_m, feed_m_per_s);
    let (mut sum_n, mut counted) = (0.0, 0.0);
    for tick in 0..ticks + 300 {
        simulation.step(&Latched { tick, ..latched }).unwrap();
        let share = tick as f64 / ticks as f64;
        let state = simulation.state();
        assert!(state.contact_count < 40, "every contact is listed");
        if (0.6..0.95).contains(&share) {
            let burr = state.contacts[..state.contact_count as usize].iter();
            let burr = burr.filter(|contact| contact.part == ContactPart::Burr.code());
            let against = |normal: [f64; 3]| -Vector3::from(normal).dot(&Vector3::from(along));
            sum_n += burr.map(|contact| contact.normal_force_n * against(contact.normal)).sum::<f64>();
            counted += 1.0;
        }
    }
    let end = *simulation.state();
    Fed {
        force_n: sum_n / counted,
        removed_m3: end.removed_total as f64 * geometry.voxel_volume_m3(),
        cut_m3: end.cutting_energy_j / ENERGY_J_PER_M3,
        end,
    }
}

fn reach_m() -> f64 {
    CuttingLaw::default().reach_m
}

fn is_within(measured: f64, exact: f64, share: f64) -> bool {
    (measured / exact - 1.0).abs() < share
}

/// Asserts that the force and the two volumes of a feed match closed forms within 5 %.
fn assert_closed_form(what: &str, fed: &Fed, force_n: f64, swept_m3: f64) {
    println!(
        "{what}: force {:.3} N, closed form {force_n:.3} N; {:.2} mm^3 removed, {:.2} mm^3 cut, closed form \
         {:.2} mm^3",
        fed.force_n,
        1e9 * fed.removed_m3,
        1e9 * fed.cut_m3,
        1e9 * swept_m3
    );
    assert!(is_within(fed.force_n, force_n, 0.05), "{} N", fed.force_n);
    assert!(is_within(fed.removed_m3, swept_m3, 0.05), "{} mm^3", 1e9 * fed.removed_m3);
    assert!(is_within(fed.cut_m3, swept_m3, 0.05), "{} mm^3", 1e9 * fed.cut_m3);
}

/// The tip's round front, whose normal lies along the axis, takes part of the thrust from the flanks, and the
/// grid's phase moves the wall of whole voxels: 4 and 3 % measured, 5 % allowed for each.
#[test]
fn a_bit_bores_its_hole_with_the_thrust_of_the_closed_form() {
    let (feed_m_per_s, length_m) = (1.0e-3, 12.0e-3);
    let hole_m = RADIUS_M + reach_m();
    for voxel_m in [0.2e-3, 0.3e-3] {
        // Off the grid's symmetry planes, where the walls would pass through voxel centres on both sides.
        let bone = block([-3.57e-3, -3.55e-3, 0.6e-3], [3.63e-3, 3.65e-3, 15.0e-3], voxel_m);
        let fed = fed(&scene(BIT, ""), &bone, [0.0, 0.0, 1.0], length_m, feed_m_per_s);
        let area_m2 = PI * hole_m * hole_m;
        let normal_n =
            ENERGY_J_PER_M3 * area_m2 * feed_m_per_s / (COEFFICIENT * SPEED_RAD_S * RADIUS_M * 2.0 / 3.0);
        let thrust_n = normal_n * FLANK_DEG.to_radians().sin();
        // The hole's cylinder and the cone in front of it; the tip is round.
        let cutter = scene(BIT, "").manipulator.radii().cutter;
        let depth_m = fed.end.t_world_burr.position_m[2] - 0.6e-3;
        let swept_m3 = bored_m3(&cutter, depth_m, reach_m());
        assert_closed_form(&format!("{:.1} mm voxels", 1e3 * voxel_m), &fed, thrust_n, swept_m3);
    }
}

/// Volume bored below a plane by a cutter grown by its reach, with its front ball's centre `depth_m` below
/// the plane: integrates slices of the envelope of its corners, the cone tangent to the tip, and the
/// cylinder.
fn bored_m3(cutter: &Cutter, depth_m: f64, reach_m: f64) -> f64 {
    let (tip_m, wide_m) = (cutter.front_radius_m() + reach_m, cutter.widest_radius_m() + reach_m);
    let flank = FLANK_DEG.to_radians();
    let radius_m = |back_m: f64| {
        // Measured backward from the tip's centre. The cone of half angle a is tangent to the tip at -r sin
        // a.
        let cone_m = tip_m / flank.cos() + back_m * flank.tan();
        let ball_m = (tip_m * tip_m - back_m * back_m).max(0.0).sqrt();
        if back_m < -tip_m * flank.sin() { ball_m } else { cone_m.min(wide_m) }
    };
    let count = 20_000;
    let step_m = (depth_m + tip_m) / f64::from(count);
    (0..count)
        .map(|i| -tip_m + (f64::from(i) + 0.5) * step_m)
        .map(|z| PI * radius_m(z).powi(2) * step_m)
        .sum()
}

/// A cylinder mills a slot through a plate with its side; both of its ends protrude from the plate.
#[test]
fn a_cylinder_mills_a_slot_with_the_force_of_the_closed_form_whatever_its_number_of_balls() {
    let (feed_m_per_s, length_m, thick_m) = (0.5e-3, 8.0e-3, 4.0e-3);
    let hole_m = RADIUS_M + reach_m();
    // The cutter's balls are 0 to 8 mm behind its centre.
    let bone = block([2.5e-3, -3.57e-3, -6.0e-3], [12.1e-3, 3.63e-3, -6.0e-3 + thick_m], 0.2e-3);
    let mut forces = Vec::new();
    for scallop_mm in [0.05, 0.02] {
        let scene = scene(&cylinder(scallop_mm), "");
        let balls = scene.manipulator.radii().cutter.balls().len();
        let fed = fed(&scene, &bone, [1.0, 0.0, 0.0], length_m, feed_m_per_s);
        let power_w = ENERGY_J_PER_M3 * 2.0 * hole_m * thick_m * feed_m_per_s;
        let force_n = power_w / (COEFFICIENT * SPEED_RAD_S * RADIUS_M);
        let way_m = fed.end.t_world_burr.position_m[0] - 2.5e-3;
        let swept_m3 = thick_m * (2.0 * hole_m * way_m + 0.5 * PI * hole_m * hole_m);
        assert_closed_form(&format!("{balls} balls"), &fed, force_n, swept_m3);
        forces.push(fed.force_n);
    }
    assert!(is_within(forces[0], forces[1], 0.03), "{forces:?}");
}

/// Masses, spheres and the tip of a longer cutter.
#[test]
fn a_longer_cutter_has_its_balls_behind_the_tip_and_its_mass_at_its_own_centre() {
    let parameters = |burr: &str| manipulator_parameters(&scene(burr, "")).unwrap();
    let long = parameters(&cylinder(0.05));
    assert_eq!(long.burr_centre_m(), 50.0e-3 + 14.0e-3);
    let solid = long.cutter.solid();
    // The cylinder's midpoint is 4 mm behind its front ball's centre. A union of balls has the cylinder's
    // symmetry.
    assert!((solid.behind_m - 4.0e-3).abs() < 1e-12, "{}", solid.behind_m);
    let mass = |p: &ManipulatorParameters| p.burr_mass_kg;
    assert_eq!(mass(&long), 1.0e-3);
    let simulation = Simulation::new(
        &scene(&cylinder(0.05), ""),
        Some({
            let (geometry, hu) = (block([0.0; 3], [1e-3; 3], 1e-3).0, &[-1000_i16][..]);
            CtView { geometry, hu }
        }),
    )
    .unwrap();
    let state = simulation.state();
    assert!(
        Vector3::from(state.t_world_burr.position_m).norm() < 1e-12,
        "the burr's centre is that of its front ball"
    );
    assert!((state.t_world_tip.position_m[2] - RADIUS_M).abs() < 1e-12);
}

/// A run continues bit for bit from a keyframe in the middle of a cut, including the side force's torque.
#[test]
fn a_keyframe_in_the_cut_of_a_long_cutter_continues_bit_for_bit() {
    let (geometry, hu) = block([2.5e-3, -3.6e-3, -6.0e-3], [8.0e-3, 3.6e-3, 0.0], 0.5e-3);
    let scene = scene(&cylinder(0.05), "side_force = true\n");
    let ct = || Some(CtView { geometry, hu: &hu });
    let mut first = Simulation::new(&scene, ct()).unwrap();
    let latched = feed([1.0, 0.0, 0.0], 4.0e-3, 2.0e-3);
    for tick in 0..900 {
        first.step(&Latched { tick, ..latched }).unwrap();
    }
    assert!(first.state().removed_total > 10 && first.state().burr_force_n > 0.0, "it cuts");
    let mut bytes = vec![0; 4 << 20];
    let used = first.write_keyframe(&mut bytes).unwrap();
    let mut second = Simulation::new(&scene, ct()).unwrap();
    second.restore_keyframe(&bytes[..used]).unwrap();
    for tick in 900..1200 {
        first.step(&Latched { tick, ..latched }).unwrap();
        second.step(&Latched { tick, ..latched }).unwrap();
        assert_eq!(first.state().hash, second.state().hash, "tick {tick}");
    }
}

#[test]
fn a_tip_thinner_than_two_voxels_is_called_unlikely() {
    let scene = scene(BIT, "");
    let told = |voxel_m: f64| {
        let (geometry, hu) = block([-3.6e-3, -3.6e-3, 0.6e-3], [3.6e-3, 3.6e-3, 7.8e-3], voxel_m);
        let found = findings(&scene, Some(CtView { geometry, hu: &hu }), &|_| true).unwrap();
        let tip = found.iter().find(|finding| finding.key == "manipulator.tool.burr.tip_diameter_mm");
        tip.map(|finding| finding.problem.clone())
    };
    assert_eq!(told(0.3e-3), None);
    let said =
        "is 0.6: a tip thinner than two voxels (0.80 mm) catches on them, and its force comes in bursts";
    assert_eq!(told(0.4e-3).as_deref(), Some(said));
}
