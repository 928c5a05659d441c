//! Tools that a file describes: the standard one bit for bit, the others against closed forms.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a helper that fails is a failed test")]

use std::path::{Path, PathBuf};

use crate::common::latched;
use messages::{BURR_SPEED, Command, SOURCE_FRESH, SOURCE_HELD, TENDON_SERVO_JF};
use nalgebra::{Isometry3, Vector3};
use scene::{Manipulator, Scene, ToolDescription};
use simulation::manipulator::{
    AnyManipulator, BaseMotion, ManipulatorModel, ManipulatorParameters, Rung, Section, StepInput,
    TendonCommand, Wrench,
};
use simulation::{Simulation, manipulator_parameters};
use test_support::scenes::TOOL;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/tools")
}

/// A scene with this text in its `[manipulator]`.
fn scene(manipulator: &str) -> Scene {
    let text = format!(
        "name = \"tools\"\nrun = {{ mode = \"lockstep\", duration_s = 1.0 }}\n[manipulator]\n{manipulator}\n\
         {TOOL}"
    );
    Scene::parse_with(&text, &folder().join("scene.toml"), &|file| std::fs::read_to_string(file)).unwrap()
}

fn described(file: &str) -> ManipulatorParameters {
    manipulator_parameters(&scene(&format!("file = \"{file}\""))).unwrap()
}

/// The tool of a file with more keys at its end.
fn described_with(file: &str, keys: &str) -> ManipulatorParameters {
    let text = format!(
        "name = \"tools\"\nrun = {{ mode = \"lockstep\", duration_s = 1.0 }}\n[manipulator]\n\
         file = \"{file}\"\n{TOOL}"
    );
    let read = |file: &Path| Ok(std::fs::read_to_string(file)? + keys);
    let scene = Scene::parse_with(&text, &folder().join("scene.toml"), &read).unwrap();
    manipulator_parameters(&scene).unwrap()
}

#[test]
fn the_standard_tool_and_its_file_are_one() {
    for overrides in ["", "links = 9", "stiffness_scale = 0.7\nmass_scale = 2.0\nburr_diameter_mm = 6.0"] {
        let [standard, mut file] = [overrides.to_owned(), format!("file = \"jhu_27.toml\"\n{overrides}")]
            .map(|text| manipulator_parameters(&scene(&text)).unwrap());
        // The antagonist pair, once as a pair and once as two tendons.
        let channels = file.tendon_routes.take().unwrap();
        file.tendon.offset_m = channels[0].channel_m[0];
        assert_eq!(channels[1].channel_m, [-file.tendon.offset_m, 0.0]);
        assert_eq!(file, standard, "{overrides}");
    }
    assert_eq!(
        scene("file = \"jhu_27.toml\"").manipulator.radii(),
        Manipulator::default().radii(),
        "the X-ray's radii"
    );
}

/// Hash after 600 ticks with the two tendons pulled alternately.
fn hash(scene: &Scene) -> [u64; 2] {
    let mut simulation = Simulation::new(scene, None).unwrap();
    for tick in 0..600 {
        let command = Command {
            sequence: 1 + tick / 200,
            tendon_mode: TENDON_SERVO_JF,
            tendon_force_n: [[3.0, 0.0, 0.0, 0.0], [0.0, 5.0, 0.0, 0.0], [1.0, 0.5, 0.0, 0.0]]
                [tick as usize / 200],
            burr_mode: BURR_SPEED,
            burr_speed_rad_per_s: 800.0,
            ..Command::zeroed()
        };
        let source = if tick % 200 == 0 { SOURCE_FRESH } else { SOURCE_HELD };
        simulation.step(&latched(tick, source, tick % 200, command)).unwrap();
    }
    simulation.state().hash
}

#[test]
fn the_standard_tool_has_the_same_hash_with_and_without_its_file() {
    for rung in ["constant_curvature", "modal", "planar", "spatial", "full"] {
        let [standard, file] = ["", "file = \"jhu_27.toml\"\n"]
            .map(|file| hash(&scene(&format!("{file}model = \"{rung}\"\ntendon_friction = 0.1"))));
        assert_eq!(standard, file, "{rung}");
        let changed = hash(&scene(&format!("model = \"{rung}\"\ntendon_friction = 0.11")));
        assert_ne!(standard, changed, "{rung}: the hash does not depend on the friction");
    }
}

fn settled(rung: Rung, mut p: ManipulatorParameters, tension_n: [f64; 4]) -> AnyManipulator {
    p.damping_ratio = 1.0;
    p.mount_stiffness_n_per_m = [1e9; 3];
    let base = BaseMotion::at_rest(Isometry3::identity());
    let mut tool = AnyManipulator::new(rung, p, &base).unwrap();
    // A pre-curved tool relaxes to its shape from a straight one.
    tool.straighten();
    let tendon = TendonCommand::EachForce(tension_n);
    let input = StepInput { base, tendon, tip_wrench: Wrench::zero(), contacts: &[] };
    for _ in 0..3000 {
        tool.step(1e-3, &input).unwrap();
    }
    tool
}

/// End (x, z) of a straight section, arcs in series and another straight section. Each arc is a length and a
/// bend.
fn arcs(straight_m: f64, arcs: &[[f64; 2]], behind_m: f64) -> [f64; 2] {
    let (mut angle, mut x, mut z) = (0.0_f64, 0.0, straight_m);
    for [length_m, bend] in arcs {
        let (chord_m, half) = if *bend == 0.0 {
            (*length_m, 0.0)
        } else {
            (2.0 * length_m / bend * (0.5 * bend).sin(), 0.5 * bend)
        };
        x += chord_m * (angle + half).sin();
        z += chord_m * (angle + half).cos();
        angle += bend;
    }
    [x + behind_m * angle.sin(), z + behind_m * angle.cos()]
}

fn distance_m(tool: &AnyManipulator, [x, z]: [f64; 2]) -> f64 {
    (tool.t_world_tip().translation.vector - Vector3::new(x, 0.0, z)).norm()
}

/// A circle in closed form, for the published radii and the file's own.
#[test]
fn a_pre_curved_tool_comes_to_its_arc_within_10_um() {
    for radius_mm in [35.0, 50.0, 80.0] {
        let mut p = described("steerable_drill.toml");
        let bend = 1.25 / radius_mm;
        if radius_mm == 50.0 {
            assert!(p.joint_rest_rad.iter().all(|rest| (rest - bend).abs() < 1e-15));
        }
        p.joint_rest_rad = vec![bend; 32];
        let tip_m = arcs(0.04, &[[0.04, 32.0 * bend]], p.tip_offset_m - 0.625e-3);
        for rung in Rung::ALL {
            let off_m = distance_m(&settled(rung, p.clone(), [0.0; 4]), tip_m);
            println!("{radius_mm} mm, {}: {:.2} µm", rung.name(), off_m * 1e6);
            assert!(off_m < 10e-6, "{radius_mm} mm, {rung:?}: {off_m}");
        }
    }
}

/// Two arcs: every tendon bends the proximal one, only those to the tip the distal one. A flexure settles
/// where `k q = d T cos(q/2)`.
#[test]
fn two_segments_come_to_two_arcs() {
    let p = described("two_segments.toml");
    let k = p.joint_stiffness_nm_per_rad[11];
    for tension_n in [[3.0, 0.0, 0.0, 0.0], [0.0, 4.0, 6.0, 0.0], [4.0, 0.0, 0.0, 8.0]] {
        let moment = |tendons: &[f64]| {
            tendons
                .iter()
                .enumerate()
                .map(|(t, n)| if t % 2 == 0 { 2.5e-3 * n } else { -2.5e-3 * n })
                .sum::<f64>()
        };
        let angle = |moment: f64| (0..50).fold(0.0_f64, |q, _| moment / k * (0.5 * q).cos());
        let bends = [angle(moment(&tension_n)), angle(moment(&tension_n[..2]))];
        let (start_m, pitch_m) = (36.0e-3 - 0.65e-3, 1.3e-3);
        let two = bends.map(|bend| [12.0 * pitch_m, 12.0 * bend]);
        let tip_m = arcs(start_m, &two, p.tip_offset_m - 0.5 * pitch_m);
        for rung in [Rung::Planar, Rung::Spatial, Rung::Full] {
            let mut p = p.clone();
            // All flexures alike, which is not quite true for the first and the last; no compression or
            // shear.
            p.joint_stiffness_nm_per_rad = vec![k; 24];
            p.section = simulation::manipulator::Section::Tube;
            p.tube_radii_m = [1e-5, 0.0];
            let tool = settled(rung, p, tension_n);
            let off_m = distance_m(&tool, tip_m);
            println!("{tension_n:?}, {}: {:.2} µm", rung.name(), off_m * 1e6);
            // A chain of 24 hinges against arcs: its error, relative to the length, is bend² / (24 n²).
            assert!(off_m < 10e-6, "{tension_n:?}, {rung:?}: {off_m}");
        }
    }
}

/// The same tool with a drive shaft of E I = 3.181e-4 N m^2: `(k + E I / L) q = d T cos(q/2)`.
#[test]
fn a_drive_shaft_stiffens_each_flexure_by_ei_over_its_length() {
    let (bending_nm2, pitch_m, d) = (3.181e-4, 1.3e-3, 2.5e-3);
    let keys = format!("[drive_shaft]\nbending_stiffness_nm2 = {bending_nm2:e}\n");
    let (tube, p) = (described("two_segments.toml"), described_with("two_segments.toml", &keys));
    let (Section::Ratios(without), Section::Ratios(with)) = (&tube.section, &p.section) else { panic!() };
    for flexure in 0..24 {
        let [own, whole] = [&tube, &p].map(|p| p.joint_stiffness_nm_per_rad[flexure]);
        assert!((whole / (own + bending_nm2 / pitch_m) - 1.0).abs() < 1e-12, "{flexure}");
        let across = own * without[flexure].lateral + bending_nm2 / pitch_m;
        assert!((whole * with[flexure].lateral / across - 1.0).abs() < 1e-12, "{flexure}");
        // It rotates and slides in the tube.
        assert!((whole * with[flexure].torsion / (own * without[flexure].torsion) - 1.0).abs() < 1e-12);
        let [a, b] = [own * without[flexure].axial_per_m2, whole * with[flexure].axial_per_m2];
        assert!((a / b - 1.0).abs() < 1e-12);
    }
    let k = tube.joint_stiffness_nm_per_rad[11] + bending_nm2 / pitch_m;
    for tension_n in [2.0, 5.0, 8.0] {
        let bend = (0..50).fold(0.0_f64, |q, _| d * tension_n / k * (0.5 * q).cos());
        let tip_m =
            arcs(36.0e-3 - 0.5 * pitch_m, &[[24.0 * pitch_m, 24.0 * bend]], p.tip_offset_m - 0.5 * pitch_m);
        // Neither supports tendons that end partway.
        let refuse = |rung: &Rung| matches!(rung, Rung::ConstantCurvature | Rung::Modal);
        for rung in Rung::ALL.into_iter().filter(|rung| !refuse(rung)) {
            let mut p = p.clone();
            // As in `two_segments_come_to_two_arcs`; the flexures keep the shaft's stiffness.
            p.joint_stiffness_nm_per_rad = vec![p.joint_stiffness_nm_per_rad[11]; 24];
            p.section = Section::Tube;
            p.tube_radii_m = [1e-5, 0.0];
            let off_m = distance_m(&settled(rung, p, [tension_n, 0.0, 0.0, 0.0]), tip_m);
            let whole_deg = 24.0 * bend.to_degrees();
            println!("{tension_n} N, {}: {whole_deg:.2} degrees, off {:.2} µm", rung.name(), off_m * 1e6);
            assert!(off_m < 10e-6, "{tension_n} N, {rung:?}: {off_m}");
        }
    }
}

/// A straight shaft in a pre-curved tube: they settle on a wider circle, where their moments cancel.
#[test]
fn a_drive_shaft_straightens_a_pre_curved_tool() {
    let (bending_nm2, length_m) = (2e-2, 1.25e-3);
    let keys = format!("[drive_shaft]\nbending_stiffness_nm2 = {bending_nm2:?}\n");
    let own = described("steerable_drill.toml").joint_stiffness_nm_per_rad[0];
    let bend = length_m / 0.05 * own / (own + bending_nm2 / length_m);
    let p = described_with("steerable_drill.toml", &keys);
    let tip_m = arcs(0.04, &[[0.04, 32.0 * bend]], p.tip_offset_m - 0.5 * length_m);
    for rung in Rung::ALL {
        let off_m = distance_m(&settled(rung, p.clone(), [0.0; 4]), tip_m);
        println!("radius {:.2} mm, {}: {:.2} µm", 1e3 * length_m / bend, rung.name(), off_m * 1e6);
        assert!(off_m < 10e-6, "{rung:?}: {off_m}");
    }
}

#[test]
fn a_drive_shaft_that_cannot_be_is_refused_by_its_key() {
    let text = std::fs::read_to_string(folder().join("two_segments.toml")).unwrap();
    for (keys, key) in [
        ("friction_torque_nmm = 5.0\nstall_torque_nmm = 5.0", "drive_shaft.friction_torque_nmm"),
        ("torsional_stiffness_nm2 = 1e-9", "drive_shaft.torsional_stiffness_nm2"),
        ("bending_stiffness_nm2 = -1.0", "drive_shaft.bending_stiffness_nm2"),
    ] {
        let text = format!("{text}\n[drive_shaft]\n{keys}\n");
        let said = ToolDescription::parse(&text, Path::new("shaft.toml")).unwrap_err().to_string();
        assert!(said.contains(&format!("`{key}`")), "{said}");
    }
    let solid = text.replace("inner_diameter_mm = 4.0", "inner_diameter_mm = 0.0");
    let solid = solid.replace("drive_cable_diameter_mm = 2.0", "") + "\n[drive_shaft]\n";
    let said = ToolDescription::parse(&solid, Path::new("shaft.toml")).unwrap_err().to_string();
    assert!(said.contains("`drive_shaft`") && said.contains("lumen"), "{said}");
}

#[test]
fn one_arc_refuses_what_bends_in_part() {
    let base = BaseMotion::at_rest(Isometry3::identity());
    let refused = AnyManipulator::new(Rung::ConstantCurvature, described("two_segments.toml"), &base);
    let said = refused.unwrap_err().to_string();
    assert!(said.contains("`tendon_routes.reach` is 12") && said.contains("constant_curvature"), "{said}");
    let links = described("two_segments.toml").with_links(8).unwrap();
    assert_eq!(links.tendon_routes.unwrap()[2].reach.to, Some(4));
    let said = described("two_segments.toml").with_links(9).unwrap_err().to_string();
    assert!(said.contains("`links` is 9"), "{said}");
}

/// A pre-curved tool with as many links as flexures, and with half as many, keeps its bend.
#[test]
fn links_share_the_rest_angles() {
    let p = described("steerable_drill.toml");
    let whole: f64 = p.joint_rest_rad.iter().sum();
    for links in [8, 16, 32] {
        let shared: f64 = p.with_links(links).unwrap().joint_rest_rad.iter().sum();
        assert!((shared - whole).abs() < 1e-12, "{links}: {shared}, {whole}");
    }
}

/// Pulled lengths are measured from the tool's rest shape: nothing pulls on a slack pre-curved tool.
#[test]
fn a_pulled_length_is_measured_from_the_rest_shape() {
    let mut p = described("steerable_drill.toml");
    p.tendon_routes = Some(vec![[1.5e-3, 0.0].into(), [-1.5e-3, 0.0].into()]);
    let base = BaseMotion::at_rest(Isometry3::identity());
    let tendon = TendonCommand::EachDisplacement([0.0; 4]);
    let input = StepInput { base, tendon, tip_wrench: Wrench::zero(), contacts: &[] };
    for rung in Rung::ALL {
        let mut tool = AnyManipulator::new(rung, p.clone(), &base).unwrap();
        let start = tool.t_world_tip();
        for _ in 0..100 {
            tool.step(1e-3, &input).unwrap();
        }
        let moved_m = (tool.t_world_tip().translation.vector - start.translation.vector).norm();
        assert!(moved_m < 1e-9, "{rung:?}: {moved_m}");
        assert!(tool.tendon_tensions_n().iter().all(|n| n.abs() < 1e-6), "{rung:?}");
    }
}

/// `k = E I / length` of a round tube, and `E` times the stiffness of the notches at 1 Pa.
#[test]
fn stiffness_follows_from_the_tube_and_from_the_notches() {
    let tube = described("rigid_drill.toml");
    let by_hand = 200e9 * core::f64::consts::PI / 64.0 * 4.5e-3_f64.powi(4) / 4.5e-3;
    assert!((tube.joint_stiffness_nm_per_rad[3] / by_hand - 1.0).abs() < 1e-12);
    let notched = described("two_segments.toml");
    let unit = simulation::manipulator::Notch::JHU.unit_stiffness(1.3e-3, [3e-3, 2e-3], 0.33);
    assert!((notched.joint_stiffness_nm_per_rad[11] / (28.5e9 * unit.bending_nm_per_rad) - 1.0).abs() < 1e-9);
}

#[test]
fn every_shipped_tool_stands() {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder()).unwrap().map(|it| it.unwrap().path()).collect();
    files.sort();
    assert_eq!(files.len(), 6);
    for file in files {
        let tool = ToolDescription::parse(&std::fs::read_to_string(&file).unwrap(), &file).unwrap();
        assert_eq!(tool.name, file.file_stem().unwrap().to_str().unwrap());
        let p = described(file.file_name().unwrap().to_str().unwrap());
        AnyManipulator::new(Rung::Full, p, &BaseMotion::at_rest(Isometry3::identity())).unwrap();
    }
}

/// Two tendons; `own` holds further keys of each, `cable` those of both.
fn two_tendons(own: [&str; 2], cable: &str) -> ManipulatorParameters {
    let text = format!(
        "name = \"two\"\ntube = {{ outer_diameter_mm = 6.0, inner_diameter_mm = 4.0, linear_density_kg_per_m \
         = 0.1 }}\n\
         burr = {{ diameter_mm = 6.5, offset_mm = 4.0, mass_g = 1.0 }}\n[tendon_cable]\n{cable}\n[[tendon]]\n\
         toward_mm = 2.5\n{}\n\
         [[tendon]]\ntoward_mm = -2.0\n{}\n[[flexure]]\nat_mm = 36.0\ncount = 12\npitch_mm = 2.5\n\
         stiffness_nm_per_deg = 0.01\n",
        own[0], own[1]
    );
    let mut scene = scene("");
    scene.manipulator.tool = Some(ToolDescription::parse(&text, Path::new("two.toml")).unwrap());
    manipulator_parameters(&scene).unwrap()
}

/// Flexure angles and pulled lengths after 300 ms of a pull on one tendon that rises and falls.
fn pulled(rung: Rung, p: &ManipulatorParameters, tendon: usize, is_length: bool) -> (Vec<f64>, [f64; 4]) {
    let mut tool = AnyManipulator::new(rung, p.clone(), &BaseMotion::at_rest(Isometry3::identity())).unwrap();
    for tick in 0..300 {
        let mut each = [0.0; 4];
        each[tendon] = if tick < 150 { 5.0 } else { 3.0 };
        let tendon = if is_length {
            // The other tendon is let out, so that it stays slack.
            TendonCommand::EachDisplacement(each.map(|pull| if pull > 0.0 { pull * 4e-4 } else { -5e-3 }))
        } else {
            TendonCommand::EachForce(each)
        };
        let base = BaseMotion::at_rest(Isometry3::identity());
        tool.step(1e-3, &StepInput { base, tendon, tip_wrench: Wrench::zero(), contacts: &[] }).unwrap();
    }
    (tool.joint_positions_rad().to_vec(), tool.last_report().tendon_displacement_m)
}

/// A tendon with its own friction and stiffness moves the tool bit for bit as if all tendons had them; it
/// stretches by tension over stiffness.
#[test]
fn a_tendon_with_friction_and_stiffness_of_its_own_pulls_as_if_all_had_them() {
    let mixed = two_tendons(["friction = 0.3\nstiffness_n_per_m = 2e4", "stiffness_n_per_m = 5e4"], "");
    let alone = [
        two_tendons(["", ""], "friction = 0.3\nstiffness_n_per_m = 2e4"),
        two_tendons(["", ""], "friction = 0.0\nstiffness_n_per_m = 5e4"),
    ];
    for rung in Rung::ALL {
        for (tendon, alone) in alone.iter().enumerate() {
            for is_length in [false, true] {
                let (own, all) =
                    (pulled(rung, &mixed, tendon, is_length), pulled(rung, alone, tendon, is_length));
                assert_eq!(own.0, all.0, "{rung:?}, tendon {tendon}");
                assert_eq!(own.1[tendon], all.1[tendon], "{rung:?}, tendon {tendon}");
            }
        }
        // The same shape with a tendon that stretches by at most 3 nm: the lengths differ by the stretch.
        let stiff = two_tendons(["", ""], "stiffness_n_per_m = 1e9");
        let stretch_m = pulled(rung, &mixed, 1, false).1[1] - pulled(rung, &stiff, 1, false).1[1];
        assert!((stretch_m - 3.0 / 5e4).abs() < 4e-9, "{rung:?}: {stretch_m}");
        // Based on the tension that remains after friction.
        let (rough, smooth) = (pulled(rung, &mixed, 0, false).0, pulled(rung, &alone[1], 0, false).0);
        assert_ne!(rough, smooth, "{rung:?}: the friction does nothing");
    }
    // A scene's friction applies to every tendon.
    let mut over = scene("tendon_friction = 0.1");
    let text = "name = \"t\"\ntube = { outer_diameter_mm = 6.0, inner_diameter_mm = 4.0, \
                linear_density_kg_per_m = 0.1 }\n\
                burr = { diameter_mm = 6.5, offset_mm = 4.0, mass_g = 1.0 }\n\
                tendon = [{ toward_mm = 2.0, friction = 0.5 }]\n\
                [[flexure]]\nat_mm = 36.0\nstiffness_nm_per_deg = 0.01\n";
    over.manipulator.tool = Some(ToolDescription::parse(text, Path::new("t.toml")).unwrap());
    let over = manipulator_parameters(&over).unwrap();
    assert_eq!(over.tendon.friction_coefficient, 0.1);
    assert_eq!(over.tendon_routes.unwrap()[0].friction_coefficient, None);
}
