//! Other approaches to the same target: by how much an approach differs from that of the scene.

use ipc_types::scene::{CurvedDrilling, Predrill, Scene};
use markups::Arc;
use markups::vector::{across, cross, dot, length, minus, plus, unit};
use serde::Serialize;

use crate::plan_edit::approach::{DECIMALS, DIRECTION_DECIMALS};
use crate::plan_edit::{ON_THE_LINE_MM, leading, rounded};

/// Number of quantities that are searched.
pub const DIMENSIONS: usize = 7;

/// By how much an approach differs from that of the scene.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Offsets {
    /// Displacement of the entry (the begin of the pilot hole, or else of the burr), perpendicular to the
    /// feed: toward the bend, and across it.
    pub entry_mm: [f64; 2],
    /// Tilt of the feed about the entry: toward the bend, and across it.
    pub tilt_deg: [f64; 2],
    /// How much farther the tool is fed before the bend begins, which tightens it.
    pub bend_mm: f64,
    /// Change of the final tension, beyond that which the angle of the bend needs.
    pub tension_percent: f64,
    /// Feed beyond the length of the planned path.
    pub feed_mm: f64,
}

impl Offsets {
    /// Takes the numbers in the order of the fields.
    pub fn of(numbers: [f64; DIMENSIONS]) -> Offsets {
        let [u, v, a, b, bend_mm, tension_percent, feed_mm] = numbers;
        Offsets { entry_mm: [u, v], tilt_deg: [a, b], bend_mm, tension_percent, feed_mm }
    }

    /// Returns the numbers in the order of the fields.
    pub fn numbers(self) -> [f64; DIMENSIONS] {
        let Offsets { entry_mm: [u, v], tilt_deg: [a, b], bend_mm, tension_percent, feed_mm } = self;
        [u, v, a, b, bend_mm, tension_percent, feed_mm]
    }

    /// Returns what equal offsets have in common.
    pub fn key(self) -> Key {
        self.numbers().map(|number| (number + 0.0).to_bits())
    }
}

/// Identity of offsets: the bits of their numbers, without negative zeros.
pub type Key = [u64; DIMENSIONS];

/// Largest offsets that are searched, in both directions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Bounds {
    /// Each of [`Offsets::entry_mm`].
    pub entry_mm: f64,
    /// Each of [`Offsets::tilt_deg`].
    pub tilt_deg: f64,
    /// [`Offsets::bend_mm`].
    pub bend_mm: f64,
    /// [`Offsets::tension_percent`].
    pub tension_percent: f64,
    /// [`Offsets::feed_mm`].
    pub feed_mm: f64,
}

impl Bounds {
    /// Returns the largest offsets that make sense for a plan: a straight one has no bend and always aims at
    /// its target, and a calibration determines the tension.
    pub fn limits(self, scene: &Scene, drilling: &CurvedDrilling) -> [f64; DIMENSIONS] {
        let Bounds { entry_mm, mut tilt_deg, mut bend_mm, mut tension_percent, feed_mm } = self;
        if planned(scene, drilling).is_some_and(|plan| plan.is_straight()) {
            (tilt_deg, bend_mm, tension_percent) = (0.0, 0.0, 0.0);
        }
        if drilling.tension_n.is_none() {
            tension_percent = 0.0;
        }
        [entry_mm, entry_mm, tilt_deg, tilt_deg, bend_mm, tension_percent, feed_mm]
    }
}

/// The curve to a target.
struct Planned {
    beside_mm: [f64; 3],
    arc: Arc,
    ramp_start_mm: f64,
    /// From the burr's start.
    length_mm: f64,
}

impl Planned {
    fn is_straight(&self) -> bool {
        length(self.beside_mm) <= ON_THE_LINE_MM
    }
}

/// Returns the planned curve of a scene; `None` without a target ahead of the bend.
fn planned(scene: &Scene, drilling: &CurvedDrilling) -> Option<Planned> {
    let along = unit(scene.tool.direction);
    let ramp_start_mm = drilling.ramp_start_mm;
    let away = minus(drilling.target_mm?, plus(scene.tool.burr_start_mm, ramp_start_mm, along));
    let (ahead_mm, beside_mm) = (dot(away, along), across(away, along));
    let arc = Arc::to(ahead_mm, length(beside_mm));
    let length_mm = ramp_start_mm + arc.length_mm;
    (ahead_mm > 0.0).then_some(Planned { beside_mm, arc, ramp_start_mm, length_mm })
}

/// Returns the scene's curved drilling.
pub fn drilling(scene: &Scene) -> Option<&CurvedDrilling> {
    scene.controller.iter().find_map(|controller| controller.curved_drilling.as_ref())
}

/// Returns the scene with another approach, rounded as its text will be; `None` if it cannot reach the
/// target, or does not drill.
pub fn offset(scene: &Scene, by: &Offsets) -> Option<Scene> {
    let old = drilling(scene)?;
    let old_plan = planned(scene, old);
    let mut new = scene.clone();
    put_start(&mut new, old.target_mm.filter(|_| old_plan.as_ref().is_some_and(Planned::is_straight)), by);
    let mut changed = old.clone();
    changed.ramp_start_mm = mm((old.ramp_start_mm + by.bend_mm).max(0.0));
    let mut grown_mm = by.feed_mm;
    let ramp_mm = old.ramp_end_mm - old.ramp_start_mm;
    changed.ramp_end_mm = changed.ramp_start_mm + ramp_mm;
    let mut tension_share = 1.0 + 0.01 * by.tension_percent;
    if old.target_mm.is_some() {
        let (old_plan, new_plan) = (old_plan?, planned(&new, &changed)?);
        grown_mm += new_plan.length_mm - old_plan.length_mm;
        let stretch = new_plan.arc.length_mm / old_plan.arc.length_mm;
        changed.ramp_end_mm = new_plan.ramp_start_mm + ramp_mm * stretch;
        if !old_plan.is_straight() {
            tension_share *= new_plan.arc.turn_deg / old_plan.arc.turn_deg;
        }
        if !new_plan.is_straight() {
            new.tool.bend_toward = direction(unit(new_plan.beside_mm));
        }
    }
    changed.ramp_end_mm = mm(changed.ramp_end_mm);
    changed.insertion_mm = mm(old.insertion_mm + grown_mm);
    changed.tension_n = old.tension_n.map(|tension_n| rounded(tension_n * tension_share, DECIMALS));
    // The longer feed takes its time.
    let longer_s = (changed.insertion_mm - old.insertion_mm).max(0.0) / old.feed_mm_per_s;
    new.run.duration_s = rounded(scene.run.duration_s + (longer_s * 10.0).ceil() / 10.0, DECIMALS);
    let table = new.controller.iter_mut().find_map(|controller| controller.curved_drilling.as_mut())?;
    *table = changed;
    Some(new)
}

/// Moves the entry and tilts the feed, or aims it at a target; the pilot holes that lead to the burr's start
/// move along.
fn put_start(scene: &mut Scene, aim_mm: Option<[f64; 3]>, by: &Offsets) {
    let start_mm = scene.tool.burr_start_mm;
    let along = unit(scene.tool.direction);
    let toward = unit(across(scene.tool.bend_toward, along));
    let beside = cross(along, toward);
    let holes = leading(scene);
    let hole_mm = |hole: &Predrill| length(minus(hole.to_mm, hole.from_mm));
    let lead_mm = holes.first().map_or(0.0, |index| hole_mm(&scene.predrill[*index]));
    let entry_mm = plus(start_mm, -lead_mm, along);
    let entry_mm = plus(plus(entry_mm, by.entry_mm[0], toward), by.entry_mm[1], beside);
    let tilted = |tilt_deg: [f64; 2]| {
        let [a, b] = tilt_deg.map(|deg| deg.to_radians().tan());
        unit(plus(plus(along, a, toward), b, beside))
    };
    let new = direction(aim_mm.map_or_else(|| tilted(by.tilt_deg), |aim_mm| unit(minus(aim_mm, entry_mm))));
    let start_mm = plus(entry_mm, lead_mm, unit(new)).map(mm);
    for index in holes {
        let hole = &mut scene.predrill[index];
        hole.from_mm = plus(start_mm, -hole_mm(hole), unit(new)).map(mm);
        hole.to_mm = start_mm;
    }
    scene.tool.burr_start_mm = start_mm;
    scene.tool.bend_toward = direction(unit(across(scene.tool.bend_toward, unit(new))));
    scene.tool.direction = new;
}

fn mm(x: f64) -> f64 {
    rounded(x, DECIMALS)
}

fn direction(unit: [f64; 3]) -> [f64; 3] {
    unit.map(|x| rounded(x, DIRECTION_DECIMALS))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::plan_edit::approach::approached;

    /// A hole of 50 mm along z to (0, 0, 40), and 2 mm farther a bend of radius 25 mm to (5, 0, 57).
    const CURVE: &str = r#"# Mine.
name = "a"
[run]
mode = "lockstep"
duration_s = 30.0 # long
[volume]
phantom = "block"
[[predrill]]
from_mm = [0, 0.0, -10.0]
to_mm = [0.0, 0.0, 40.0] # the end
diameter_mm = 7.0
[tool]
burr_start_mm = [ 0.0, 0.0,
  40.0 ] # here
direction = [0.0, 0.0, 2.0]
bend_toward = [1.0, 0.0, 0.5]
[[controller]]
name = "c"
drives = []
[controller.curved_drilling]
feed_mm_per_s = 1.0
tension_n = 3.0
burr_speed_rpm = 1.0
feedback = "none"
ramp_start_mm = 2.0
ramp_end_mm = 17.0 # ramp
insertion_mm = 18.0
target_mm = [5.0, 0.0, 57.0]
"#;

    fn scene(text: &str) -> Scene {
        Scene::parse(text, Path::new("a.toml")).unwrap()
    }

    fn near(found: f64, expected: f64) {
        assert!((found - expected).abs() < 2e-3, "{found}, expected {expected}");
    }

    /// 2 mm nearer to the target: 15 mm ahead and 3 beside, a radius of 39 mm.
    #[test]
    fn a_moved_entry_changes_the_arc_its_tension_and_the_feed() {
        let by = Offsets { entry_mm: [2.0, 0.0], feed_mm: 0.5, tension_percent: 10.0, ..Offsets::default() };
        let moved = offset(&scene(CURVE), &by).unwrap();
        assert_eq!(moved.tool.burr_start_mm, [2.0, 0.0, 40.0]);
        assert_eq!(
            (moved.predrill[0].from_mm, moved.predrill[0].to_mm),
            ([2.0, 0.0, -10.0], [2.0, 0.0, 40.0])
        );
        let [old_rad, new_rad] = [1.0_f64 / 3.0, 0.2].map(|slope| 2.0 * slope.atan());
        let (old_mm, new_mm) = (25.0 * old_rad, 39.0 * new_rad);
        let plan = drilling(&moved).unwrap();
        near(plan.insertion_mm, 18.5 + new_mm - old_mm);
        near(plan.ramp_end_mm, 2.0 + 15.0 * new_mm / old_mm);
        near(plan.tension_n.unwrap(), 1.1 * 3.0 * new_rad / old_rad);
        assert_eq!(moved.run.duration_s, 30.0);
        let longer = offset(&scene(CURVE), &Offsets { feed_mm: 1.55, ..Offsets::default() }).unwrap();
        assert_eq!((drilling(&longer).unwrap().insertion_mm, longer.run.duration_s), (19.55, 31.6));
    }

    #[test]
    fn a_tilted_feed_turns_about_the_entry_and_bends_toward_the_target() {
        let by = Offsets { tilt_deg: [0.0, 5.0], bend_mm: 1.0, ..Offsets::default() };
        let tilted = offset(&scene(CURVE), &by).unwrap();
        let along = unit(tilted.tool.direction);
        near(dot(along, [0.0, 0.0, 1.0]).acos().to_degrees(), 5.0);
        near(along[0], 0.0);
        let from_entry = minus(tilted.tool.burr_start_mm, [0.0, 0.0, -10.0]);
        near(length(from_entry), 50.0);
        near(dot(unit(from_entry), along), 1.0);
        // The target is in the plane of feed and bend, on the side of the bend.
        let away = minus([5.0, 0.0, 57.0], tilted.tool.burr_start_mm);
        near(dot(away, cross(along, tilted.tool.bend_toward)), 0.0);
        assert!(dot(away, tilted.tool.bend_toward) > 0.0);
        assert_eq!(drilling(&tilted).unwrap().ramp_start_mm, 3.0);
        // A target behind the bend cannot be reached.
        let late = Offsets { bend_mm: 16.0, ..Offsets::default() };
        assert!(offset(&scene(CURVE), &late).is_none());
    }

    #[test]
    fn a_straight_path_aims_at_its_target_from_any_entry() {
        let text = CURVE.replace("target_mm = [5.0, 0.0, 57.0]", "target_mm = [0.0, 0.0, 57.0]");
        let straight = scene(&text);
        let bounds =
            Bounds { entry_mm: 3.0, tilt_deg: 5.0, bend_mm: 2.0, tension_percent: 10.0, feed_mm: 1.0 };
        assert_eq!(
            bounds.limits(&straight, drilling(&straight).unwrap()),
            [3.0, 3.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        );
        let moved = offset(&straight, &Offsets { entry_mm: [3.0, 0.0], ..Offsets::default() }).unwrap();
        let away = minus([0.0, 0.0, 57.0], moved.tool.burr_start_mm);
        near(dot(unit(away), unit(moved.tool.direction)), 1.0);
        near(drilling(&moved).unwrap().insertion_mm, 18.0 + length(away) - 17.0);
    }

    /// What is searched is what is written; everything else of the text stays.
    #[test]
    fn the_text_of_an_approach_is_its_scene() {
        let original = scene(CURVE);
        assert_eq!(approached(CURVE, &original, &original).unwrap(), CURVE);
        for index in 0..50 {
            let unit: [f64; DIMENSIONS] = sweep::sobol_point(3, index);
            let by = Offsets::of(unit.map(|x| 4.0 * x - 2.0));
            let expected = offset(&original, &by).unwrap();
            let text = approached(CURVE, &original, &expected).unwrap();
            assert_eq!(scene(&text), expected, "{text}");
            assert!(
                text.starts_with("# Mine.") && text.contains(" # here\n") && text.contains(" # ramp\n"),
                "{text}"
            );
        }
    }
}
