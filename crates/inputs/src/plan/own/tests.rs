//! Tables of own tools.

#![allow(clippy::unwrap_used, reason = "tests")]
use std::path::Path;

use ipc_types::scene::{Drives, Integrator, ToolDescription};
use simulation::manipulator::Rung;
use test_support::scenes::LIMP_TOOL;

use super::*;
use crate::plan::resolve_by;

const SCENE: &str = "name = \"own\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[tool]\nburr_start_mm = \
                     [0.0, 0.0, 0.0]\n\
                     direction = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n[[controller]]\nname \
                     = \"a\"\n\
                     drives = [\"tendon\", \"arm\", \"burr\"]\nhold = { tension_n = 5.0 }\n";
const RIGID: &str = include_str!("../../../../../configs/tools/rigid_drill.toml");
const TWO: &str = include_str!("../../../../../configs/tools/two_segments.toml");

fn scene(more: &str, tool: Option<&str>) -> Scene {
    let mut scene = Scene::parse(&format!("{more}\n{SCENE}"), Path::new("own.toml")).unwrap();
    let described = tool.map(|text| ToolDescription::parse(text, Path::new("tool.toml")).unwrap());
    scene.manipulator.tool = described.or(scene.manipulator.tool);
    scene
}

struct Place {
    _folder: tempfile::TempDir,
    cache: Cache,
}

impl Place {
    fn new() -> Place {
        let folder = tempfile::tempdir().unwrap();
        let cache = Cache::open(&folder.path().join("trabecula")).unwrap();
        Place { _folder: folder, cache }
    }

    fn table(&self, scene: &Scene) -> Table {
        Table::own(scene, Some(&self.cache)).unwrap()
    }

    /// As text, because unmeasured values are NaN, which equals nothing.
    fn text(&self, scene: &Scene) -> String {
        write(&self.table(scene).rows)
    }
}

#[test]
fn a_table_is_kept_used_and_measured_again_if_it_is_damaged() {
    let (place, scene) = (Place::new(), scene("", Some(RIGID)));
    let table = place.table(&scene);
    assert!(table.tool.as_deref() == Some("rigid_drill") && table.rows.iter().all(|row| row.beam.is_none()));
    let first = write(&table.rows);
    let key = TextKey::of(&[MEASURING, "gentle", &OwnTool::of(&scene).text().unwrap()]);
    let kept = place.cache.find_text(key).unwrap().unwrap();
    assert_eq!((place.cache.files().len(), place.text(&scene)), (1, first.clone()));
    // The cached table is the one used.
    let mut others = read(&kept).unwrap();
    others[0].rest_mm = 7.0;
    place.cache.remove_text(key);
    place.cache.keep_text(key, &write(&others)).unwrap();
    assert_eq!(place.table(&scene).rows[0].rest_mm, 7.0);
    let path = place.cache.path_of_text(key);
    let whole = std::fs::read(&path).unwrap();
    for damaged in [&whole[..whole.len() - 1], b"", &[0xff; 100], &vec![b'a'; 3 << 20]] {
        std::fs::write(&path, damaged).unwrap();
        assert_eq!(place.text(&scene), first);
        assert_eq!(place.cache.find_text(key).unwrap().unwrap(), kept);
    }
    // A table from another version of the candidates.
    place.cache.remove_text(key);
    place.cache.keep_text(key, &write(&others[1..])).unwrap();
    assert_eq!(place.text(&scene), first);
}

#[test]
fn another_tool_has_another_table_and_another_name_or_path_has_not() {
    let text = |scene: &Scene| OwnTool::of(scene).text().unwrap();
    let first = scene("", Some(RIGID));
    let mut same = first.clone();
    let tool = same.manipulator.tool.as_mut().unwrap();
    (tool.name, tool.description) = ("my_drill".to_owned(), String::new());
    same.tool.direction = [1.0, 0.0, 0.0];
    same.tool.bend_toward = [0.0, 1.0, 0.0];
    same.manipulator.links = Some(4);
    same.gravity_m_per_s2 = [0.0, -9.81, 0.0];
    assert_eq!(text(&first), text(&same));
    let mut seen = vec![text(&first)];
    for change in [
        |scene: &mut Scene| scene.manipulator.stiffness_scale = Some(0.5),
        |scene: &mut Scene| scene.gravity_m_per_s2 = [0.0, -20.0, 0.0],
        |scene: &mut Scene| scene.tool.start_shape = Some(ipc_types::scene::StartShape::Straight),
        |scene: &mut Scene| scene.truth = Some(toml::from_str("manipulator = { mass_scale = 1.1 }").unwrap()),
        |scene: &mut Scene| scene.manipulator.tool.as_mut().unwrap().tube.poisson_ratio = 0.31,
    ] {
        let mut other = first.clone();
        change(&mut other);
        assert!(!seen.contains(&text(&other)), "{}", text(&other));
        seen.push(text(&other));
    }
}

/// Costs use no clock: those of the standard tool's own settings equal its table, and fewer links or larger
/// steps cost less.
#[test]
fn costs_follow_from_the_built_in_table() {
    let standard = Table::standard().unwrap().rows;
    let at = |rung, links, dt_ms| Settings {
        rung,
        links,
        integrator: Integrator::Hybrid,
        dt_ms,
        contact: ContactVoxels::Planes,
    };
    for rung in [Rung::Planar, Rung::Spatial, Rung::Full] {
        let same = at(rung, OWN_LINKS, 1.0);
        let row = standard.iter().find(|row| row.settings == same).unwrap();
        let [free, drilling] = candidates::cost(&same, &standard);
        assert!((free - row.free_us_per_ms).abs() < 1e-9 && (drilling - row.drilling_us_per_ms).abs() < 1e-9);
        let free = |links, dt_ms| candidates::cost(&at(rung, links, dt_ms), &standard)[0];
        assert!(free(1, 1.0) > 0.0 && free(8, 1.0) < free(32, 1.0) && free(32, 5.0) < free(32, 2.0));
    }
}

#[test]
fn a_tolerance_of_another_tool_is_planned_by_its_own_table() {
    let place = Place::new();
    let mut planned = scene("tolerance = { tip_mm = 0.2, path_mm = 0.5 }", Some(TWO));
    let table = place.table(&planned);
    let choice = resolve_by(&mut planned, SCENE, &table).unwrap().unwrap();
    assert!(choice.row.free_path_mm <= 0.5 && choice.row.rest_mm <= 0.2, "{choice:?}");
    assert!(choice.text().contains("for the scene's own tool, `two_segments`"), "{}", choice.text());
    assert!(!choice.text().contains("end moment"), "{}", choice.text());
    // With a tendon that ends half way, the shape is not an arc, and the tool's own flexures are more
    // accurate than few links.
    assert!(table.rows.iter().all(|row| row.settings.rung != Rung::ConstantCurvature));
    let error = |links| {
        let row = table.rows.iter().find(|row| {
            let Settings { rung, dt_ms, integrator, .. } = row.settings;
            (row.settings.links, rung, dt_ms, integrator) == (links, Rung::Planar, 1.0, Integrator::Hybrid)
        });
        row.unwrap().rest_mm
    };
    assert!(error(24) < error(4), "{} {}", error(24), error(4));
    // No hard pulls, and no bone.
    assert!(table.rows.iter().all(|row| row.hard_path_mm.is_nan() && row.drilled_path_mm.is_nan()));
    // A client can pull hard.
    planned.controller[0].hold = None;
    planned.controller[0].external = true;
    let hard = place.table(&planned);
    assert!(hard.rows.iter().any(|row| row.hard_path_mm.is_finite()));
    assert_eq!(place.cache.files().len(), 2, "the gentle part was not measured again");
}

/// The tool is more compliant outside its outer tube; a roll rotates its plane out of that of gravity.
#[test]
fn a_tool_in_an_outer_tube_is_measured_as_it_slides_out() {
    let tubes = include_str!("../../../../../configs/tools/tube_in_tube.toml");
    let place = Place::new();
    let mut planned =
        scene("gravity_m_per_s2 = [9.81, 0.0, 0.0]\ntolerance = { path_mm = 0.5 }", Some(tubes));
    planned.controller[0].drives = vec![Drives::Tube];
    planned.controller[0].hold = None;
    planned.controller[0].tube_deployment =
        Some(toml::from_str("deployed_mm = 30\nfeed_mm_per_s = 5\nburr_speed_rpm = 0").unwrap());
    let table = place.table(&planned);
    let cheapest = |planned: &Scene| {
        let mut scene = planned.clone();
        resolve_by(&mut scene, SCENE, &table).unwrap().unwrap().row.settings.rung
    };
    assert_eq!(cheapest(&planned), Rung::Planar);
    planned.controller[0].tube_deployment.as_mut().unwrap().roll_deg = 180.0;
    assert_eq!(cheapest(&planned), Rung::Planar);
    planned.controller[0].tube_deployment.as_mut().unwrap().roll_deg = 40.0;
    assert_eq!(cheapest(&planned), Rung::Spatial);
    // With few links, positions on the arc differ.
    let error = |links| {
        let is_it = |row: &&Row| {
            let Settings { rung, dt_ms, integrator, .. } = row.settings;
            (row.settings.links, rung, dt_ms, integrator) == (links, Rung::Planar, 1.0, Integrator::Hybrid)
        };
        table.rows.iter().find(is_it).unwrap().free_path_mm
    };
    println!("4, 8, 16, 32 links: {:.4}, {:.4}, {:.4}, {:.4} mm", error(4), error(8), error(16), error(32));
    assert!(error(32) < error(8) && error(8) < error(4));
}

/// Bodies push from any direction: planar models are not measured against them.
#[test]
fn a_scene_with_bodies_counts_a_wall() {
    let body = "body = [{ name = \"wall\", cuboid = { half_extents_mm = [5.0, 9.0, 9.0] }, motion \
                = \"fixed\", position_mm = [30.0, 0.0, 0.0] }]";
    let place = Place::new();
    let [without, with] = ["", body].map(|body| place.table(&scene(body, Some(RIGID))).rows);
    assert!(with.len() == without.len() && with.iter().any(|row| row.settings.rung >= Rung::Spatial));
    for (without, with) in without.iter().zip(&with) {
        let is_planar = with.settings.rung < Rung::Spatial;
        assert_ne!(is_planar, with.free_path_mm.is_finite(), "{with:?}");
        assert!(is_planar || with.free_path_mm >= without.free_path_mm, "{without:?} {with:?}");
    }
    assert_eq!(place.cache.files().len(), 2);
}

#[test]
fn what_was_refused_is_measured_with_the_scenes_own_parameters() {
    let of = |keys: &str| Table::own(&scene(&format!("manipulator = {{ {keys} }}"), None), None).unwrap();
    let (softer, rubbing) = (of("stiffness_scale = 0.5"), of("tendon_friction = 0.5"));
    assert_eq!(softer.tool.as_deref(), Some("standard, changed"));
    assert!(
        [&softer, &rubbing].iter().all(|table| table.rows.iter().all(|row| row.free_path_mm.is_finite()))
    );
    assert_ne!(softer.rows[0].free_path_mm, rubbing.rows[0].free_path_mm);
}

/// Pulls of newtons on flexures of a micronewton metre overflow; an undamped pendulum keeps swinging.
#[test]
fn a_tool_that_the_reference_does_not_hold_is_refused_with_its_name() {
    let refused = |scene: &Scene| {
        let refused = Table::own(scene, None).unwrap_err();
        assert_eq!(refused.code, 2, "{refused}");
        refused.message
    };
    let limp = refused(&scene("", Some(LIMP_TOOL)));
    assert!(limp.contains("tool `limp`: its errors cannot be measured"), "{limp}");
    let swings = refused(&scene("manipulator = { damping_ratio = 0.001, stiffness_scale = 0.01 }", None));
    assert!(swings.contains("it still swings after 4 s"), "{swings}");
}
