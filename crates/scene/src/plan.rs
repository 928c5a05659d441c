//! `tool.plan`: a 3D Slicer markups file in place of the points of a scene.
//!
//! The keys derived from the plan go into the scene's table before parsing, so a [`Scene`](crate::Scene)
//! holds numbers only, and so do its copies in the session and in the log.

use std::path::Path;

use markups::{Plan, read};
use toml::{Table, Value};

use crate::check::Checker;
use crate::error::SceneError;
use crate::named_file::{ReadText, numbers, tables, take_text};
use crate::tool::STANDARD_RADII;

/// Clearance of the pilot hole around the burr, mm in diameter: as in the scenes of `configs/`, 7 mm for a
/// burr of 6.5 mm.
const PILOT_PLAY_MM: f64 = 0.5;
/// Keys given by the plan's points, which a scene with a plan must not set.
const PLACES: [&str; 2] = ["burr_start_mm", "direction"];

/// Replaces `tool.plan` in a scene's table by the keys derived from the plan. Returns false if the scene
/// names no plan.
///
/// # Errors
/// The file cannot be read or holds no plan, or the scene also sets one of its points.
pub(crate) fn put_in(
    scene: &mut Table,
    folder: &Path,
    read: &ReadText,
    checker: &Checker,
) -> Result<bool, SceneError> {
    let Some(Value::Table(tool)) = scene.get_mut("tool") else { return Ok(false) };
    let Some(named) = take_text(tool, ["tool", "plan"], "a path", checker)? else { return Ok(false) };
    let plan = load(&folder.join(named), read).map_err(|problem| checker.invalid("tool.plan", problem))?;
    for key in PLACES.into_iter().chain(plan.is_curved().then_some("bend_toward")) {
        if tool.contains_key(key) {
            return Err(stands_twice(checker, &format!("tool.{key}")));
        }
    }
    tool.insert("burr_start_mm".to_owned(), numbers(plan.burr_start_mm()));
    tool.insert("direction".to_owned(), numbers(plan.direction()));
    tool.entry("bend_toward").or_insert_with(|| numbers(plan.bend_toward()));
    if scene.contains_key("volume") {
        let diameter_mm = burr_diameter_mm(scene) + PILOT_PLAY_MM;
        drill(scene, plan.pilot_hole_mm(), diameter_mm);
    }
    if let Some(Value::Table(drr)) = scene.get_mut("drr") {
        drr.entry("isocentre_mm").or_insert_with(|| numbers(plan.middle_mm()));
    }
    for controller in tables(scene, "controller") {
        steer(controller, &plan, checker)?;
    }
    Ok(true)
}

/// Reads a plan.
///
/// # Errors
/// A message that names the file: it cannot be read or holds no plan.
pub fn load(file: &Path, read_text: &ReadText) -> Result<Plan, String> {
    let name = foreign_text::foreign_path(file);
    let text = read_text(file).map_err(|cause| format!("{name}: cannot be read ({cause})"))?;
    let markups = read(&text).map_err(|cause| format!("{name}: {cause}"))?;
    Plan::of(&markups).map_err(|cause| format!("{name}: {cause}"))
}

fn stands_twice(checker: &Checker, key: &str) -> SceneError {
    checker.invalid(key, "follows from `tool.plan`; set only one of the two")
}

/// The diameter of the scene's or its tool's burr; the standard one if neither is set or both will be
/// refused.
fn burr_diameter_mm(scene: &Table) -> f64 {
    let manipulator = scene.get("manipulator");
    let number = |value: &Value| value.as_float().or(value.as_integer().map(|whole| whole as f64));
    let own = manipulator.and_then(|table| number(table.get("burr_diameter_mm")?));
    let of_tool =
        || manipulator.and_then(|table| number(table.get("tool")?.get("burr")?.get("diameter_mm")?));
    own.or_else(of_tool).unwrap_or(2e3 * STANDARD_RADII.cutter.widest_radius_m())
}

/// Appends the pilot hole after the scene's own holes, so that their numbers in messages stay the same.
fn drill(scene: &mut Table, [from_mm, to_mm]: [[f64; 3]; 2], diameter_mm: f64) {
    let hole = [
        ("from_mm", numbers(from_mm)),
        ("to_mm", numbers(to_mm)),
        ("diameter_mm", Value::Float(diameter_mm)),
    ];
    let hole = hole.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
    let holes = scene.entry("predrill").or_insert_with(|| Value::Array(Vec::new()));
    if let Value::Array(holes) = holes {
        holes.push(Value::Table(hole));
    }
}

/// Sets a built-in controller's target and feed length.
fn steer(controller: &mut Table, plan: &Plan, checker: &Checker) -> Result<(), SceneError> {
    if let Some(Value::Table(drilling)) = controller.get_mut("curved_drilling") {
        if drilling.contains_key("target_mm") {
            return Err(stands_twice(checker, "controller.curved_drilling.target_mm"));
        }
        let ramp_start_mm = drilling.get("ramp_start_mm").and_then(Value::as_float).unwrap_or(0.0);
        let length_mm = Value::Float(ramp_start_mm + plan.arc(ramp_start_mm).length_mm);
        drilling.insert("target_mm".to_owned(), numbers(plan.target_mm()));
        drilling.entry("insertion_mm").or_insert_with(|| length_mm.clone());
        drilling.entry("ramp_end_mm").or_insert(length_mm);
        if !plan.is_curved() && !drilling.contains_key("calibration") {
            drilling.entry("tension_n").or_insert(Value::Float(0.0));
        }
    }
    if let Some(Value::Table(skiving)) = controller.get_mut("skiving") {
        skiving.entry("depth_mm").or_insert_with(|| Value::Float(plan.arc(0.0).length_mm));
    }
    Ok(())
}
