//! `trabecula scene show SCENE -o plan.png`: draws a scene before it is run and prints its measurements.

use std::path::PathBuf;

use clap::Args;
use foreign_text::foreign_path;
use serde_json::json;
use voxel_grid::Ct;

use crate::failure::Failure;
use crate::launcher::volume_source::{self, VolumeFiles};
use crate::output::refuse_existing;
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
    let Some(Ct { volume, .. }) = volume_source::load(&scene, arguments.volume_files)? else {
        return Err(Failure::bad_input(format!(
            "{source}: the scene has no `[volume]`, so there is no CT to show"
        )));
    };
    let shapes = Shapes::of(&scene)?;
    let threshold_hu = scene.volume.as_ref().map_or(0, |volume| volume.bone_threshold_hu);
    let surroundings = Surroundings::of(&volume, threshold_hu);
    let facts = Facts::of(&scene, &volume, &surroundings, &shapes)?;
    let pictured = PictureInput { scene: &scene, volume: &volume, shapes: &shapes, facts: &facts };
    draw(&pictured).and_then(|figure| figure.write_png(output)).map_err(ReportError::from)?;
    arguments.figures.say(
        || text_of(arguments, &facts),
        || merged(json!({"scene": scene.name, "output": path_text(output)}), facts.json(&shapes)),
    );
    Ok(())
}

fn text_of(arguments: &ShowArguments, facts: &Facts) -> String {
    let findings: String = facts.findings.iter().map(|finding| format!("{finding}\n")).collect();
    let decimals = facts.scale.decimals();
    let entry = facts.entry_note().map_or(String::new(), |note| format!("entry        {note}\n"));
    format!(
        "{findings}{entry}target       {:.decimals$} mm to the nearest bone surface, {:.decimals$} mm of bone \
         ahead\nwritten      {}",
        facts.depth_mm,
        facts.ahead_mm,
        arguments.output.display()
    )
}
