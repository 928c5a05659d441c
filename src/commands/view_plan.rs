//! `trabecula view SCENE.toml`: a scene before its run.

use std::path::Path;

use ipc_types::scene::Scene;
use serde_json::{Value, json};
use simulation::Simulation;
use viewer_proc::log::LogVolume;
use viewer_proc::plan::Planned;

use super::view::tool_shape;
use crate::failure::Failure;
use crate::launcher::volume_source::{self, VolumeFiles};
use crate::scene_picture::facts::Facts;
use crate::scene_picture::shape::Shapes;
use crate::scenes::SceneSource;

/// Reads and measures a scene.
///
/// # Errors
/// An invalid scene, a volume that is not there or cannot be read (2).
pub fn load(file: &Path, files: VolumeFiles) -> Result<Planned, Failure> {
    let (scene, _) = crate::plan::load_scene(&SceneSource::File(file.to_owned()))?;
    volume_source::refuse_missing(&file.display(), &scene)?;
    let loaded = volume_source::load(&scene, files)?;
    let shapes = Shapes::of(&scene)?;
    let view = loaded.as_ref().map(volume_source::ct_view);
    let simulation = Simulation::new(&scene, view).map_err(Failure::bad_input)?;
    let (state, predrilled) = (*simulation.state(), simulation.gone());
    drop(simulation);
    let facts = loaded.as_ref().map(|loaded| Facts::of(&scene, loaded, &shapes)).transpose()?;
    let plan = plan(&scene, &shapes, facts.as_ref())?;
    let volume = loaded.map(|(volume, sha256)| {
        let grid = volume_source::message(&volume, sha256).grid().map_err(Failure::bad_input)?;
        Ok::<_, Failure>(LogVolume { grid, hu: volume.hu, sha256 })
    });
    Ok(Planned {
        path: file.to_owned(),
        tool: tool_shape(&scene),
        state,
        volume: volume.transpose()?,
        predrilled,
        plan,
        findings: facts.map(|facts| facts.findings).unwrap_or_default(),
        scene,
    })
}

/// The figures of `scene show`, the tool at the end of the path, and the C-arm's source and detector.
fn plan(scene: &Scene, shapes: &Shapes, facts: Option<&Facts>) -> Result<Value, Failure> {
    let end = &shapes.at_end;
    let line_m: Vec<[f64; 3]> = end.tube.line_mm.iter().map(|point| (point * 1e-3).into()).collect();
    let c_arm = scene.drr.as_ref().map(|drr| xray::from_scene::scene_c_arm(drr)).transpose();
    let c_arm = c_arm.map_err(Failure::bad_input)?;
    let frustum = c_arm.map(|c_arm| {
        let (right, foot) = (f64::from(c_arm.columns) - 0.5, f64::from(c_arm.rows) - 0.5);
        let corners = [(-0.5, -0.5), (right, -0.5), (right, foot), (-0.5, foot)];
        let corners = corners.map(|(column, row)| c_arm.pixel_m(column, row));
        json!({"source_m": c_arm.source_m, "detector_m": corners})
    });
    Ok(json!({
        "facts": facts.map(|facts| facts.json(shapes)),
        "tool_end": shapes.is_planned.then(|| json!({
            "line_m": line_m, "radius_m": 1e-3 * end.tube.radius_mm, "burr_radius_m": 1e-3 * end.burr.radius_mm,
        })),
        "frustum": frustum,
    }))
}
