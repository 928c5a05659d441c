//! Tests of refusals beyond fixed ranges: limits set by other keys, and values with alternative forms.
#![allow(clippy::unwrap_used, reason = "a test fails by it")]

use std::path::Path;

use scene::{Scene, keys_without_effect, whole_steps};

const LEAST: &str = r#"
name = "relations"
[run]
mode = "lockstep"
duration_s = 1.0
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
"#;

const DRR: &str = "[volume]\nphantom = \"block\"\n[drr]\nrate_hz = 0\nisocentre_mm = [0, 0, 0]\ncolumns = \
                   16\nrows = 16\npixel_pitch_mm = 1\n";

fn parsed(more: &str) -> Result<Scene, String> {
    Scene::parse(&format!("{LEAST}{more}"), Path::new("a.toml")).map_err(|error| error.to_string())
}

fn sweep(keys: &str) -> String {
    format!("[[controller]]\nname = \"a\"\ndrives = [\"tendon\"]\ntension_sweep = {{ {keys} }}\n")
}

fn drilling(keys: &str) -> String {
    let others =
        "feed_mm_per_s = 1, insertion_mm = 9, tension_n = 1, burr_speed_rpm = 1, feedback = \"none\"";
    format!("[[controller]]\nname = \"a\"\ndrives = []\ncurved_drilling = {{ {others}, {keys} }}\n")
}

#[test]
fn a_range_that_another_key_narrows_is_said_as_it_holds_in_this_scene() {
    let upper = |angle: &str| format!("[arm]\nupper_joints_deg = [{}]\n", [angle; 6].join(", "));
    let start = |angle: &str| format!("[arm]\ninitial_joints_deg = [{}]\n", [angle; 6].join(", "));
    let cases = [
        (
            sweep("most_n = 5, step_n = 5"),
            sweep("most_n = 5, step_n = 6"),
            "controller.tension_sweep.step_n` is 6; allowed: 0.01 to 5",
        ),
        (
            sweep("most_mm = 1, step_mm = 0.5"),
            sweep("most_mm = 1, step_mm = 1.5"),
            "controller.tension_sweep.step_mm` is 1.5; allowed: 0.001 to 1",
        ),
        (
            drilling("ramp_start_mm = 5, ramp_end_mm = 5"),
            drilling("ramp_start_mm = 5, ramp_end_mm = 4"),
            "controller.curved_drilling.ramp_end_mm` is 4; allowed: 5 to 200",
        ),
        (upper("90"), upper("-359.9999"), "arm.upper_joints_deg` is -359.9999; allowed: -359.999 to 360"),
        (start("-90"), start("181"), "arm.initial_joints_deg` is 181; allowed: -180 to 180"),
        (
            format!("{DRR}source_isocentre_mm = 900\nsource_detector_mm = 900\n"),
            format!("{DRR}source_isocentre_mm = 900\nsource_detector_mm = 800\n"),
            "drr.source_detector_mm` is 800; allowed: 900 to 3000",
        ),
        (
            format!("{DRR}photons_per_pixel = 1\n"),
            format!("{DRR}photons_per_pixel = 0.5\n"),
            "drr.photons_per_pixel` is 0.5; allowed: 1 to 100000000",
        ),
        (
            format!("{DRR}labels = {{ bone_from_hu = 3000 }}\n"),
            format!("{DRR}labels = {{ bone_from_hu = 3001 }}\n"),
            "drr.labels.bone_from_hu` is 3001; allowed: -1000 to 3000",
        ),
    ];
    for (allowed, refused, words) in cases {
        assert_eq!(parsed(&allowed).err(), None);
        assert_eq!(parsed(&refused).unwrap_err(), format!("a.toml: `{words}"));
    }
}

/// Each value is checked against its own range before relations are checked, so that the closer cause is
/// named.
#[test]
fn a_value_out_of_its_own_range_is_named_before_what_it_is_in_relation_to() {
    let said = parsed(&sweep("most_n = 500, step_n = 600")).unwrap_err();
    assert_eq!(said, "a.toml: `controller.tension_sweep.most_n` is 500; allowed: 0.1 to 60");
}

/// Regression: the message was "data did not match any variant of untagged enum Label".
#[test]
fn a_label_of_another_form_is_refused_with_the_two_that_it_may_have() {
    let mask = |label: &str| format!("[volume]\npath = \"a.nrrd\"\nmask = true\nlabel = {label}\n");
    for allowed in ["-32768", "32767", "\"femur\""] {
        assert_eq!(parsed(&mask(allowed)).err(), None);
    }
    for refused in ["32768", "1.5", "true"] {
        let said = parsed(&mask(refused)).unwrap_err();
        assert!(said.ends_with(": expected an integer of -32768 to 32767, or a segment's name"), "{said}");
    }
}

/// Only a tool with an outer tube has a tube to drive, within its drive's travel and speed.
#[test]
fn a_tube_is_driven_where_there_is_one_and_within_its_travel() {
    const TUBES: &str = "[manipulator.tool]\nname = \"tubes\"\n[manipulator.tool.tube]\nouter_diameter_mm = \
                         3.6\ninner_diameter_mm = 3.1\n\
        linear_density_kg_per_m = 0.03\nyoungs_modulus_gpa = 15\n[manipulator.tool.outer_tube]\nend_mm = \
        50\nouter_diameter_mm = 4.5\n\
        inner_diameter_mm = 3.7\ntravel_mm = 20\nspeed_mm_per_s = 5\n[manipulator.tool.burr]\ndiameter_mm = \
        4\noffset_mm = 3\nmass_g = 1\n\
        [[manipulator.tool.flexure]]\nat_mm = 30\ncount = 10\npitch_mm = 2\n";
    let controller = |keys: &str| format!("[[controller]]\nname = \"a\"\ndrives = [\"tube\"]\n{keys}\n");
    let deployment = |keys: &str| {
        controller(&format!(
            "tube_deployment = {{ burr_speed_rpm = 1, feed_mm_per_s = 1, deployed_mm = 9, {keys} }}"
        ))
    };
    assert!(parsed(&format!("{TUBES}{}", deployment("roll_deg = -360"))).is_ok());
    for (text, said) in [
        (deployment("roll_deg = 0"), "`controller.tube_deployment` needs a tool with `outer_tube`"),
        (
            controller("external = true"),
            "`controller.drives` lists `tube`, which needs a tool with `outer_tube`",
        ),
        (
            format!("{TUBES}{}", deployment("roll_deg = 0").replace("deployed_mm = 9", "deployed_mm = 21")),
            "`controller.tube_deployment.deployed_mm` is 21; allowed: 0 to 20",
        ),
        (
            format!(
                "{TUBES}{}",
                deployment("roll_deg = 0").replace("feed_mm_per_s = 1", "feed_mm_per_s = 6")
            ),
            "`controller.tube_deployment.feed_mm_per_s` is 6; allowed: 0.01 to 5",
        ),
        (
            format!("{TUBES}{}", deployment("retraction_mm = 10")),
            "`controller.tube_deployment.retraction_mm` is 10; allowed: 0 to 9",
        ),
        (
            format!("[manipulator]\nmodel = \"constant_curvature\"\n{TUBES}"),
            "`tubes` slides out of a tube that holds it straight; expected planar, spatial or full",
        ),
    ] {
        let refused = parsed(&text).unwrap_err();
        assert!(refused.contains(said), "{refused}\nis not\n{said}");
    }
}

#[test]
fn keys_of_another_phantom_and_of_a_holder_that_is_not_there_change_nothing() {
    let vain = |more: &str| -> Vec<&str> {
        keys_without_effect(&parsed(more).unwrap()).map(|(key, _)| key).collect()
    };
    let ratio = "block_density_ratio = 2.0\n";
    assert_eq!(vain(&format!("[volume]\nphantom = \"femur\"\n{ratio}")), ["volume.block_density_ratio"]);
    assert!(vain(&format!("[volume]\nphantom = \"block\"\n{ratio}")).is_empty());
    let holder = "[arm]\nholder_length_mm = 30.0\nholder_diameter_mm = 20.0\n";
    assert_eq!(vain(holder), ["arm.holder_length_mm", "arm.holder_diameter_mm"]);
    assert!(vain(&format!("{holder}tool_position_mm = [0.0, 0.0, 100.0]\n")).is_empty());
}

#[test]
fn a_cable_without_tendons_changes_nothing() {
    let vain = |name: &str, more: &str| -> Vec<&str> {
        let tools = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/tools");
        let text = format!("{LEAST}[manipulator]\nfile = \"{name}.toml\"\n");
        let read = |file: &Path| Ok(std::fs::read_to_string(file)? + more);
        let scene = Scene::parse_with(&text, &tools.join("scene.toml"), &read).unwrap();
        keys_without_effect(&scene).map(|(key, _)| key).collect()
    };
    assert_eq!(vain("rigid_drill", "[tendon_cable]\nfriction = 0.3\n"), ["manipulator.tool.tendon_cable"]);
    assert!(vain("rigid_drill", "").is_empty() && vain("jhu_27", "").is_empty());
}

#[test]
fn keys_of_an_fmu_are_checked_with_each_other() {
    let controller = |keys: &str| format!("[[controller]]\nname = \"a\"\ndrives = []\n{keys}\n");
    let fmu = "fmu = \"b.fmu\"\n";
    let scene = parsed(&controller(&format!("{fmu}step_ms = 3.0\noptional = true\nrestarts = 2"))).unwrap();
    assert!(scene.controller[0].fmu.as_ref().unwrap().is_absolute());
    assert_eq!(whole_steps(scene.controller[0].step_ms.unwrap(), scene.run.dt_ms), Some(3));
    let refused = [
        (
            "hold = { tension_n = 1 }\ninputs = { y = \"bend_rad\" }".to_owned(),
            "`controller.inputs` applies only",
        ),
        ("hold = { tension_n = 1 }\nstep_ms = 1.0".to_owned(), "`controller.step_ms` applies only"),
        (format!("{fmu}command = [\"x\"]"), "needs exactly one of"),
        (format!("{fmu}step_ms = 1.5"), "`controller.step_ms` is 1.5; expected a multiple of `run.dt_ms`, 1"),
        (format!("{fmu}step_ms = 0.5"), "`controller.step_ms` is 0.5; expected a multiple of `run.dt_ms`, 1"),
        (
            format!("{fmu}outputs = {{ tendon_mode = \"u\" }}\nconstants = {{ tendon_mode = 1 }}"),
            "`constants` both set `tendon_mode`",
        ),
        (format!("{fmu}parameters = {{ gain = inf }}"), "sets `gain` to inf; expected a finite number"),
        (format!("{fmu}sensors = [\"a\"]"), "`controller.sensors` applies only to a built-in controller"),
        (format!("{fmu}inputs = {{ y = 1 }}"), "invalid type: integer `1`"),
    ];
    for (keys, part) in refused {
        let error = parsed(&controller(&keys)).unwrap_err();
        assert!(error.contains(part), "{keys}: {error}");
    }
}

#[test]
fn a_driven_body_has_one_driver_that_suits_its_motion() {
    let body = |name: &str, motion: &str| {
        format!(
            "[[body]]\nname = \"{name}\"\nball = {{ radius_mm = 1 }}\nmotion = \"{motion}\"\nposition_mm = [0, 0, 50]\n"
        )
    };
    let driver =
        |name: &str, keys: &str| format!("[[controller]]\nname = \"{name}\"\ndrives = [\"body\"]\n{keys}\n");
    let all = [body("table", "driven"), body("bone", "free"), body("clamp", "fixed")].concat();
    let of = |drivers: &[String]| parsed(&format!("{all}{}", drivers.concat()));
    let table = driver("a", "external = true\nbody = \"table\"");
    let bone = driver("b", "external = true\nbody = \"bone\"");
    assert!(of(&[table.clone(), bone.clone()]).is_ok(), "every body can have a driver of its own");
    let fmu = |body: &str, mode: u32| {
        driver("b", &format!("body = \"{body}\"\nfmu = \"f.fmu\"\nconstants = {{ body_mode = {mode} }}"))
    };
    assert!(of(&[table.clone(), fmu("bone", 1)]).is_ok() && of(&[fmu("table", 2)]).is_ok());
    let cases = [
        (vec![bone], "`body.motion` of `table` is \"driven\", but no `controller.body` names it"),
        (vec![table.clone(), table.replace("\"a\"", "\"c\"")], "body `table` is driven by both `a` and `c`"),
        (
            vec![table.clone(), driver("b", "external = true")],
            "`controller.body` is missing, but `drives` lists `body`",
        ),
        (
            vec![table.clone(), driver("b", "external = true\nbody = \"ball\"")],
            "`controller.body` is `ball`; expected the name of a `[[body]]`: [\"table\", \"bone\", \"clamp\"]",
        ),
        (
            vec![table.replace("\"table\"", "\"tables\"")],
            "`controller.body` is `tables` (did you mean `table`?); expected the name of a `[[body]]`: \
             [\"table\"",
        ),
        (
            vec![table.clone(), driver("b", "external = true\nbody = \"clamp\"")],
            "`controller.body` is `clamp`, whose `motion` is \"fixed\"",
        ),
        (
            vec![table.replace("drives = [\"body\"]", "drives = [\"burr\"]")],
            "applies only to a controller whose `drives` lists `body`",
        ),
        (vec![table, fmu("bone", 2)], "servo_cp (`body_mode = 2`) needs \"driven\""),
        (vec![fmu("table", 1)], "servo_cf (`body_mode = 1`) needs \"free\""),
    ];
    for (drivers, part) in cases {
        let error = of(&drivers).unwrap_err();
        println!("{error}");
        assert!(error.contains(part), "{error}");
    }
}

#[test]
fn objects_of_the_x_ray_have_one_sound_shape_and_a_name_of_their_own() {
    let object = |shape: &str| format!("[[drr.object]]\nname = \"a\"\nmaterial = \"steel\"\n{shape}\n");
    let cylinder =
        |more: &str| object(&format!("cylinder = {{ start_mm = [0, 0, 0], radius_mm = 1, {more} }}"));
    let ball = object("balls = { radius_mm = 1 }");
    let scene = parsed(&format!("{DRR}{ball}")).unwrap();
    assert_eq!(scene.drr.unwrap().object[0].balls.as_ref().unwrap().centres_mm, [[0.0; 3]]);
    for (objects, problem) in [
        (object(""), "`drr.object `a`` needs exactly one of `balls`, `cylinder`, `cuboid`, `mesh`"),
        (
            object("balls = { radius_mm = 1 }\ncuboid = { half_extents_mm = [1, 1, 1] }"),
            "needs exactly one of",
        ),
        (format!("{ball}{ball}"), "drr.object.name` has a duplicate: `a`"),
        (object("balls = { radius_mm = 1, centres_mm = [[0, 2e5, 0]] }"), "within 100000 mm"),
        (cylinder("end_mm = [0, 0, 0]"), "`drr.object `a`.cylinder` is 0 mm long; expected at least 0.001"),
        (object("balls = { radius_mm = 1, centres_mm = [] }"), "`drr.object.balls.centres_mm (count)` is 0"),
        (
            format!(
                "{}{}",
                object("balls = { radius_mm = 1, centres_mm = [[0, 0, 0], [9, 0, 0]] }"),
                ball.replace("\"a\"", "\"a_2\"")
            ),
            "gives two balls the name `a_2`",
        ),
        (
            "photons_per_pixel = 50\ngrid = { primary_transmission = 0.01, scatter_transmission = 0.0 }\n"
                .to_owned(),
            "`drr.photons_per_pixel` times `drr.grid.primary_transmission` is 0.5; expected at least 1",
        ),
        (cylinder("end_mm = [0, 0, 9], inner_radius_mm = 1"), "is 1; expected less than `radius_mm`, 1"),
        (cylinder("end_mm = [0, 0, 9], inner_radius_mm = -1"), "allowed: 0 to 1000"),
        (object("balls = { radius_mm = 1 }\nattached = \"head\""), "anatomy"),
        (ball.replace("steel", "gold"), "tantalum"),
    ] {
        let refused = parsed(&format!("{DRR}{objects}")).unwrap_err();
        assert!(refused.contains(problem), "{refused}");
    }
    let body = "[[body]]\nname = \"b\"\nmotion = \"fixed\"\nposition_mm = [0, 0, 0]\n\
                ball = { radius_mm = 1 }\n\
                material = \"lead\"\n";
    let vain =
        |text: &str| -> Vec<_> { keys_without_effect(&parsed(text).unwrap()).map(|(key, _)| key).collect() };
    assert_eq!(vain(body), ["body.material"]);
    assert!(vain(&format!("{body}{DRR}")).is_empty());
    let grid = "[drr.grid]\nprimary_transmission = 0.7\nscatter_transmission = 0.1\n";
    assert_eq!(vain(&format!("{DRR}{grid}")), ["drr.grid"]);
    assert!(vain(&format!("{DRR}{grid}[drr.scatter]\nmodel = \"kernel\"\n")).is_empty());
    assert!(vain(&format!("{DRR}photons_per_pixel = 9\n{grid}")).is_empty());
}
