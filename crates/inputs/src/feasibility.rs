//! Checks whether a scene is feasible (`simulation::findings`): what cannot work is refused, what is probably
//! a mistake gives a warning.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use controllers::BuiltIn;
use foreign_text::number;
use ipc_types::arm_meshes;
use ipc_types::scene::{CurvedDrilling, Feedback, Scene, keys_without_effect};
use run_log::triggers::Triggers;
use simulation::{CtView, Verdict, findings};
use voxel_grid::Volume;
use xray::DrrError;
use xray::from_scene::scene_c_arm;

use crate::failure::Failure;
use crate::suspicions;

/// Checks a scene with its volume; without one, only what does not depend on bone. Returns a warning for
/// everything improbable. `source` names the scene in messages.
///
/// # Errors
/// Bad input: something in it is impossible; the message lists every such finding on its own line.
pub fn check(
    scene: &Scene,
    source: &dyn std::fmt::Display,
    volume: Option<&Volume>,
) -> Result<Vec<String>, Failure> {
    let refused = |cause: &dyn std::fmt::Display| Failure::bad_input(format!("{source}: {cause}"));
    match scene.arm.xray_density_g_per_cm3 {
        Some(_) => arm_meshes::solids(&scene.arm).map(drop),
        None => arm_meshes::load(&scene.arm).map(drop),
    }
    .map_err(|cause| refused(&cause))?;
    if let Some(drr) = &scene.drr {
        let key = if drr.carm.is_some() { "drr.carm" } else { "drr" };
        scene_c_arm(drr).map_err(|cause| refused(&format!("`{key}`: {}", in_millimetres(cause))))?;
    }
    for entry in &scene.controller {
        BuiltIn::of(scene, &entry.name, &ipc_types::text_file::read).map_err(|cause| refused(&cause))?;
    }
    let ct = volume.map(CtView::from);
    Triggers::parse(&scene.recording.triggers)
        .map_err(|cause| refused(&format!("`recording.triggers`: {cause}")))?;
    let found = findings(scene, ct, &is_program).map_err(|cause| match cause.is_of_the_machine() {
        true => Failure::failed(format!("{source}: {cause}")),
        false => refused(&cause),
    })?;
    let of = |verdict| found.iter().filter(move |finding| finding.verdict == verdict);
    let impossible: Vec<String> =
        of(Verdict::Impossible).map(|finding| format!("{source}: {finding}")).collect();
    if !impossible.is_empty() {
        return Err(Failure::bad_input(impossible.join("\n")));
    }
    if let Some(volume) = volume {
        refuse_outside(scene, source, volume)?;
    }
    let unseen = unseen_by_feedback(scene).into_iter().chain(source_in_volume(scene, volume));
    let coarse = volume.and_then(|volume| coarse_voxels(scene, volume));
    let undrawn = arm_meshes::undrawn(&scene.arm);
    let vain = keys_without_effect(scene).map(|(key, why)| format!("`{key}` has no effect {why}"));
    let unlikely = of(Verdict::Unlikely)
        .map(|finding| finding.to_string())
        .chain(unseen)
        .chain(coarse)
        .chain(undrawn)
        .chain(vain);
    Ok(unlikely.map(|finding| format!("warning: {source}: {finding}")).collect())
}

/// Refuses a target outside the volume: there is nothing to drill, and the plan is from another CT or in the
/// wrong frame.
fn refuse_outside(scene: &Scene, source: &dyn std::fmt::Display, volume: &Volume) -> Result<(), Failure> {
    let mut targets = drillings(scene).filter_map(|drilling| drilling.target_mm);
    match targets.find(|target_mm| !volume.holds(target_mm.map(|x| x * 1e-3))) {
        None => Ok(()),
        Some(target @ [x, y, z]) => Err(Failure::bad_input(format!(
            "{source}: `controller.curved_drilling.target_mm` is [{x:.1}, {y:.1}, {z:.1}], expected a point \
             within the volume{}",
            suspicions::ras_hint(volume, target)
        ))),
    }
}

/// Converts the renderer's error, with lengths in millimetres.
pub fn in_millimetres(cause: DrrError) -> String {
    match cause {
        DrrError::OutOfRange {
            field: "distance of the source from the detector plane, m", given, ..
        } => {
            format!(
                "the source is {} mm from the detector's plane; expected 1 to 10000 mm",
                number(given * 1e3)
            )
        }
        DrrError::OutOfRange { field: field @ ("source_m" | "detector_centre_m"), given, .. } => {
            let (place, mm) = (field.trim_end_matches("_m"), number(given * 1e3));
            format!("`{place}_mm` is {mm}, expected -100000 to 100000 mm")
        }
        other => other.to_string(),
    }
}

/// Finds a burr that the frames of image feedback do not show, at the start or at the target.
fn unseen_by_feedback(scene: &Scene) -> Option<String> {
    let drilling = drillings(scene).find(|drilling| drilling.feedback == Feedback::Image)?;
    let c_arm = scene_c_arm(scene.drr.as_ref()?).ok()?;
    let is_seen = |place_mm: &[f64; 3]| {
        c_arm.project(place_mm.map(|x| x * 1e-3)).is_some_and(|at| {
            let within = |place: f64, count: u32| (0.0..f64::from(count)).contains(&(place + 0.5));
            within(at.column, c_arm.columns) && within(at.row, c_arm.rows)
        })
    };
    let places = [("burr at its start", Some(scene.tool.burr_start_mm)), ("target", drilling.target_mm)];
    let (what, _) = places.into_iter().find(|(_, place)| place.as_ref().is_some_and(|mm| !is_seen(mm)))?;
    let key = if scene.drr.as_ref()?.carm.is_some() { "drr.carm" } else { "drr.isocentre_mm" };
    Some(format!("`{key}`: the X-ray frames do not show the {what}, which image feedback looks for"))
}

/// Finds an X-ray source inside the volume.
fn source_in_volume(scene: &Scene, volume: Option<&Volume>) -> Option<String> {
    let source_m = scene_c_arm(scene.drr.as_ref()?).ok()?.source_m;
    let [x, y, z] = source_m.map(|x| x * 1e3);
    volume?.holds(source_m).then(|| {
        format!("`drr`: the X-ray source, at ({x:.0}, {y:.0}, {z:.0}) mm, is inside the volume; expected outside the patient")
    })
}

/// Largest voxel for a burr, as a share of its diameter: in coarser voxels the wall of its hole is as rough
/// as the hole is wide, and a tool jams in it.
const VOXEL_SHARE: f64 = 0.25;

/// Finds voxels that are too coarse for the burr.
fn coarse_voxels(scene: &Scene, volume: &Volume) -> Option<String> {
    drillings(scene).next()?;
    let voxel_mm = 1e3 * volume.grid.spacing_m().into_iter().fold(0.0, f64::max);
    let burr_mm = 2e3 * scene.manipulator.radii().cutter.widest_radius_m();
    (voxel_mm > VOXEL_SHARE * burr_mm).then(|| {
        format!(
            "`volume` has voxels of {voxel_mm:.2} mm; expected at most {:.2}, a quarter of the burr: coarser \
             ones make rough walls",
            VOXEL_SHARE * burr_mm
        )
    })
}

fn drillings(scene: &Scene) -> impl Iterator<Item = &CurvedDrilling> {
    scene.controller.iter().filter_map(|controller| controller.curved_drilling.as_ref())
}

/// Whether a program name is an executable file: a path, or a name in one of the folders of `PATH`.
pub fn is_program(name: &str) -> bool {
    if name.contains('/') {
        return is_executable(Path::new(name));
    }
    let folders = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&folders).any(|folder| is_executable(&folder.join(name)))
}

fn is_executable(path: &Path) -> bool {
    path.metadata().is_ok_and(|found| found.is_file() && found.permissions().mode() & 0o111 != 0)
}
