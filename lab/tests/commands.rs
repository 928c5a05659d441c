//! The laboratory's commands in their short forms: what they print and write.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use std::fs;
use std::path::Path;
use std::process::Command;

use test_support::limited::Limited;

struct Done {
    code: Option<i32>,
    out: String,
    err: String,
}

/// Runs the laboratory in a folder, with a time limit.
fn laboratory(folder: &Path, arguments: &[&str]) -> Done {
    let mut command = Command::new(env!("CARGO_BIN_EXE_trabecula-lab"));
    let output = command.args(arguments).current_dir(folder).limited_output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    Done { code: output.status.code(), out: text(&output.stdout), err: text(&output.stderr) }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// A simulator that is 1 mm off the arc and takes a thousand times real time.
const PEER: &str = r#"
import json, math, pathlib, sys
beam = json.loads((pathlib.Path(sys.argv[1]) / "beam.json").read_text())
bend = beam["end_moment_nm"] * beam["length_m"] / beam["rigidity_nm2"]
radius = beam["length_m"] / bend
for links in beam["links"]:
    x, z = radius * (1 - math.cos(bend)), radius * math.sin(bend)
    print("end_moment mujoco", links, 1.0, 1e6, 0, x + 1e-3, z)
"#;

#[test]
fn the_short_chart_of_the_physics_has_its_six_panels_and_its_peers() {
    let place = tempfile::tempdir().unwrap();
    let (out, peers) = (place.path().join("charts"), place.path().join("peers"));
    fs::create_dir(&peers).unwrap();
    for (name, script) in [("known", PEER), ("lost", "raise SystemExit('no licence')\n")] {
        fs::write(peers.join(format!("{name}.py")), script).unwrap();
        fs::write(peers.join(format!("{name}.txt")), "").unwrap();
    }
    let words = ["chart", "physics", "--quick", "--output", text(&out), "--peers", text(&peers)];
    let done = laboratory(place.path(), &words);
    assert_eq!(done.code, Some(0), "{}", done.err);
    assert!(done.out.contains("peer lost: not measured (no licence)"), "{}", done.out);
    let csv = fs::read_to_string(out.join("accuracy-physics.csv")).unwrap();
    let svg = fs::read_to_string(out.join("accuracy-physics.svg")).unwrap();
    for (problem, method, title) in [
        ("end_moment", "planar hybrid", "1  Pure end moment"),
        ("tip_force", "planar hybrid", "2  Tip force"),
        ("capstan", "planar hybrid", "3  Capstan friction"),
        ("vibration", "planar hybrid", "4  Free vibration"),
        ("wall", "planar hybrid", "5  Pulled against a wall"),
        ("drilled", "constant_curvature", "6  Drilled path"),
        ("drilled", "modal hybrid", "6  Drilled path"),
    ] {
        let own = csv.lines().find(|line| line.starts_with(&format!("{problem},{method},"))).unwrap();
        let error: f64 = own.rsplit(',').next().unwrap().parse().unwrap();
        assert!(error.is_finite() && error >= 0.0, "{own}");
        assert!(svg.contains(title), "{title}: not in the figure");
    }
    let of_peer = |figure: &str| -> f64 {
        let line = csv.lines().find(|line| line.starts_with("end_moment,mujoco,8,") && line.contains(figure));
        line.unwrap().rsplit(',').next().unwrap().parse().unwrap()
    };
    assert!((of_peer("tip error") - 1000.0).abs() < 1e-6);
    // Ours takes microseconds.
    assert!(of_peer("cost over ours") > 10.0);
    assert!(out.join("physics-plan.csv").exists() && out.join("accuracy-physics.png").exists());
}

/// The chart without other projectors at an eighth of the resolution has every projector, pose and
/// resolution, and the figure.
#[test]
fn the_quick_chart_has_every_projector_with_its_error() {
    let place = tempfile::tempdir().unwrap();
    let done = laboratory(
        place.path(),
        &["chart", "drr", "--quick", "--rounds", "1", "--output", text(place.path())],
    );
    assert_eq!(done.code, Some(0), "{}", done.err);
    let csv = fs::read_to_string(place.path().join("drr.csv")).unwrap();
    let lines: Vec<Vec<&str>> = csv.lines().skip(1).map(|line| line.split(',').collect()).collect();
    // 10 projectors, 3 poses, 3 resolutions, 1 and 2 threads.
    assert_eq!(lines.len(), 10 * 3 * 3 * 2);
    let errors = |method: &str, column: usize| -> Vec<f64> {
        let finest = lines.iter().filter(|line| line[0] == method && line[1] == "8");
        finest.map(|line| line[column].parse().unwrap()).collect()
    };
    // Columns 6 and 8: r.m.s. errors against the closed integrals and against Siddon's sum.
    assert!(errors("siddon", 8).iter().all(|e| *e == 0.0));
    for method in ["siddon", "joseph", "slice_ordered 1"] {
        assert!(
            errors(method, 6).iter().all(|e| (1e-4..0.05).contains(e)),
            "{method}: {:?}",
            errors(method, 6)
        );
    }
    let mean = |method| errors(method, 8).iter().sum::<f64>() / 6.0;
    assert!(mean("joseph") < mean("preview 2") && mean("preview 2") < mean("preview 4"));
    assert!(fs::read_to_string(place.path().join("drr.svg")).unwrap().contains("<svg"));
    let table = fs::read_to_string(place.path().join("drr.md")).unwrap();
    assert!(table.contains("| slice_ordered 1 | 2 | ") && table.contains("Spectrum of 90 kV"));
}

/// They must not look for their scene in `configs/`.
#[test]
fn benches_without_a_scene_work_in_an_empty_folder() {
    let place = tempfile::tempdir().unwrap();
    for words in [
        &["bench", "overhead", "--ticks", "100", "--rounds", "1"][..],
        &["bench", "step", "--ticks", "20", "--in-process"],
    ] {
        let done = laboratory(place.path(), words);
        assert_eq!(done.code, Some(0), "{words:?}: {}", done.err);
    }
}

/// `chart` and `reproduce` must not overwrite their earlier output.
#[test]
fn no_command_writes_over_a_file_that_is_there() {
    let place = tempfile::tempdir().unwrap();
    for (words, files) in [
        (
            "chart drr --quick --rounds 1 --output charts",
            &["charts/drr.csv", "charts/drr.md", "charts/drr.svg", "charts/drr.png"][..],
        ),
        ("chart drr --rungs rungs.csv", &["rungs.csv"]),
        (
            "chart physics --quick --output charts",
            &["charts/physics-plan.csv", "charts/accuracy-physics.png"],
        ),
        ("chart stability --quick --output charts", &["charts/stability.csv", "charts/stability.svg"]),
        (
            "reproduce --quick --only 1 --output rep",
            &["rep/reproduce-1-tunnel.csv", "rep/reproduce-1-tunnel.svg"],
        ),
        (
            "reproduce --quick --only 2 --output rep",
            &["rep/reproduce-2-rules.csv", "rep/reproduce-2-planar-burr.png"],
        ),
        ("reproduce --quick --only 3 --output rep", &["rep/reproduce-3-deviation.csv"]),
        ("reproduce --quick --only 4 --output rep", &["rep/reproduce-4-tension.png"]),
        ("reproduce --quick --output rep", &["rep/reproduce-5-thrust.csv"]),
        ("bench soak --minutes 0.1 --output soak", &["soak/run.mcap", "soak/summary.json"]),
    ] {
        for file in files {
            let path = place.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(&path, "mine").unwrap();
            let done = laboratory(place.path(), &words.split(' ').collect::<Vec<_>>());
            let name = path.file_name().unwrap().to_str().unwrap();
            assert_eq!(done.code, Some(2), "{words}: {}{}", done.out, done.err);
            assert!(done.err.contains(&format!("{name}: already exists")), "{words}: {}", done.err);
            assert_eq!(fs::read(&path).unwrap(), b"mine", "{words}");
            fs::remove_file(&path).unwrap();
            let folder = path.parent().unwrap();
            assert!(folder == place.path() || fs::read_dir(folder).unwrap().next().is_none(), "{words}");
        }
    }
}
