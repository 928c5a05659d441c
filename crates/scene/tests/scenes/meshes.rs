//! Tests of arm meshes: the files, and their references in URDF files.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by it")]

use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};

use scene::mesh::{MeshError, MeshFormat, Triangle, triangles};
use scene::{ArmMesh, Scene};

/// A binary STL whose header declares `count` triangles.
fn binary(head: &[u8], count: u32, corners: &[Triangle]) -> Vec<u8> {
    let mut bytes = head.to_vec();
    bytes.resize(80, b' ');
    bytes.extend_from_slice(&count.to_le_bytes());
    for triangle in corners {
        let numbers = [0.0, 0.0, 1.0].iter().chain(triangle.iter().flatten());
        numbers.for_each(|x: &f32| bytes.extend_from_slice(&x.to_le_bytes()));
        bytes.extend_from_slice(&[0, 0]);
    }
    bytes
}

const TRIANGLE: Triangle = [[0.0, 0.0, 0.5], [1.0, 0.0, 0.5], [0.0, 2.0, 0.5]];
const FACET: &str = "facet normal 0 0 1\n outer loop\n  vertex 0 0 0.5\n  vertex 1e0 0 .5\n  vertex 0 2 \
                     5e-1\n endloop\nendfacet\n";

#[test]
fn the_same_triangle_comes_out_of_every_kind_of_file() {
    let text = |first: &str| format!("{first}\n{FACET}endsolid a\n").into_bytes();
    for (content, format) in [
        (binary(b"made by hand", 1, &[TRIANGLE]), MeshFormat::Stl),
        // As some programs write: the header begins like ASCII STL.
        (binary(b"solid made by hand\n", 1, &[TRIANGLE]), MeshFormat::Stl),
        (text("solid a"), MeshFormat::Stl),
        (text("solid"), MeshFormat::Stl),
        (text("solid a\r"), MeshFormat::Stl),
        (b"# a\nv 0 0 0.5\nv 1 0 .5\nv 0 2 0.5\nf 1 2 3\n".to_vec(), MeshFormat::Obj),
        (
            b"v 0 0 0.5\nv 1 0 .5\nv 0 2 0.5\nvn 0 0 1\nusemtl red\nf -3//1 -2//1 -1//1\n".to_vec(),
            MeshFormat::Obj,
        ),
    ] {
        assert_eq!(
            triangles(&content, format, 9),
            Ok(vec![TRIANGLE]),
            "{}",
            String::from_utf8_lossy(&content)
        );
    }
    let square = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n";
    let halves = triangles(square, MeshFormat::Obj, 9).unwrap();
    let area: f32 = halves
        .iter()
        .map(|[a, b, c]| 0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])))
        .sum();
    assert_eq!((halves.len(), area), (2, 1.0), "counterclockwise, as the square");
    for (name, format) in
        [("a.STL", Some(MeshFormat::Stl)), ("a.b.obj", Some(MeshFormat::Obj)), ("a.dae", None), ("stl", None)]
    {
        assert_eq!(MeshFormat::of(Path::new(name)), format, "{name}");
    }
}

/// Regressions: of several `solid` blocks only the first was drawn; upper case, `nan` normals, leading
/// blanks, trailing ones and continued lines of an OBJ were refused.
#[test]
fn meshes_as_other_programs_write_them_are_read_as_a_whole() {
    let solid =
        |name: &str, facets: usize| format!("solid {name}\n{}endsolid {name}\n", FACET.repeat(facets));
    let text = |text: &str, count: usize| {
        let read = triangles(text.as_bytes(), MeshFormat::Stl, 9);
        assert_eq!(read, Ok(vec![TRIANGLE; count]), "{text}");
    };
    text(&[solid("a", 1), solid("b facet", 2), solid("", 0), solid("c", 1)].concat(), 4);
    text(&solid("a", 2).to_uppercase(), 2);
    text(&solid("a", 1).replace("0 0 1", "nan -nan(ind) NaN"), 1);
    text(&format!("\n \t{}\n\0", solid("a", 1)), 1);
    text(&solid("a", 1).replace('\n', "\r\n"), 1);
    for wrong in [solid("a", 1) + "more", solid("a", 1).replace("endloop", "vertex 0 0 0\nendloop")] {
        let said = triangles(wrong.as_bytes(), MeshFormat::Stl, 9).unwrap_err().to_string();
        assert!(said.contains("in line") && said.contains("expected"), "{said}");
    }
    let padded = [binary(b"", 2, &[TRIANGLE; 2]), b"\r\n\0".to_vec()].concat();
    assert_eq!(triangles(&padded, MeshFormat::Stl, 9), Ok(vec![TRIANGLE; 2]));
    let continued = b"v 0 0 \\\n0.5\nv 1 0 .5\nv 0 2 0.5\nf 1 \\\r\n 2 \\\n3\n";
    assert_eq!(triangles(continued, MeshFormat::Obj, 9), Ok(vec![TRIANGLE]));
}

/// Regression: a line that ends in `\r\n` counted twice.
#[test]
fn an_error_in_a_text_names_its_line_whatever_ends_the_lines() {
    for end in ["\n", "\r\n", "\r"] {
        let text = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 x\n".replace('\n', end);
        let said = triangles(text.as_bytes(), MeshFormat::Stl, 9).unwrap_err().to_string();
        assert!(said.contains("found `x` in line 4,"), "{said}");
    }
}

#[test]
fn hostile_files_are_refused_with_what_is_wrong() {
    let refused = |content: &[u8], format| triangles(content, format, 2).unwrap_err();
    let stl = |content: &[u8]| refused(content, MeshFormat::Stl);
    let obj = |content: &str| refused(content.as_bytes(), MeshFormat::Obj);
    assert_eq!(stl(&[]), MeshError::NotStl { bytes: 0, count: None });
    assert_eq!(stl(&[0; 130]), MeshError::NotStl { bytes: 130, count: Some(0) });
    // Truncated, longer than declared, and a count of 4 billion.
    let whole = binary(b"", 2, &[TRIANGLE; 2]);
    for (content, count) in [
        (&whole[..whole.len() - 1], 2),
        (&[&whole[..], b"x"].concat()[..], 2),
        (&binary(b"", u32::MAX, &[TRIANGLE])[..], u32::MAX),
    ] {
        let error = stl(content);
        assert_eq!(error, MeshError::NotStl { bytes: content.len(), count: Some(count) });
        assert!(error.to_string().contains(&format!("declares {count}")), "{error}");
    }
    assert_eq!(stl(&binary(b"", 3, &[TRIANGLE; 3])), MeshError::TooMany { most: 2 });
    assert_eq!(
        stl(format!("solid a\n{}endsolid a\n", FACET.repeat(3)).as_bytes()),
        MeshError::TooMany { most: 2 }
    );
    let mut nowhere = TRIANGLE;
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        nowhere[1][2] = value;
        assert_eq!(stl(&binary(b"", 2, &[TRIANGLE, nowhere])), MeshError::NotFinite { triangle: 2 });
    }
    assert_eq!(stl(&binary(b"", 0, &[])), MeshError::Empty);
    assert_eq!(stl(b"solid a\nendsolid a\n"), MeshError::Empty);
    for cut in [
        format!("solid a\n{FACET}"),
        format!("solid a\n{}", &FACET[..50]),
        format!("solid a\n{}", FACET.replace("1e0", "nan")),
    ] {
        assert!(matches!(stl(cut.as_bytes()), MeshError::Damaged { .. }), "{cut}");
    }
    let corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";
    assert_eq!(obj(""), MeshError::Empty);
    assert_eq!(obj(corners), MeshError::Empty);
    // Regressions: faces truncated at the end of a file were skipped; triangles without area were accepted.
    for (face, corners_left) in [("f 1 2", 2), ("f 1/1/1 # 2 3", 1), ("f", 0)] {
        let short = MeshError::ShortFace { line: 5, corners: corners_left };
        assert_eq!(obj(&format!("{corners}f 1 2 3\n{face}")), short);
    }
    assert_eq!(obj(&format!("{corners}f 1 1 2\n")), MeshError::Empty);
    assert_eq!(stl(&binary(b"", 1, &[[[1.0, 2.0, 3.0]; 3]])), MeshError::Empty);
    assert_eq!(obj(&format!("{corners}{}", "f 1 2 3\n".repeat(3))), MeshError::TooMany { most: 2 });
    assert_eq!(obj("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n"), MeshError::NotFinite { triangle: 1 });
    for face in
        ["f 1 2 4\n", "f 0 1 2\n", "f 1 2 99999999999999999999\n", "f -4 1 2\n", "f a b c\n", "v 1 2\n"]
    {
        assert!(matches!(obj(&format!("{corners}{face}")), MeshError::Damaged { .. }), "{face}");
    }
}

const SCENE: &str = "name = \"a\"
[run]
mode = \"lockstep\"
duration_s = 1.0
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [1.0, 0.0, 0.0]
bend_toward = [0.0, 0.0, 1.0]
[arm]
initial_joints_deg = [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]
";

/// Six joints; the links, from the base, are drawn as given by `looks`.
fn urdf(looks: &[&str]) -> String {
    let link = |i: usize| format!("<link name=\"l{i}\">{}</link>", looks.get(i).unwrap_or(&""));
    let joint = |i: usize| {
        let above = i - 1;
        format!(
            "<joint name=\"j{i}\" type=\"revolute\"><parent link=\"l{above}\"/><child link=\"l{i}\"/><origin \
             xyz=\"0 0.1 0.{i}\"/>\
             <axis xyz=\"0 {i} 1\"/><limit lower=\"-1.5\" upper=\"2.5\" velocity=\"3.0\"/></joint>"
        )
    };
    format!(
        "<robot name=\"a\">{}{}</robot>",
        (0..=6).map(link).collect::<String>(),
        (1..=6).map(joint).collect::<String>()
    )
}

fn mesh(kind: &str, file: &str, more: &str) -> String {
    format!("<{kind}>{more}<geometry><mesh filename=\"{file}\"/></geometry></{kind}>")
}

/// The meshes of a scene in `/scenes` whose arm is `/scenes/ws/ur/urdf/ur.urdf`; `there` lists the other
/// files that exist.
fn meshes(keys: &str, urdf: &str, there: &[&str]) -> Result<Vec<ArmMesh>, String> {
    let read = |path: &Path| match path.to_str().unwrap() {
        "/scenes/ws/ur/urdf/ur.urdf" => Ok(urdf.to_owned()),
        // The error of reading a binary file as text.
        name if there.contains(&name) => Err(Error::from(ErrorKind::InvalidData)),
        _ => Err(Error::from(ErrorKind::NotFound)),
    };
    let text = format!("{SCENE}urdf = \"ws/ur/urdf/ur.urdf\"\n{keys}");
    let scene =
        Scene::parse_with(&text, Path::new("/scenes/a.toml"), &read).map_err(|error| error.to_string())?;
    // As in a log: the text of the scene itself, without any file.
    let kept = Scene::parse(&toml::to_string(&scene).unwrap(), Path::new("/elsewhere/a.toml")).unwrap();
    assert_eq!(kept.arm, scene.arm);
    Ok(scene.arm.mesh.unwrap_or_default())
}

#[test]
fn a_package_is_looked_for_in_the_folders_above_and_a_path_beside_the_file() {
    let there = [
        "/scenes/ws/ur/meshes/a.stl",
        "/scenes/ws/ur/urdf/b.obj",
        "/far/c.stl",
        "/scenes/ws/ur/urdf/../meshes/a.stl",
        "/scenes/ws/ur/meshes/a.dae",
    ];
    let looks = [
        &*mesh(
            "visual",
            "package://ur/meshes/a.stl",
            "<origin xyz=\"0.1 0 -0.2\" rpy=\"0 0 1.5707963267948966\"/>",
        ),
        &mesh("visual", "b.obj", ""),
        &mesh("visual", "file:///far/c.stl", ""),
        &mesh("visual", "../meshes/a.stl", "").replace("/></geo", " scale=\"0.001 0.001 -0.001\"/></geo"),
        // Whatever can be drawn counts, `visual` before `collision`.
        &[mesh("visual", "package://ur/meshes/a.dae", ""), mesh("collision", "b.obj", "")].concat(),
        &[mesh("collision", "nowhere.stl", ""), mesh("visual", "b.obj", "")].concat(),
        "<visual><geometry><box size=\"1 1 1\"/></geometry></visual>",
    ];
    let found = meshes("", &urdf(&looks), &there).unwrap();
    let files: Vec<(Option<&str>, &str)> =
        found.iter().map(|m| (m.joint.as_deref(), m.file.to_str().unwrap())).collect();
    let expected = [
        (None, there[0]),
        (Some("j1"), there[1]),
        (Some("j2"), there[2]),
        (Some("j3"), there[3]),
        (Some("j4"), there[4]),
        (Some("j4"), there[1]),
        (Some("j5"), there[1]),
    ];
    assert_eq!(files, expected);
    assert_eq!((found[0].position_mm, found[0].scale), ([100.0, 0.0, -200.0], [1.0; 3]));
    assert!((found[0].roll_pitch_yaw_deg[2] - 90.0).abs() < 1e-12);
    assert_eq!(found[3].scale, [1e-3, 1e-3, -1e-3]);
}

#[test]
fn what_is_missing_or_malformed_is_named_with_link_mesh_and_what_was_expected() {
    let said = |keys: &str, look: &str, words: &[&str]| {
        let error = meshes(keys, &urdf(&["", look]), &["/scenes/ws/ur/urdf/a.stl"]).unwrap_err();
        let all = ["/scenes/a.toml: `arm.urdf` /scenes/ws/ur/urdf/ur.urdf: link `l1` has"];
        assert!(all.iter().chain(words).all(|word| error.contains(word)), "{words:?} in: {error}");
    };
    said(
        "",
        &mesh("visual", "b.stl", ""),
        &["the mesh b.stl, which was not found; expected /scenes/ws/ur/urdf/b.stl", "`arm.meshes = false`"],
    );
    said(
        "",
        &mesh("visual", "package://ur/a.stl", ""),
        &["package://ur/a.stl, which was not found; expected ur/a.stl in /scenes/ws/ur/urdf or in a folder \
             above it"],
    );
    said(
        "",
        &mesh("visual", "https://a/b.stl", ""),
        &["with the unsupported scheme `https`, expected `package://`, `file://` or a path"],
    );
    said(
        "",
        &mesh("visual", "a.stl", "<origin xyz=\"0 0 nan\"/>"),
        &["`origin xyz` = nan, expected a number from -10 to 10"],
    );
    said(
        "",
        &mesh("visual", "a.stl", "<origin xyz=\"0 0\"/>"),
        &["`origin xyz` = \"0 0\", expected three numbers"],
    );
    said(
        "",
        &mesh("visual", "a.stl", "").replace("/></geo", " scale=\"1 1 1e9\"/></geo"),
        &["`mesh scale` = 1e9"],
    );
    // Without its meshes the arm is drawn as tubes, if the scene says so.
    let absent = urdf(&["", &mesh("visual", "b.stl", "")]);
    assert_eq!(meshes("meshes = false\n", &absent, &[]), Ok(Vec::new()));
    let many = urdf(&[&mesh("visual", "a.stl", "").repeat(257)]);
    let error = meshes("", &many, &["/scenes/ws/ur/urdf/a.stl"]).unwrap_err();
    assert!(error.contains("`arm.mesh (count)` is 257; allowed: 0 to 256"), "{error}");
    let flat = urdf(&[&mesh("visual", "a.stl", "").replace("/></geo", " scale=\"1 0 1\"/></geo")]);
    let error = meshes("", &flat, &["/scenes/ws/ur/urdf/a.stl"]).unwrap_err();
    assert!(error.contains("`arm.mesh.scale` is [1.0, 0.0, 1.0]"), "{error}");
    for (keys, words) in [
        ("meshes = true\n", ["`arm.meshes`", "`arm.urdf` is not set"]),
        ("[[arm.mesh]]\nfile = \"a.stl\"\n", ["`arm.mesh`", "needs `arm.joint`"]),
    ] {
        let error = Scene::parse(&format!("{SCENE}{keys}"), Path::new("a.toml")).unwrap_err().to_string();
        assert!(words.iter().all(|word| error.contains(word)), "{words:?} in: {error}");
    }
    let error = meshes("[[arm.mesh]]\nfile = \"a.stl\"\n", &absent, &[]).unwrap_err();
    assert!(error.contains("`arm.mesh` and `arm.urdf` are mutually exclusive"), "{error}");
}

#[test]
fn a_mesh_written_by_hand_is_relative_to_the_scene_and_moves_with_a_joint_that_is_there() {
    let joints: String = (1..=6)
        .map(|i| {
            format!(
                "[[arm.joint]]\nname = \"j{i}\"\naxis = [0.0, {i}.0, 1.0]\nlower_deg = \
                          -90.0\nupper_deg = 90.0\nmax_speed_deg_per_s = 10.0\n"
            )
        })
        .collect();
    let parse = |joint: &str| {
        let text = format!("{SCENE}{joints}[[arm.mesh]]\njoint = \"{joint}\"\nfile = \"a.stl\"\n");
        Scene::parse(&text, Path::new("/scenes/a.toml")).map_err(|error| error.to_string())
    };
    let found = parse("j6").unwrap().arm.mesh.unwrap();
    assert_eq!((found[0].file.clone(), found[0].scale), (PathBuf::from("/scenes/a.stl"), [1.0; 3]));
    let error = parse("j7").unwrap_err();
    assert!(error.contains("`arm.mesh.joint` is `j7`, expected the name of an `arm.joint`"), "{error}");
}
