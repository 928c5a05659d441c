//! `trabecula scene from-markups`: a scene from a plan made in 3D Slicer.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;
use foreign_text::foreign_path;
use ipc_types::scene::{Scene, plan};
use ipc_types::text_file;
use markups::Plan;
use volume_io::{Label, ReadOptions, read_as};
use voxel_grid::{Ct, Volume};

use super::scene::findings_json;
use crate::failure::Failure;
use crate::feasibility;
use crate::launcher::volume_source::{self, VolumeFiles};
use crate::output::refuse_existing;
use crate::planned::PlannedScene;
use crate::prediction::Prediction;
use crate::say::{Figures, path_text};

/// Arguments of `scene from-markups`.
#[derive(Debug, Args)]
pub struct FromMarkupsArguments {
    /// 3D Slicer markups (`.mrk.json`, `.fcsv`): a line, or points named entry, target and, for a curved
    /// path, bend.
    plan: PathBuf,
    /// CT on which the markups were placed, or a segmentation (`.seg.nrrd`) with `--segment`.
    #[arg(long)]
    ct: PathBuf,
    /// Name or value of the bone segment of a segmentation.
    #[arg(long, value_name = "NAME")]
    segment: Option<String>,
    /// New scene file; default: named after the plan, in the current folder.
    #[arg(short, long)]
    output: Option<PathBuf>,
    /// Do not predict the run by simulating the scene.
    #[arg(long)]
    no_simulate: bool,
    #[command(flatten)]
    volume_files: VolumeFiles,
    #[command(flatten)]
    figures: Figures,
}

/// Runs the command.
///
/// # Errors
/// An invalid plan or volume, points outside it, an infeasible scene, or an output that exists (2); a full
/// disk (1).
pub fn run(arguments: &FromMarkupsArguments) -> Result<(), Failure> {
    let name = name_of(&arguments.plan);
    let output = arguments.output.clone().unwrap_or_else(|| Path::new(&name).with_extension("toml"));
    refuse_existing(&[&output])?;
    let plan = plan::load(&arguments.plan, &text_file::read).map_err(Failure::bad_input)?;
    let (volume, _) = read_as(&arguments.ct, &options(arguments))?;
    refuse_outside(arguments, &plan, &volume)?;
    let folder = absolute(output.parent().unwrap_or(Path::new("")));
    let [plan_file, ct] = [&arguments.plan, &arguments.ct].map(|file| from(&folder, file));
    let mut planned = PlannedScene {
        name,
        plan_file: &plan_file,
        plan,
        ct: &ct,
        segment: arguments.segment.as_deref(),
        thickest_mm: volume
            .grid
            .spacing_m()
            .iter()
            .fold(0.0, |most: f64, spacing_m| most.max(spacing_m * 1e3)),
        from_flange_mm: None,
    };
    drop(volume);
    let (text, mut notes, ct) = checked(&mut planned, &absolute(&output), arguments.volume_files)?;
    let prediction = match arguments.no_simulate {
        true => None,
        false => {
            let scene = Scene::parse_with(&text, &absolute(&output), &text_file::read);
            Some(Prediction::of(&scene.map_err(Failure::bad_input)?, ct.map(Arc::new))?)
        }
    };
    notes.extend(prediction.iter().flat_map(|prediction| prediction.lines(&"the scene of this plan")));
    output_file::write(&output, &text)?;
    say(arguments, &planned, &output, &(notes, prediction));
    Ok(())
}

fn options(arguments: &FromMarkupsArguments) -> ReadOptions {
    let label = arguments.segment.as_ref().map(|segment| match segment.parse() {
        Ok(value) => Label::Value(value),
        Err(_) => Label::Name(segment.clone()),
    });
    ReadOptions { data_files: arguments.volume_files.allowed(), label, ..ReadOptions::default() }
}

/// Distances of the tool from the flange to try, mm, if the default one puts the arm into bone.
const FROM_FLANGE_MM: [f64; 4] = [200.0, 300.0, 400.0, 500.0];

/// Checks the scene as `scene check` does, and moves the tool away from the flange if that keeps the arm out
/// of the bone. Returns the scene's text, its warnings and its volume.
fn checked(
    planned: &mut PlannedScene,
    file: &Path,
    volume_files: VolumeFiles,
) -> Result<(String, Vec<String>, Option<Ct>), Failure> {
    let parse = |text: &str| Scene::parse_with(text, file, &text_file::read).map_err(Failure::bad_input);
    let mut text = planned.text();
    let scene = parse(&text)?;
    let loaded = volume_source::load_with_notes(&scene, volume_files)?;
    let volume = loaded.as_ref().map(|loaded| &loaded.ct.volume);
    let found = |text: &str| feasibility::check(&parse(text)?, &"the scene of this plan", volume);
    let arm_is_in_bone =
        |warnings: &[String]| warnings.iter().any(|warning| warning.contains("`arm.tool_position_mm`"));
    let mut warnings = found(&text)?;
    if arm_is_in_bone(&warnings) {
        for distance_mm in FROM_FLANGE_MM {
            planned.from_flange_mm = Some(distance_mm);
            let farther = planned.text();
            if let Ok(of_farther) = found(&farther)
                && !arm_is_in_bone(&of_farther)
            {
                (text, warnings) = (farther, of_farther);
                break;
            }
        }
    }
    let mut notes = loaded.iter().flat_map(|loaded| loaded.notes.clone()).collect::<Vec<_>>();
    notes.extend(warnings);
    let bone_from_hu = scene.volume.as_ref().map_or(i16::MAX, |volume| volume.bone_threshold_hu);
    notes.extend(volume.and_then(|volume| exchanged(&planned.plan, volume, bone_from_hu)));
    Ok((text, notes, loaded.map(|loaded| loaded.ct)))
}

/// How far to look for bone in front of the entry and beyond the target, mm: the length of the tool's
/// flexible part and some of its shaft.
const SEARCH_MM: f64 = 60.0;
/// Distance between samples, mm.
const SAMPLE_MM: f64 = 0.5;

/// Returns a warning if there is bone where the tool comes from, and less of it beyond the target: the two
/// points are probably exchanged.
fn exchanged(plan: &Plan, volume: &Volume, bone_from_hu: i16) -> Option<String> {
    let [entry, target] = [plan.entry_mm(), plan.target_mm()];
    let before = plan.bend_mm().unwrap_or(entry);
    let along = [0, 1, 2].map(|i| target[i] - before[i]);
    let length = along.iter().map(|x| x * x).sum::<f64>().sqrt();
    let bone_mm = |from_mm: [f64; 3], direction: [f64; 3]| {
        let samples = (1..=(SEARCH_MM / SAMPLE_MM) as usize).filter(|sample| {
            let place_mm = [0, 1, 2].map(|i| from_mm[i] + *sample as f64 * SAMPLE_MM * direction[i]);
            let hu = volume.hu_at(place_mm.map(|x| x * 1e-3));
            hu.is_some_and(|hu| hu >= f64::from(bone_from_hu))
        });
        samples.count() as f64 * SAMPLE_MM
    };
    let in_front_mm = bone_mm(entry, plan.direction().map(|x| -x));
    let beyond_mm = bone_mm(target, along.map(|x| x / length));
    (in_front_mm > 1.0 && in_front_mm > 2.0 * beyond_mm).then(|| {
        format!(
            "warning: the tool comes through {in_front_mm:.1} mm of bone in front of the entry, and beyond the \
             target there are {beyond_mm:.1} mm: are entry and target exchanged?"
        )
    })
}

/// Rejects a plan with points outside its volume: it was made on another volume, or its file names the wrong
/// frame.
fn refuse_outside(arguments: &FromMarkupsArguments, plan: &Plan, volume: &Volume) -> Result<(), Failure> {
    let points =
        [("entry", Some(plan.entry_mm())), ("bend", plan.bend_mm()), ("target", Some(plan.target_mm()))];
    for (name, point) in points {
        let Some(point_mm @ [x, y, z]) = point.filter(|point_mm| !volume.holds(point_mm.map(|x| x * 1e-3)))
        else {
            continue;
        };
        let mirrored = volume.holds([-point_mm[0], -point_mm[1], point_mm[2]].map(|x| x * 1e-3));
        let advice = match mirrored {
            true => {
                "; with x and y negated it is inside: is the coordinate system in the plan's file correct?"
            }
            false => "; was it planned on a different CT?",
        };
        return Err(Failure::bad_input(format!(
            "{}: `{name}` is at [{x:.1}, {y:.1}, {z:.1}] (LPS, mm), expected a point within {}{advice}",
            foreign_path(&arguments.plan),
            foreign_path(&arguments.ct),
        )));
    }
    Ok(())
}

fn say(
    arguments: &FromMarkupsArguments,
    planned: &PlannedScene,
    output: &Path,
    (notes, prediction): &(Vec<String>, Option<Prediction>),
) {
    let (plan, arc) = (&planned.plan, planned.arc());
    let place = |[x, y, z]: [f64; 3]| format!("{x:.1}, {y:.1}, {z:.1}");
    let bend = plan.bend_mm().map_or(String::new(), |bend_mm| format!("bend         {}\n", place(bend_mm)));
    arguments.figures.say(
        || {
            format!(
                "{}entry        {} (LPS, mm)\n{bend}target       {}\npath         {:.1} mm, turning {:.1} \
                 deg\n{}written      {}",
                notes.iter().map(|note| format!("{note}\n")).collect::<String>(),
                place(plan.entry_mm()),
                place(plan.target_mm()),
                arc.length_mm,
                arc.turn_deg,
                prediction.as_ref().map_or(String::new(), |prediction| prediction.text() + "\n"),
                output.display()
            )
        },
        || {
            serde_json::json!({
                "output": path_text(output),
                "scene": planned.name,
                "entry_mm": plan.entry_mm(),
                "bend_mm": plan.bend_mm(),
                "target_mm": plan.target_mm(),
                "path_mm": arc.length_mm,
                "turn_deg": arc.turn_deg,
                "notes": notes,
                "findings": findings_json(notes),
                "prediction": prediction.as_ref().map(Prediction::json),
            })
        },
    );
}

/// Derives the scene's name from the plan's file: `hip plan.mrk.json` gives `hip_plan`.
fn name_of(plan: &Path) -> String {
    let file = plan.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let stem = file.split('.').find(|part| !part.is_empty()).unwrap_or("plan");
    let plain = |c: char| if c.is_ascii_alphanumeric() || c == '-' { c } else { '_' };
    stem.chars().take(64).map(plain).collect()
}

fn absolute(path: &Path) -> PathBuf {
    // An empty path is the current folder.
    let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
}

/// Returns a file's path relative to the scene's folder if it is inside, so that the folder can be moved.
fn from(folder: &Path, file: &Path) -> PathBuf {
    let file = absolute(file);
    file.strip_prefix(folder).map(Path::to_owned).unwrap_or(file)
}
