//! The chart of the physics in its short form, and other simulators beside it.

use std::fs;

use crate::common::program::{Place, trabecula};

/// A simulator that is a millimetre off the arc and takes a thousand times real time.
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
    let place = Place::new();
    let (out, peers) = (place.path("charts"), place.path("peers"));
    fs::create_dir(&peers).unwrap();
    for (name, script) in [("known", PEER), ("lost", "raise SystemExit('no licence')\n")] {
        fs::write(peers.join(format!("{name}.py")), script).unwrap();
        fs::write(peers.join(format!("{name}.txt")), "").unwrap();
    }
    let done = trabecula(&[&"chart", &"physics", &"--quick", &"--output", &out, &"--peers", &peers]);
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
