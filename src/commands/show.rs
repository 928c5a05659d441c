//! `trabecula scene show SCENE -o plan.png`: draws a scene before it is run and prints its measurements.

use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use foreign_text::foreign_path;
use serde_json::json;

use crate::failure::Failure;
use crate::launcher::volume_source::{self, VolumeFiles};
use crate::output::refuse_existing;
use crate::prediction::Prediction;
use crate::report::ReportError;
use crate::say::{Figures, merged, path_text};
use crate::scene_picture::facts::Facts;
use crate::scene_picture::figure::{PictureInput, draw};
use crate::scene_picture::shape::Shapes;
use crate::scene_picture::surroundings::Surroundings;
use crate::scenes::{BuiltIn, SceneSource};

/// Arguments of `scene show`.
#[derive(Debug, Args)]
pub struct ShowArguments {
    /// Scene file; default: the built-in femur.
    scene: Option<PathBuf>,
    /// New PNG file.
    #[arg(short, long)]
    output: PathBuf,
    /// Do not predict the run by simulating the scene.
    #[arg(long)]
    no_simulate: bool,
    #[command(flatten)]
    volume_files: VolumeFiles,
    #[command(flatten)]
    figures: Figures,
}

/// Draws the picture.
///
/// # Errors
/// A scene that is invalid or has no volume, an output that exists or is not a PNG (2); a full disk (1).
pub fn run(arguments: &ShowArguments) -> Result<(), Failure> {
    let output = &arguments.output;
    if !output.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("png")) {
        return Err(Failure::bad_input(format!(
            "--output is {}, expected a .png file",
            foreign_path(output)
        )));
    }
    refuse_existing(&[output])?;
    let source = SceneSource::new(arguments.scene.as_deref(), BuiltIn::Femur);
    let (scene, _) = crate::plan::load_scene(&source)?;
    volume_source::refuse_missing(&source, &scene)?;
    let Some(ct) = volume_source::load(&scene, arguments.volume_files)? else {
        return Err(Failure::bad_input(format!(
            "{source}: the scene has no `[volume]`, so there is no CT to show"
        )));
    };
    let ct = Arc::new(ct);
    let volume = &ct.volume;
    let prediction = match arguments.no_simulate {
        false => Some(Prediction::of(&scene, Some(Arc::clone(&ct)))?),
        true => None,
    };
    let shapes = Shapes::of(&scene, prediction.as_ref())?;
    let threshold_hu = scene.volume.as_ref().map_or(0, |volume| volume.bone_threshold_hu);
    let surroundings = Surroundings::of(volume, threshold_hu);
    let facts = Facts::of(&scene, volume, &surroundings, &shapes)?.with(prediction.as_ref());
    let pictured = PictureInput { scene: &scene, volume, shapes: &shapes, facts: &facts };
    draw(&pictured).and_then(|figure| figure.write_png(output)).map_err(ReportError::from)?;
    arguments.figures.say(
        || text_of(arguments, &facts, prediction.as_ref()),
        || {
            let prediction = prediction.as_ref().map(Prediction::json);
            let named = json!({"scene": scene.name, "output": path_text(output), "prediction": prediction});
            merged(named, facts.json(&shapes))
        },
    );
    Ok(())
}

fn text_of(arguments: &ShowArguments, facts: &Facts, prediction: Option<&Prediction>) -> String {
    let findings: String = facts.findings.iter().map(|finding| format!("{finding}\n")).collect();
    let decimals = facts.scale.decimals();
    let entry = facts.entry_note().map_or(String::new(), |note| format!("entry        {note}\n"));
    format!(
        "{findings}{entry}target       {:.decimals$} mm to the nearest bone surface, {:.decimals$} mm of bone \
         ahead\n{}written      {}",
        facts.depth_mm,
        facts.ahead_mm,
        prediction.map_or(String::new(), |prediction| prediction.text() + "\n"),
        arguments.output.display()
    )
}
