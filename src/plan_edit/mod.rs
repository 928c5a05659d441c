//! Edits the text of a scene after points were moved by hand: updates all values that depend on the points,
//! and keeps comments, order and everything else.
//!
//! | moved | also updated |
//! |---|---|
//! | burr start | the pilot hole that leads there moves along |
//! | burr start, target | `bend_toward` if the target has left the bending plane; feed length and ramp |
//! | isocentre | nothing |

pub mod approach;
mod name;

use ipc_types::scene::{CurvedDrilling, Scene};
use markups::Arc;
use markups::vector::{dot, length, minus, plus, unit};
use toml_edit::{DocumentMut, Item, TableLike, Value};
use viewer_proc::services::Places;

pub use name::SceneName;

/// A hole that ends within this distance of the burr's start leads to it, mm, as in `planned_path_mm`.
const SAME_MM: f64 = 0.01;
/// A target within this distance of the feed line is on it and implies no bend direction, mm.
pub const ON_THE_LINE_MM: f64 = 0.05;
/// The bend direction is rewritten if it differs from the target's by more than this, as the sine of the
/// angle.
const SAME_DIRECTION: f64 = 2e-3;

/// Errors of moving a point.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EditError {
    /// The point is defined in a 3D Slicer file.
    #[error(
        "`{0}` follows from `tool.plan`: move the point in 3D Slicer, or remove `plan` from the scene and \
         set its points there"
    )]
    OfPlan(&'static str),
    /// No controller drills to a target.
    #[error("missing `[controller.curved_drilling]`, the only controller that drills to a target")]
    NoDrilling,
    /// The scene has no C-arm.
    #[error("missing `[drr]`: without X-ray there is no isocentre")]
    NoXRay,
    /// The text does not match the scene.
    #[error("{0}")]
    Text(String),
}

/// Returns the scene's `text` with points moved. `scene` is the parsed text, including its plan file.
///
/// # Errors
/// [`EditError`]. The scene parser checks whether the values are allowed.
pub fn moved(text: &str, scene: &Scene, places: &Places) -> Result<String, EditError> {
    let mut document: DocumentMut =
        text.parse().map_err(|cause: toml_edit::TomlError| EditError::Text(cause.to_string()))?;
    let of_plan = document.get("tool").and_then(|tool| tool.get("plan")).is_some();
    for (key, given) in [
        ("tool.burr_start_mm", places.burr_start_mm),
        ("controller.curved_drilling.target_mm", places.target_mm),
    ] {
        if of_plan && given.is_some() {
            return Err(EditError::OfPlan(key));
        }
    }
    let missing = |key: &str| EditError::Text(format!("`{key}` not found where it was expected"));
    if let Some(start_mm) = places.burr_start_mm {
        let tool = table(document.get_mut("tool")).ok_or_else(|| missing("tool"))?;
        set(tool, "burr_start_mm", start_mm, 3);
        for index in leading(scene) {
            let hole = entry(document.get_mut("predrill"), index).ok_or_else(|| missing("predrill"))?;
            let from_mm = plus(scene.predrill[index].from_mm, 1.0, minus(start_mm, scene.tool.burr_start_mm));
            set(hole, "from_mm", from_mm, 3);
            set(hole, "to_mm", start_mm, 3);
        }
    }
    let drilling = scene.controller.iter().enumerate();
    let mut drilling = drilling.filter_map(|(index, entry)| Some((index, entry.curved_drilling.as_ref()?)));
    match (drilling.next(), places.target_mm) {
        (None, Some(_)) => return Err(EditError::NoDrilling),
        (Some((index, drilling)), target_mm) if !of_plan => {
            let bend = {
                let controller = entry(document.get_mut("controller"), index);
                let table = controller.and_then(|entry| table(entry.get_mut("curved_drilling")));
                let table = table.ok_or_else(|| missing("controller.curved_drilling"))?;
                if let Some(target_mm) = target_mm {
                    set(table, "target_mm", target_mm, 3);
                }
                follow(table, scene, drilling, places)
            };
            if let Some(bend) = bend {
                let tool = table(document.get_mut("tool")).ok_or_else(|| missing("tool"))?;
                set(tool, "bend_toward", bend, 6);
            }
        }
        _ => {}
    }
    if let Some(isocentre_mm) = places.isocentre_mm {
        let drr = table(document.get_mut("drr")).ok_or(EditError::NoXRay)?;
        set(drr, "isocentre_mm", isocentre_mm, 3);
    }
    Ok(document.to_string())
}

/// Returns the indices of the pilot holes that lead to the burr's start.
pub fn leading(scene: &Scene) -> Vec<usize> {
    let start_mm = scene.tool.burr_start_mm;
    let leads = |index: &usize| length(minus(scene.predrill[*index].to_mm, start_mm)) < SAME_MM;
    (0..scene.predrill.len()).filter(leads).collect()
}

/// Returns the target relative to the start of the bend: along the feed, across it, and the direction across.
fn to_target(scene: &Scene, drilling: &CurvedDrilling, places: &Places) -> Option<(f64, f64, [f64; 3])> {
    let target_mm = places.target_mm.or(drilling.target_mm)?;
    let start_mm = places.burr_start_mm.unwrap_or(scene.tool.burr_start_mm);
    let along = unit(scene.tool.direction);
    let away = minus(target_mm, plus(start_mm, drilling.ramp_start_mm, along));
    let ahead_mm = dot(away, along);
    let beside = plus(away, -ahead_mm, along);
    Some((ahead_mm, length(beside), beside))
}

/// Adds the change in arc length to the feed and scales the ramp in proportion; returns a new bend direction
/// if the target needs one.
fn follow(
    table: &mut dyn TableLike,
    scene: &Scene,
    drilling: &CurvedDrilling,
    places: &Places,
) -> Option<[f64; 3]> {
    let (ahead_mm, beside_mm, beside) = to_target(scene, drilling, places)?;
    if let Some((old_ahead_mm, old_beside_mm, _)) = to_target(scene, drilling, &Places::default()) {
        let [old_mm, new_mm] =
            [(old_ahead_mm, old_beside_mm), (ahead_mm, beside_mm)].map(|(a, b)| Arc::to(a, b).length_mm);
        if (new_mm - old_mm).abs() > 5e-4 && old_mm > 0.0 {
            set_number(table, "insertion_mm", drilling.insertion_mm + new_mm - old_mm);
            let ramp_mm = drilling.ramp_end_mm - drilling.ramp_start_mm;
            set_number(table, "ramp_end_mm", drilling.ramp_start_mm + ramp_mm * new_mm / old_mm);
        }
    }
    let along = unit(scene.tool.direction);
    let toward = scene.tool.bend_toward;
    let now = unit(plus(toward, -dot(toward, along), along));
    let wanted = unit(beside);
    (beside_mm > ON_THE_LINE_MM && length(minus(wanted, now)) > SAME_DIRECTION).then_some(wanted)
}

fn table(item: Option<&mut Item>) -> Option<&mut dyn TableLike> {
    item?.as_table_like_mut()
}

/// Returns a table of an array of tables, in either TOML syntax.
fn entry(item: Option<&mut Item>, index: usize) -> Option<&mut dyn TableLike> {
    match item? {
        Item::ArrayOfTables(tables) => Some(tables.get_mut(index)?),
        Item::Value(Value::Array(values)) => Some(values.get_mut(index)?.as_inline_table_mut()?),
        _ => None,
    }
}

/// Sets a point with the given number of decimals, keeping the array's whitespace and comments.
fn set(table: &mut dyn TableLike, key: &str, place: [f64; 3], decimals: i32) {
    let place = place.map(|x| rounded(x, decimals));
    if let Some(array) = table.get_mut(key).and_then(Item::as_array_mut).filter(|array| array.len() == 3) {
        for (index, x) in place.into_iter().enumerate() {
            array.replace(index, x);
        }
    } else {
        table.insert(key, Item::Value(Value::Array(place.into_iter().collect())));
    }
}

/// Sets a number if it is in the text; a default is either derived from the target or independent of it.
fn set_number(table: &mut dyn TableLike, key: &str, number: f64) {
    if let Some(value) = table.get_mut(key).and_then(Item::as_value_mut) {
        replace(value, rounded(number, 3));
    }
}

/// Replaces a value, keeping the whitespace and comments around it.
fn replace(value: &mut Value, new: impl Into<Value>) {
    let decor = value.decor().clone();
    *value = new.into();
    *value.decor_mut() = decor;
}

/// Rounds a number of a scene's text.
pub fn rounded(x: f64, decimals: i32) -> f64 {
    let scale = 10f64.powi(decimals);
    // Leave numbers that the parser will reject as given. Avoid negative zero.
    if x.abs() < 1e9 { (x * scale).round() / scale + 0.0 } else { x }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    const TEXT: &str = "# Mine.\nname = \"a\"   # a name\n[run]\nmode = \"lockstep\"\nduration_s = 30.0\n[volume]\nphantom = \"block\"\n\
        [[predrill]]\nfrom_mm = [0, 0.0, -10.0]\nto_mm = [0.0, 0.0, 40.0] # the end\ndiameter_mm = 7.0\n\
        [tool]\nburr_start_mm = [ 0.0, 0.0,\n  40.0 ] # here\ndirection = [0.0, 0.0, 2.0]\nbend_toward = [1.0, 0.0, 0.5]\n\
        [drr]\nrate_hz = 2.0 # slow\nisocentre_mm = [1.0, 2.0, 3.0]\ncolumns = 64\nrows = 64\npixel_pitch_mm = 1.0\n\
        [[controller]]\nname = \"c\"\ndrives = []\n[controller.curved_drilling]\nfeed_mm_per_s = 1.0\ntension_n = 3.0\nburr_speed_rpm = 1.0\n\
        feedback = \"none\"\nramp_start_mm = 2.0\nramp_end_mm = 17.0 # ramp\ninsertion_mm = 18.0\ntarget_mm = [5.0, 0.0, 57.0]\n";

    fn scene(text: &str) -> Scene {
        Scene::parse(text, Path::new("a.toml")).unwrap()
    }

    fn edited(places: &Places) -> String {
        moved(TEXT, &scene(TEXT), places).unwrap()
    }

    #[test]
    fn a_moved_place_changes_its_numbers_and_nothing_else_of_the_text() {
        let places = Places { isocentre_mm: Some([-4.0, 0.12345, 7.0]), ..Places::default() };
        let expected = TEXT.replace("isocentre_mm = [1.0, 2.0, 3.0]", "isocentre_mm = [-4.0, 0.123, 7.0]");
        assert_eq!(edited(&places), expected);
        assert_eq!(edited(&Places::default()), TEXT);
    }

    /// The hole moves along; comments and line breaks within the arrays are kept.
    #[test]
    fn the_pilot_hole_moves_with_the_burr_and_the_whole_plan_only_shifts() {
        let places = Places {
            burr_start_mm: Some([1.0, 0.0, 40.0]),
            target_mm: Some([6.0, 0.0, 57.0]),
            ..Places::default()
        };
        let expected = TEXT
            .replace("from_mm = [0, 0.0, -10.0]", "from_mm = [1.0, 0.0, -10.0]")
            .replace("to_mm = [0.0, 0.0, 40.0]", "to_mm = [1.0, 0.0, 40.0]")
            .replace("[ 0.0, 0.0,\n  40.0 ]", "[ 1.0, 0.0,\n  40.0 ]")
            .replace("[5.0, 0.0, 57.0]", "[6.0, 0.0, 57.0]");
        assert_eq!(edited(&places), expected, "the arc is the same, so the feed is");
    }

    /// The arc from (0, 0, 42) to (0, 5, 57): radius 25 mm, angle 2 atan(1/3), as before, but bending to +y.
    #[test]
    fn a_target_out_of_the_bending_plane_turns_it_and_a_farther_one_lengthens_the_feed() {
        let turned = edited(&Places { target_mm: Some([0.0, 5.0, 57.0]), ..Places::default() });
        assert_eq!(scene(&turned).tool.bend_toward, [0.0, 1.0, 0.0]);
        assert!(turned.contains("insertion_mm = 18.0") && turned.contains("ramp_end_mm = 17.0 # ramp"));
        // 24 mm ahead and 8 beside: radius 40 mm, the same angle.
        let farther = scene(&edited(&Places { target_mm: Some([8.0, 0.0, 66.0]), ..Places::default() }));
        let drilling = farther.controller[0].curved_drilling.as_ref().unwrap();
        let grown_mm = 15.0 * 2.0 * (1.0_f64 / 3.0).atan();
        assert!((drilling.insertion_mm - 18.0 - grown_mm).abs() < 1e-3, "{}", drilling.insertion_mm);
        assert!((drilling.ramp_end_mm - (2.0 + 15.0 * 1.6)).abs() < 1e-3, "{}", drilling.ramp_end_mm);
        assert_eq!(farther.tool.bend_toward, [1.0, 0.0, 0.5]);
    }

    #[test]
    fn what_the_scene_has_not_or_has_from_a_plan_is_refused_by_name() {
        let bare = TEXT.split("[drr]").next().unwrap();
        let try_with = |text: &str, places: Places| moved(text, &scene(bare), &places).unwrap_err();
        let place = Some([0.0; 3]);
        let target = try_with(bare, Places { target_mm: place, ..Places::default() });
        assert_eq!(target, EditError::NoDrilling);
        let isocentre = try_with(bare, Places { isocentre_mm: place, ..Places::default() });
        assert_eq!(isocentre, EditError::NoXRay);
        let planned = bare.replace("[tool]", "[tool]\nplan = \"p.mrk.json\"");
        let start = try_with(&planned, Places { burr_start_mm: place, ..Places::default() });
        assert!(start.to_string().contains("`tool.burr_start_mm` follows from `tool.plan`"), "{start}");
    }

    #[test]
    fn a_value_out_of_range_has_the_parsers_words() {
        let text = edited(&Places { isocentre_mm: Some([1e12, 0.0, 0.0]), ..Places::default() });
        let refused = Scene::parse(&text, Path::new("a.toml")).unwrap_err().to_string();
        assert!(
            refused.starts_with("a.toml: `drr.isocentre_mm") && refused.contains("allowed:"),
            "{refused}"
        );
    }

    #[test]
    fn inline_tables_are_found_too() {
        let hole = "[[predrill]]\nfrom_mm = [0, 0.0, -10.0]\nto_mm = [0.0, 0.0, 40.0] # the end\ndiameter_mm = 7.0\n";
        let inline = "predrill = [{ from_mm = [0.0, 0.0, -10.0], to_mm = [0.0, 0.0, 40.0], diameter_mm = 7.0 }]\n[run]\nmode";
        let text = TEXT.replace(hole, "").replace("[run]\nmode", inline);
        let places = Places { burr_start_mm: Some([0.0, 0.0, 41.0]), ..Places::default() };
        let edited = moved(&text, &scene(&text), &places).unwrap();
        let hole = scene(&edited).predrill[0].clone();
        assert_eq!((hole.from_mm, hole.to_mm), ([0.0, 0.0, -9.0], [0.0, 0.0, 41.0]));
    }
}
