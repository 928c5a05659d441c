//! Rewrites the keys of a scene's text that an approach to its target consists of.
//!
//! | key | decimals |
//! |---|---|
//! | `tool.burr_start_mm`, `predrill` | 3 |
//! | `tool.direction`, `tool.bend_toward` | 6 |
//! | `ramp_start_mm`, `ramp_end_mm`, `insertion_mm`, `tension_n` of `curved_drilling`, `run.duration_s` | 3 |

use std::path::Path;

use ipc_types::scene::Scene;
use toml_edit::{Array, ArrayOfTables, DocumentMut, InlineTable, Item, Table, TableLike, Value};

use super::{EditError, entry, replace, rounded, set, table};

/// Decimals of lengths, tensions and times.
pub const DECIMALS: i32 = 3;
/// Decimals of directions.
pub const DIRECTION_DECIMALS: i32 = 6;
/// Keys whose values are paths of files.
const PATHS: [&str; 6] = ["calibration", "file", "fmu", "path", "plan", "urdf"];

/// Returns the text of a scene for another folder than `folder`, which holds it: its paths are absolute, and
/// it holds the points that it has from `tool.plan`. `scene` is the parsed text.
///
/// # Errors
/// [`EditError::Text`]: the text does not match the scene.
pub fn portable(text: &str, scene: &Scene, folder: &Path) -> Result<String, EditError> {
    let mut document = parsed(text)?;
    let has_plan = table(document.get_mut("tool")).is_some_and(|tool| tool.remove("plan").is_some());
    if has_plan {
        put(&mut document, scene, None)?;
    }
    make_absolute(document.as_table_mut(), folder);
    Ok(document.to_string())
}

/// Returns the text of the scene `from` with the approach of the scene `to`. Both have the same tables.
///
/// # Errors
/// [`EditError::Text`]: the text does not match the scene.
pub fn approached(text: &str, from: &Scene, to: &Scene) -> Result<String, EditError> {
    let mut document = parsed(text)?;
    put(&mut document, to, Some(from))?;
    Ok(document.to_string())
}

/// Adds a structure `name` that is the outside of the bone.
///
/// # Errors
/// [`EditError::Text`]: not TOML.
pub fn with_outside(text: &str, name: &str, margin_mm: f64) -> Result<String, EditError> {
    let mut document = parsed(text)?;
    let structure = push(document.as_table_mut(), "structure").ok_or_else(|| missing("structure"))?;
    structure.insert("name", toml_edit::value(name));
    structure.insert("built_in", toml_edit::value("outside_of_bone"));
    structure.insert("margin_mm", toml_edit::value(margin_mm));
    Ok(document.to_string())
}

fn parsed(text: &str) -> Result<DocumentMut, EditError> {
    text.parse().map_err(|cause: toml_edit::TomlError| EditError::Text(cause.to_string()))
}

fn missing(key: &str) -> EditError {
    EditError::Text(format!("`{key}` not found where it was expected"))
}

/// Writes the values of `to` that differ from those of `known`, or all of them.
fn put(document: &mut DocumentMut, to: &Scene, known: Option<&Scene>) -> Result<(), EditError> {
    let tool = table(document.get_mut("tool")).ok_or_else(|| missing("tool"))?;
    put_differing(tool, to, known, |scene| {
        [
            ("burr_start_mm", Some(scene.tool.burr_start_mm), DECIMALS),
            ("direction", Some(scene.tool.direction), DIRECTION_DECIMALS),
            ("bend_toward", Some(scene.tool.bend_toward), DIRECTION_DECIMALS),
        ]
    });
    for index in 0..to.predrill.len() {
        let is_new = entry(document.get_mut("predrill"), index).is_none();
        if is_new {
            let hole = push(document.as_table_mut(), "predrill").ok_or_else(|| missing("predrill"))?;
            hole.insert("diameter_mm", toml_edit::value(to.predrill[index].diameter_mm));
        }
        let hole = entry(document.get_mut("predrill"), index).ok_or_else(|| missing("predrill"))?;
        put_differing(hole, to, known.filter(|_| !is_new), |scene| {
            let hole = &scene.predrill[index];
            [("from_mm", Some(hole.from_mm), DECIMALS), ("to_mm", Some(hole.to_mm), DECIMALS)]
        });
    }
    for (index, controller) in to.controller.iter().enumerate() {
        if controller.curved_drilling.is_none() {
            continue;
        }
        let found = entry(document.get_mut("controller"), index);
        let drilling = found.and_then(|entry| table(entry.get_mut("curved_drilling")));
        let drilling = drilling.ok_or_else(|| missing("controller.curved_drilling"))?;
        let of = |scene: &Scene| scene.controller[index].curved_drilling.clone();
        put_differing(drilling, to, known, |scene| {
            [("target_mm", of(scene).and_then(|plan| plan.target_mm), DECIMALS)]
        });
        put_differing(drilling, to, known, |scene| {
            let plan = of(scene);
            let number = |of: fn(&ipc_types::scene::CurvedDrilling) -> f64| plan.as_ref().map(of);
            [
                ("insertion_mm", number(|plan| plan.insertion_mm), DECIMALS),
                ("ramp_start_mm", number(|plan| plan.ramp_start_mm), DECIMALS),
                ("ramp_end_mm", number(|plan| plan.ramp_end_mm), DECIMALS),
                ("tension_n", plan.as_ref().and_then(|plan| plan.tension_n), DECIMALS),
            ]
        });
    }
    let run = table(document.get_mut("run")).ok_or_else(|| missing("run"))?;
    put_differing(run, to, known, |scene| [("duration_s", Some(scene.run.duration_s), DECIMALS)]);
    if let (None, Some(drr)) = (known, &to.drr) {
        let table = table(document.get_mut("drr")).ok_or_else(|| missing("drr"))?;
        set(table, "isocentre_mm", drr.isocentre_mm, DECIMALS);
    }
    Ok(())
}

/// A value of an approach.
trait Number: PartialEq + Copy {
    fn put(self, table: &mut dyn TableLike, key: &str, decimals: i32);
}

impl Number for [f64; 3] {
    fn put(self, table: &mut dyn TableLike, key: &str, decimals: i32) {
        set(table, key, self, decimals);
    }
}

impl Number for f64 {
    fn put(self, table: &mut dyn TableLike, key: &str, decimals: i32) {
        let new = rounded(self, decimals);
        match table.get_mut(key).and_then(Item::as_value_mut) {
            Some(value) => replace(value, new),
            None => drop(table.insert(key, toml_edit::value(new))),
        }
    }
}

/// Sets the keys of a table whose values in `to` differ from those in `known`, or all of them.
fn put_differing<T: Number, const N: usize>(
    table: &mut dyn TableLike,
    to: &Scene,
    known: Option<&Scene>,
    values: impl Fn(&Scene) -> [(&'static str, Option<T>, i32); N],
) {
    let known = known.map(&values);
    for (index, (key, value, decimals)) in values(to).into_iter().enumerate() {
        let is_same = known.as_ref().is_some_and(|known| known[index].1 == value);
        if let Some(value) = value.filter(|_| !is_same) {
            value.put(table, key, decimals);
        }
    }
}

/// Appends a table to an array of tables, in the syntax that the text uses.
fn push<'t>(document: &'t mut Table, key: &str) -> Option<&'t mut dyn TableLike> {
    let item = document.entry(key).or_insert_with(|| Item::ArrayOfTables(ArrayOfTables::new()));
    match item {
        Item::ArrayOfTables(tables) => {
            tables.push(Table::new());
            let last = tables.len() - 1;
            tables.get_mut(last).map(|table| table as &mut dyn TableLike)
        }
        Item::Value(Value::Array(values)) => {
            values.push(InlineTable::new());
            let last = values.len() - 1;
            values.get_mut(last)?.as_inline_table_mut().map(|table| table as &mut dyn TableLike)
        }
        _ => None,
    }
}

/// Makes the paths of a table and of all tables below absolute.
fn make_absolute(table: &mut dyn TableLike, folder: &Path) {
    for (key, item) in table.iter_mut() {
        if let Some(path) = item.as_str().filter(|_| PATHS.contains(&key.get())) {
            let absolute = folder.join(path);
            let absolute = std::path::absolute(&absolute).unwrap_or(absolute);
            if let Some(value) = item.as_value_mut() {
                replace(value, absolute.to_string_lossy().into_owned());
            }
            continue;
        }
        match item {
            Item::ArrayOfTables(tables) => tables.iter_mut().for_each(|table| make_absolute(table, folder)),
            Item::Value(Value::Array(values)) => make_entries_absolute(values, folder),
            other => {
                if let Some(below) = other.as_table_like_mut() {
                    make_absolute(below, folder);
                }
            }
        }
    }
}

fn make_entries_absolute(values: &mut Array, folder: &Path) {
    for value in values.iter_mut() {
        if let Some(below) = value.as_inline_table_mut() {
            make_absolute(below, folder);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    /// Collects the names of keys that are paths, and of keys that are other texts.
    fn texts(schema: &serde_json::Value, paths: &mut BTreeSet<String>, others: &mut BTreeSet<String>) {
        for (name, property) in schema["properties"].as_object().into_iter().flatten() {
            let is_text = property["type"].to_string().contains("string");
            match property["x-kind"] == "path" {
                true => paths.insert(name.clone()),
                false => is_text && others.insert(name.clone()),
            };
        }
        let below = schema.as_object().into_iter().flat_map(serde_json::Map::values);
        let entries = schema.as_array().into_iter().flatten();
        below.chain(entries).for_each(|value| texts(value, paths, others));
    }

    #[test]
    fn the_keys_of_paths_are_those_of_the_schema() {
        let (mut paths, mut others) = (BTreeSet::new(), BTreeSet::new());
        texts(&ipc_types::scene::json_schema(), &mut paths, &mut others);
        assert_eq!(paths.iter().map(String::as_str).collect::<Vec<_>>(), PATHS);
        assert!(paths.is_disjoint(&others), "{others:?}");
    }

    const PLANNED: &str = r#"name = "a"
[run]
mode = "lockstep"
duration_s = 30.0
[volume]
path = "ct.nrrd" # mine
[tool]
plan = "p.mrk.json"
[[controller]]
name = "c"
drives = []
[controller.curved_drilling]
feed_mm_per_s = 1.0
tension_n = 3.0
burr_speed_rpm = 1.0
feedback = "none"
"#;
    const CURVE: &str = r#"{"markups": [{"type": "Curve", "coordinateSystem": "LPS", "controlPoints": [
        {"position": [0, 0, 0]}, {"position": [0, 0, 45.5]}, {"position": [5, 0, 65.25]}]}]}"#;

    /// The text for another folder needs no plan, and is the same scene to three decimals of a millimetre.
    #[test]
    fn a_portable_text_holds_the_points_of_its_plan_and_absolute_paths() {
        let read = |_: &Path| Ok(CURVE.to_owned());
        let planned = Scene::parse_with(PLANNED, Path::new("/scenes/a.toml"), &read).unwrap();
        let text = portable(PLANNED, &planned, Path::new("/scenes")).unwrap();
        assert!(text.contains("path = \"/scenes/ct.nrrd\" # mine\n") && !text.contains("plan ="), "{text}");
        let moved = Scene::parse(&text, Path::new("/elsewhere/a.toml")).unwrap();
        assert_eq!(
            (moved.volume.as_ref(), moved.tool.burr_start_mm),
            (planned.volume.as_ref(), planned.tool.burr_start_mm)
        );
        assert_eq!(moved.predrill, planned.predrill);
        let [moved, planned] =
            [&moved, &planned].map(|scene| scene.controller[0].curved_drilling.clone().unwrap());
        assert_eq!(moved.target_mm, planned.target_mm);
        assert!((moved.insertion_mm - planned.insertion_mm).abs() <= 0.5e-3);
    }

    #[test]
    fn a_structure_is_added_in_either_syntax() {
        let tool =
            "burr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]";
        let text = PLANNED.replace("plan = \"p.mrk.json\"", tool);
        let text = text.replace("feedback", "insertion_mm = 1.0\nramp_end_mm = 1.0\nfeedback");
        let ball = "{ centre_mm = [0.0, 0.0, 0.0], radius_mm = 1.0 }";
        let inline = format!("structure = [{{ name = \"n\", ball = {ball} }}]\n{text}");
        let tables = inline.lines().skip(1).collect::<Vec<_>>().join("\n");
        for (text, count) in [(inline, 2), (tables, 1)] {
            let added = with_outside(&text, "outside", 5.0).unwrap();
            let scene = Scene::parse(&added, Path::new("a.toml")).unwrap();
            assert_eq!(scene.structure.len(), count);
            let last = &scene.structure[count - 1];
            assert_eq!((last.name.as_str(), last.margin_mm), ("outside", 5.0));
        }
    }
}
