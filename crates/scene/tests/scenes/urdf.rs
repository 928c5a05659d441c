//! Tests of scenes whose arm comes from a URDF file.
#![allow(clippy::unwrap_used, reason = "a test fails by it")]

use std::path::Path;

use scene::{Scene, SceneError};

const SCENE: &str = "name = \"a\"
[run]
mode = \"lockstep\"
duration_s = 1.0
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [1.0, 0.0, 0.0]
bend_toward = [0.0, 0.0, 1.0]
[arm]
urdf = \"arms/six.urdf\"
initial_joints_deg = [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]
";

/// Six revolute joints, a flange, and a gripper finger beside it that is not part of the arm.
fn six() -> String {
    let links = (0..=6).map(|i| format!("<link name=\"l{i}\"/>")).collect::<String>();
    let joints = (1..=6).map(|i| {
        let above = i - 1;
        format!(
            "<joint name=\"j{i}\" type=\"revolute\"><parent link=\"l{above}\"/><child link=\"l{i}\"/>\
             <origin xyz=\"0 0 0.{i}\" rpy=\"0 0 1.5707963267948966\"/><axis xyz=\"0 {i} 1\"/>\
             <limit lower=\"-1.5\" upper=\"2.5\" velocity=\"3.0\" effort=\"1\"/></joint>\n"
        )
    });
    format!(
        "<?xml version=\"1.0\"?><!-- by hand --><robot name=\"six\">{links}<link name=\"flange\"/><link \
         name=\"finger\"/>{}\
         <joint name=\"mount\" type=\"fixed\"><parent link=\"l6\"/><child link=\"flange\"/><origin \
         xyz=\"0.01 0.02 0.03\"/></joint>\
         <joint name=\"grip\" type=\"prismatic\"><parent link=\"flange\"/><child link=\"finger\"/></joint>\
         <transmission><joint name=\"j1\"/></transmission></robot>",
        joints.collect::<String>()
    )
}

fn parse(keys: &str, urdf: &str) -> Result<Scene, SceneError> {
    let read = |path: &Path| {
        assert_eq!(path, Path::new("/scenes/arms/six.urdf"), "relative to the scene's file");
        Ok(urdf.to_owned())
    };
    Scene::parse_with(&format!("{SCENE}{keys}"), Path::new("/scenes/a.toml"), &read)
}

const TIP: &str = "tip_link = \"flange\"\n";

#[test]
fn an_arm_follows_from_its_file_and_the_scene_names_none() {
    let scene = parse(TIP, &six()).unwrap();
    assert_eq!(
        (&scene.arm.urdf, &scene.arm.tip_link),
        (&None, &None),
        "what a log keeps needs no other file"
    );
    let joints = scene.arm.joint.as_ref().unwrap();
    let names: Vec<&str> = joints.iter().map(|joint| joint.name.as_str()).collect();
    assert_eq!(names, ["j1", "j2", "j3", "j4", "j5", "j6", "mount"]);
    assert_eq!((joints[1].position_mm, joints[1].axis), ([0.0, 0.0, 200.0], Some([0.0, 2.0, 1.0])));
    assert!((joints[1].roll_pitch_yaw_deg[2] - 90.0).abs() < 1e-12);
    assert!((joints[1].lower_deg.unwrap() - (-1.5_f64).to_degrees()).abs() < 1e-12);
    assert_eq!((joints[6].position_mm, joints[6].axis), ([10.0, 20.0, 30.0], None));
    // As in a log: the text of the scene itself, without any file.
    let text = toml::to_string(&scene).unwrap();
    assert_eq!(Scene::parse(&text, Path::new("/elsewhere/a.toml")).unwrap().arm, scene.arm);
}

/// Universal Robots' own description ends its ranges at 6.28318530718, which is 360.00000000002 degrees.
/// Regression: files with extensions of Drake or Gazebo, whose prefixes they do not declare, were no XML.
#[test]
fn prefixes_of_extensions_need_no_declaration() {
    let extended = six()
        .replace("<link name=\"l1\"/>", "<link name=\"l1\"><drake:proximity drake:soft=\"1\"/></link>")
        .replace("<transmission>", "<gz:plugin/><transmission>");
    assert!(extended.contains("drake:") && extended.contains("gz:"));
    assert_eq!(parse(TIP, &extended).unwrap().arm.joint, parse(TIP, &six()).unwrap().arm.joint);
    let many: String = (0..40).map(|i| format!("<p{i}:a/>")).collect();
    let said = parse(TIP, &six().replace("<transmission>", &format!("{many}<transmission>"))).unwrap_err();
    assert!(said.to_string().contains("unknown namespace prefix 'p16'"), "{said}");
}

#[test]
fn a_range_that_ends_just_beyond_a_turn_is_taken() {
    let wide =
        six().replace("lower=\"-1.5\" upper=\"2.5\"", "lower=\"-6.28318530718\" upper=\"6.28318530718\"");
    let joints = parse(TIP, &wide).unwrap().arm.joint.unwrap();
    assert!(joints[0].upper_deg.unwrap() > 360.0);
    let error =
        parse(&format!("{TIP}upper_joints_deg = [400.0, 1.0, 1.0, 1.0, 1.0, 1.0]\n"), &wide).unwrap_err();
    assert!(error.to_string().contains("400; allowed: -360 to 360"), "{error}");
}

#[test]
fn a_joint_that_turns_without_end_has_a_turn_each_way() {
    let endless = six().replacen("type=\"revolute\"", "type=\"continuous\"", 1);
    let endless = endless.replacen("lower=\"-1.5\" upper=\"2.5\" ", "", 1);
    let joints = parse(TIP, &endless).unwrap().arm.joint.unwrap();
    assert_eq!((joints[0].lower_deg, joints[0].upper_deg), (Some(-360.0), Some(360.0)));
}

/// Regression: an arm was refused for a continuous joint without limits, and for a speed of 0 or without
/// bound, which exporters write for an unknown one.
#[test]
fn a_joint_of_no_stated_speed_has_the_usual_one() {
    let endless = six().replacen("type=\"revolute\"", "type=\"continuous\"", 1);
    let limit = "<limit lower=\"-1.5\" upper=\"2.5\" velocity=\"3.0\" effort=\"1\"/>";
    let with = |velocity: &str| six().replacen("velocity=\"3.0\"", &format!("velocity=\"{velocity}\""), 1);
    let effort = endless.replacen(limit, "<limit effort=\"1\"/>", 1);
    let files = [endless.replacen(limit, "", 1), effort, with("0"), with("0.0"), with("1e6"), with("inf")];
    for file in files {
        let joints = parse(TIP, &file).unwrap().arm.joint.unwrap();
        let speeds = [0, 1].map(|joint: usize| joints[joint].max_speed_deg_per_s.unwrap());
        assert!((speeds[0] - 180.0).abs() < 1e-9 && (speeds[1] - 171.887).abs() < 1e-3, "{speeds:?}");
    }
}

#[test]
fn what_cannot_stand_is_refused_with_file_joint_value_and_what_was_expected() {
    let said = |keys: &str, urdf: &str, words: &[&str]| {
        let error = parse(keys, urdf).unwrap_err().to_string();
        for word in ["a.toml"].iter().chain(words) {
            assert!(error.contains(word), "no `{word}` in: {error}");
        }
    };
    let file = |from: &str, to: &str| six().replacen(from, to, 1);
    let arm = ["arm.urdf", "/scenes/arms/six.urdf"];
    let of_file = |urdf: String, words: &[&str]| said(TIP, &urdf, &[&arm, words].concat());
    of_file("<robot".to_owned(), &["is not valid XML"]);
    of_file("<!DOCTYPE a [<!ENTITY b \"c\">]><robot/>".to_owned(), &["is not valid XML"]);
    of_file("<scene/>".to_owned(), &["its root element is `scene`", "`robot`"]);
    of_file(file("<limit lower=\"-1.5\"", "<limit"), &["`j1`", "has no `limit lower`"]);
    of_file(file(" velocity=\"3.0\"", ""), &["`j1`", "has no `limit velocity`"]);
    of_file(file("upper=\"2.5\"", "upper=\"NaN\""), &["`j1`", "`limit upper` = NaN", "12.56"]);
    for upper in ["-1.5", "-2.5"] {
        let words = ["`j1`", "`limit lower` = -1.5", upper, "rad"];
        of_file(file("upper=\"2.5\"", &format!("upper=\"{upper}\"")), &words);
    }
    of_file(file("upper=\"2.5\"", "upper=\"1e9\""), &["`j1`", "`limit upper` = 1e9"]);
    for velocity in ["-1", "NaN"] {
        let words = ["`limit velocity`", velocity, "at least 0"];
        of_file(file("velocity=\"3.0\"", &format!("velocity=\"{velocity}\"")), &words);
    }
    of_file(file("xyz=\"0 0 0.1\"", "xyz=\"0 0 inf\""), &["`j1`", "`origin xyz` = inf", "-10 to 10"]);
    of_file(file("xyz=\"0 0 0.1\"", "xyz=\"0 0\""), &["`origin xyz` = \"0 0\"", "three numbers"]);
    of_file(file("<axis", "<mimic joint=\"j2\"/><axis"), &["`j1` mimics another joint (`mimic`)"]);
    of_file(file("revolute", "prismatic"), &["`j1` is of type `prismatic`", "revolute, continuous or fixed"]);
    of_file(file("<parent link=\"l0\"/>", "<parent link=\"l9\"/>"), &["`j1`", "parent link `l9`"]);
    of_file(file("<child link=\"l1\"/>", ""), &["`j1` has no child link"]);
    of_file(
        file("<child link=\"finger\"/>", "<child link=\"l3\"/>"),
        &["link `l3` is the child of both", "no loops"],
    );
    of_file(
        file("<link name=\"finger\"/>", "<link name=\"finger\"/><link name=\"l3\"/>"),
        &["duplicate link `l3`"],
    );
    let closed = six()
        .replace("<child link=\"finger\"/>", "<child link=\"l0\"/>")
        .replace("<link name=\"finger\"/>", "");
    said("", &closed, &["form a loop"]);
    said("tip_link = \"hand\"\n", &six(), &["no link `hand` (`arm.tip_link`)", "flange"]);
    said("tip_link = \"l0\"\nbase_link = \"l6\"\n", &six(), &["no chain of joints from `l6` to `l0`"]);
    said(
        "",
        &file("<link name=\"finger\"/>", "<link name=\"finger\"/><link name=\"hand\"/>"),
        &["arm.base_link", "hand"],
    );
    said("tip_link = \"l5\"\n", &six(), &["arm.joint", "5 revolute joints, expected 6"]);
    said(TIP, &file("xyz=\"0 1 1\"", "xyz=\"0 0 0\""), &["arm.joint.axis", "`j1`"]);
    said("tip_link = \"flange\"\nmodel = \"ur5\"\n", &six(), &["arm.model", "mutually exclusive"]);
    let wide = "lower_joints_deg = [-900.0, 0.0, 0.0, 0.0, 0.0, 0.0]\n";
    said(&format!("{TIP}{wide}"), &six(), &["arm.lower_joints_deg", "-900"]);
}

#[test]
fn named_arms_are_a_list_and_a_fixed_one_has_no_joints() {
    let told = |keys: &str| {
        let base = SCENE.split("[arm]").next().unwrap();
        Scene::parse(&format!("{base}[arm]\n{keys}"), Path::new("a.toml")).map_err(|error| error.to_string())
    };
    for model in ["ur3", "ur3e", "ur5", "ur5e", "ur10e", "ur16e", "ur20", "gantry", "fixed"] {
        told(&format!("model = \"{model}\"\n")).unwrap();
    }
    let error = told("model = \"ur7\"\n").unwrap_err();
    assert!(error.contains("arm.model") && error.contains("ur10e") && error.contains("fixed"), "{error}");
    let error = told("model = \"fixed\"\nmax_force_n = 10.0\n").unwrap_err();
    assert!(error.contains("arm.max_force_n") && error.contains("fixed"), "{error}");
    let error =
        told("model = \"gantry\"\ninitial_joints_deg = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]\n").unwrap_err();
    assert!(error.contains("arm.initial_joints_deg") && error.contains("gantry"), "{error}");
    let error = told("model = \"ur5\"\ntravel_mm = [10.0, 10.0, 10.0]\n").unwrap_err();
    assert!(error.contains("arm.travel_mm") && error.contains("gantry"), "{error}");
    let error = told("model = \"gantry\"\ntravel_mm = [10.0, 0.0, 10.0]\n").unwrap_err();
    assert!(error.contains("arm.travel_mm") && error.contains("5000"), "{error}");
    told("model = \"gantry\"\ntravel_mm = [1.0, 5000.0, 10.0]\nmax_force_n = 10.0\n").unwrap();
    let error = told("tip_link = \"a\"\n").unwrap_err();
    assert!(error.contains("arm.tip_link") && error.contains("arm.urdf"), "{error}");
    let error = told("urdf = \"a.urdf\"\n").unwrap_err();
    assert!(error.contains("arm.urdf"), "{error}");
}
