//! `trabecula view SCENE.toml`: shows a scene whose points can be moved, saved and run from the page.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use ipc_types::process::EndRequest;
use ipc_types::scene::Scene;
use nalgebra::Vector3;
use serde_json::{Value, json};
use simulation::{CtView, Simulation};
use viewer_proc::ViewerError;
use viewer_proc::plan::{self, Planner, SaveOutcome, ScenePreview};
use viewer_proc::server::ListeningPort;
use viewer_proc::services::Places;
use voxel_grid::{Ct, Volume};

use super::view::{failure, tool_shape};
use super::view_arm::arm_looks;
use super::view_run::StartedRun;
use crate::failure::Failure;
use crate::launcher::volume_source::{self, VolumeFiles};
use crate::plan_edit::{SceneName, moved};
use crate::prediction::Prediction;
use crate::scene_picture::facts::Facts;
use crate::scene_picture::shape::{Shapes, ToolShape, Tube};
use crate::scene_picture::surroundings::Surroundings;
use crate::scenes::SceneSource;

/// An opened scene with its volume, which all measurements share.
pub struct OpenedScene {
    file: PathBuf,
    text: String,
    scene: Scene,
    ct: Option<Arc<Ct>>,
    volume_files: VolumeFiles,
}

impl OpenedScene {
    /// Reads a scene and its volume.
    ///
    /// # Errors
    /// An invalid scene, a missing or unreadable volume (2).
    pub fn open(file: &Path, volume_files: VolumeFiles) -> Result<OpenedScene, Failure> {
        let source = SceneSource::File(file.to_owned());
        let (scene, _) = crate::plan::load_scene(&source)?;
        volume_source::refuse_missing(&file.display(), &scene)?;
        let ct = volume_source::load(&scene, volume_files)?.map(Arc::new);
        Ok(OpenedScene { file: file.to_owned(), text: source.text()?, scene, ct, volume_files })
    }

    /// Shows the scene until the process is asked to end or a run starts; returns that run.
    ///
    /// # Errors
    /// The simulation rejects the scene (2); the server cannot be started (1).
    pub fn view(
        &self,
        door: &ListeningPort,
        ready: impl FnOnce(),
        end: &EndRequest,
    ) -> Result<Option<StartedRun>, Failure> {
        let threshold_hu = self.scene.volume.as_ref().map_or(0, |volume| volume.bone_threshold_hu);
        let volume = self.ct.as_ref().map(|ct| &ct.volume);
        let surroundings = volume.map(|volume| Surroundings::of(volume, threshold_hu));
        let first = measure(&self.scene, (volume, surroundings.as_ref()), None)?;
        let looks = arm_looks(&self.scene)
            .map_err(|cause| Failure::bad_input(format!("{}: {cause}", self.file.display())))?;
        let mut started = None;
        let editor = Editor {
            opened: self,
            surroundings: surroundings.as_ref(),
            places: Places::default(),
            text: self.text.clone(),
            saved: (self.file.clone(), self.text.clone()),
            unpredicted: Some(self.scene.clone()),
            run: &mut started,
        };
        let session = plan::view(&self.file, (first, looks, volume), editor, door, ready, end);
        let session = session.map_err(|error: ViewerError| failure(&error))?;
        Ok(started.filter(|_| session.is_some()))
    }
}

/// Edits an opened scene without changing its file.
struct Editor<'a> {
    opened: &'a OpenedScene,
    surroundings: Option<&'a Surroundings<'a>>,
    /// Moved points.
    places: Places,
    /// Text of the edited scene.
    text: String,
    /// File and text last saved.
    saved: (PathBuf, String),
    /// The edited scene until its run has been predicted.
    unpredicted: Option<Scene>,
    run: &'a mut Option<StartedRun>,
}

impl Editor<'_> {
    fn take(&mut self, places: Places) -> Result<ScenePreview, String> {
        let OpenedScene { file, text, scene, ct, .. } = self.opened;
        let volume = ct.as_ref().map(|ct| &ct.volume);
        let text = moved(text, scene, &places).map_err(|cause| format!("{}: {cause}", file.display()))?;
        let source = SceneSource::Changed { source: Box::new(SceneSource::File(file.clone())), text };
        let planned = crate::plan::load_scene(&source)
            .and_then(|(scene, _)| measure(&scene, (volume, self.surroundings), None))
            .map_err(|refused| refused.message)?;
        (self.places, self.text) = (places, source.text().map_err(|refused| refused.message)?);
        self.unpredicted = Some(planned.scene.clone());
        Ok(planned)
    }
}

impl Planner for Editor<'_> {
    fn move_places(&mut self, places: &Places) -> Result<ScenePreview, String> {
        self.take(Places {
            burr_start_mm: places.burr_start_mm.or(self.places.burr_start_mm),
            target_mm: places.target_mm.or(self.places.target_mm),
            isocentre_mm: places.isocentre_mm.or(self.places.isocentre_mm),
        })
    }

    fn restore(&mut self) -> Result<ScenePreview, String> {
        self.take(Places::default())
    }

    fn predict(&mut self, is_to_end: &mut dyn FnMut() -> bool) -> Option<ScenePreview> {
        let scene = self.unpredicted.take()?;
        let mut has_ended = false;
        let mut ends = || {
            has_ended |= is_to_end();
            has_ended
        };
        let ct = &self.opened.ct;
        // What a run would refuse is shown by the findings already.
        let prediction = Prediction::unless(&scene, ct.clone(), &mut ends).ok()?;
        if has_ended {
            self.unpredicted = Some(scene);
            return None;
        }
        let volume = ct.as_ref().map(|ct| &ct.volume);
        measure(&scene, (volume, self.surroundings), Some(&prediction)).ok()
    }

    fn save(&mut self, name: &str, replace: bool) -> Result<SaveOutcome, String> {
        let name = SceneName::parse(name).map_err(|cause| cause.to_string())?;
        let original = &self.opened.file;
        let file = name.within(output_file::folder_of(original));
        let is_there = file.symlink_metadata().is_ok();
        let is_original = |file: &Path| match (file.canonicalize(), original.canonicalize()) {
            (Ok(file), Ok(original)) => file == original,
            _ => false,
        };
        if is_there && is_original(&file) {
            return Err(format!(
                "{} is the opened scene, which is never overwritten: choose another name",
                file.display()
            ));
        }
        if is_there && !replace {
            return Ok(SaveOutcome::Exists(file));
        }
        let written = match is_there {
            true => replaced(&file, &self.text),
            false => output_file::write(&file, &self.text).map_err(|cause| cause.to_string()),
        };
        written?;
        self.saved = (file.clone(), self.text.clone());
        Ok(SaveOutcome::As(file))
    }

    fn run(&mut self) -> Result<(), String> {
        let (file, text) = &self.saved;
        if self.text != *text {
            return Err("the plan has unsaved changes: save it before running it".to_owned());
        }
        if self.run.is_some() {
            return Err("a run of this plan has already been started".to_owned());
        }
        *self.run = Some(StartedRun::start(file, self.opened.volume_files)?);
        Ok(())
    }

    fn session(&mut self) -> Option<Result<PathBuf, String>> {
        let found = self.run.as_mut()?.begun()?;
        if found.is_err() {
            *self.run = None;
        }
        Some(found)
    }
}

/// Atomically replaces a file after the user has confirmed it. A symbolic link is replaced, not its target.
fn replaced(file: &Path, text: &str) -> Result<(), String> {
    let folder = output_file::folder_of(file);
    let write = || {
        let draft = tempfile::Builder::new().prefix(".trabecula-").tempfile_in(folder)?;
        std::fs::write(draft.path(), text)?;
        output_file::sync_file(draft.as_file())?;
        draft.persist(file).map_err(|failed| failed.error)?;
        output_file::sync_folder(folder)
    };
    write().map_err(|cause: std::io::Error| format!("{}: cannot be written ({cause})", file.display()))
}

/// Measures a scene for display.
fn measure(
    scene: &Scene,
    (volume, surroundings): (Option<&Volume>, Option<&Surroundings<'_>>),
    prediction: Option<&Prediction>,
) -> Result<ScenePreview, Failure> {
    let shapes = Shapes::of(scene, prediction)?;
    let simulation = Simulation::new(scene, volume.map(CtView::from)).map_err(Failure::bad_input)?;
    let (state, predrilled) = (*simulation.state(), simulation.gone());
    drop(simulation);
    let facts = volume.zip(surroundings).map(|(volume, map)| Facts::of(scene, volume, map, &shapes));
    let facts = facts.transpose()?.map(|facts| facts.with(prediction));
    let plan = plan(scene, (&shapes, prediction), facts.as_ref())?;
    Ok(ScenePreview {
        tool: tool_shape(scene),
        state,
        predrilled,
        plan,
        findings: facts.map(|facts| facts.findings).unwrap_or_default(),
        scene: scene.clone(),
    })
}

/// Returns the measurements of `scene show`, the tool at the end of the path, the C-arm's source and
/// detector, and the points with their scene file keys.
fn plan(
    scene: &Scene,
    (shapes, prediction): (&Shapes, Option<&Prediction>),
    facts: Option<&Facts>,
) -> Result<Value, Failure> {
    let predicted = shapes
        .predicted
        .as_ref()
        .map(|(path_mm, tool)| json!({"path_m": metres(path_mm), "tool_end": tool_json(tool)}));
    let c_arm = scene.drr.as_ref().map(xray::from_scene::scene_c_arm).transpose();
    let c_arm = c_arm.map_err(Failure::bad_input)?;
    let frustum = c_arm.map(|c_arm| {
        let (right, foot) = (f64::from(c_arm.columns) - 0.5, f64::from(c_arm.rows) - 0.5);
        let corners = [(-0.5, -0.5), (right, -0.5), (right, foot), (-0.5, foot)];
        let corners = corners.map(|(column, row)| c_arm.pixel_m(column, row));
        json!({"source_m": c_arm.source_m, "detector_m": corners})
    });
    let drilling = scene.controller.iter().find_map(|controller| controller.curved_drilling.as_ref());
    Ok(json!({
        "facts": facts.map(|facts| facts.json(shapes)),
        "profile": facts.map(|facts| facts.profile.iter().map(|sample| json!([sample.along_mm, sample.hu])).collect::<Vec<_>>()),
        "bone_threshold_hu": scene.volume.as_ref().map(|volume| volume.bone_threshold_hu),
        "places": {
            "burr_start_mm": scene.tool.burr_start_mm,
            "target_mm": drilling.map(|drilling| drilling.target_mm.unwrap_or_else(|| shapes.target_mm().into())),
            "isocentre_mm": scene.drr.as_ref().map(|drr| drr.isocentre_mm),
        },
        "tool_end": shapes.is_planned.then(|| tool_json(&shapes.at_end)),
        "predicted": predicted,
        "prediction": prediction.map(Prediction::json),
        "frustum": frustum,
    }))
}

/// Returns points in metres.
fn metres(line_mm: &[Vector3<f64>]) -> Vec<[f64; 3]> {
    line_mm.iter().map(|point| (point * 1e-3).into()).collect()
}

fn tool_json(tool: &ToolShape) -> Value {
    let ball =
        |ball: &Tube| json!({"centre_m": metres(&ball.line_mm).first(), "radius_m": 1e-3 * ball.radius_mm});
    let burr: Vec<Value> = tool.burr.iter().map(ball).collect();
    json!({"line_m": metres(&tool.tube.line_mm), "radius_m": 1e-3 * tool.tube.radius_mm, "burr": burr})
}
