//! `trabecula log export --geometry`: exports tunnel, tool and paths for other programs.

use std::path::Path;

use clap::ValueEnum;
use ipc_types::messages::{State, Tick};
use ipc_types::scene::{Scene, planned_path_in_bone_mm};
use markups::{curve_json, points_fcsv};
use recorder_proc::log_file::{LogFile, log_path};
use run_log::columns::{Column, Rows};
use run_log::fields::Scalar;
use run_log::{LogError, LogReader, Verdict};
use serde_json::{Value, json};

use super::export::{ExportArguments, write_table};
use super::judged;
use crate::failure::Failure;
use crate::geometry::path::{Deviation, PathPoint, PathRecorder, deviations};
use crate::geometry::{Mesh, mesh_files, tool, tunnel};
use crate::output::refuse_existing;
use crate::replay::{OpenedLog, Overrides, RemovedBone};

/// Distance between points of a curve, mm: a twentieth of the burr, and few enough points for 3D Slicer.
const CURVE_STEP_MM: f64 = 0.25;
/// Distance between rows of the table of deviations, mm.
const TABLE_STEP_MM: f64 = 0.1;

/// Geometry of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Geometry {
    /// Closed surface of all removed voxels, including pilot holes (.stl, .obj, .vtp).
    Tunnel,
    /// Surface of the tool (.stl, .obj, .vtp).
    Tool,
    /// Path of the burr's centre (.mrk.json, .fcsv, .vtp).
    BurrPath,
    /// Path planned by the scene for the burr's centre (.mrk.json, .fcsv, .vtp).
    PlannedPath,
    /// Deviation of the burr's centre from the planned path during insertion (.csv, .parquet, .vtp).
    Deviation,
}

impl Geometry {
    fn endings(self) -> &'static [&'static str] {
        match self {
            Geometry::Tunnel | Geometry::Tool => &["stl", "obj", "vtp"],
            Geometry::BurrPath | Geometry::PlannedPath => &["mrk.json", "fcsv", "vtp"],
            Geometry::Deviation => &["csv", "parquet", "vtp"],
        }
    }

    /// Returns the file extension, which selects the format.
    fn format(self, output: &Path) -> Result<&'static str, Failure> {
        let name = output.file_name().map(|name| name.to_string_lossy().to_lowercase()).unwrap_or_default();
        let endings = self.endings();
        let found = endings.iter().find(|ending| name.ends_with(&format!(".{ending}")));
        found.copied().ok_or_else(|| {
            let expected: Vec<String> = endings.iter().map(|ending| format!(".{ending}")).collect();
            Failure::bad_input(format!(
                "--output is {}, expected a file ending in {}",
                output.display(),
                expected.join(" or ")
            ))
        })
    }
}

/// Exports the geometry.
///
/// # Errors
/// Not a log, an unknown file extension, an output that exists, nothing to export (2); a log that cannot be
/// read to its end, a full disk (1); a log that is truncated or was not ended (3).
pub fn export(what: Geometry, arguments: &ExportArguments) -> Result<(), Failure> {
    let format = what.format(&arguments.output)?;
    refuse_existing(&[&arguments.output])?;
    let (said, figures, verdict) = match what {
        Geometry::Tunnel => of_tunnel(format, arguments)?,
        Geometry::Tool => of_tool(format, arguments)?,
        Geometry::BurrPath => {
            let seen = StateHistory::of(arguments, CURVE_STEP_MM)?;
            let places: Vec<_> = seen.places.iter().map(|place| place.burr_mm).collect();
            let (said, figures) = curve("burr", format, arguments, &places)?;
            (said, figures, seen.verdict)
        }
        Geometry::PlannedPath => {
            let log = log_path(arguments.log());
            let reader = LogReader::open(&LogFile::at(&log))?;
            let path_mm = planned(&log, &scene_of(&reader, &log)?)?;
            let (said, figures) = curve("plan", format, arguments, &path_mm)?;
            (said, figures, Verdict::default())
        }
        Geometry::Deviation => of_deviation(format, arguments)?,
    };
    arguments.say(&said, figures, &verdict);
    judged(&log_path(arguments.log()), &verdict)
}

/// Result as text and as JSON, and the log's verdict.
type ExportResult = (String, Value, Verdict);

fn of_tunnel(format: &str, arguments: &ExportArguments) -> Result<ExportResult, Failure> {
    let overrides = Overrides {
        volume: arguments.volume.clone(),
        volume_files: arguments.volume_files,
        ..Overrides::default()
    };
    let log = OpenedLog::open(arguments.log(), &overrides)?;
    let gone = RemovedBone::of(&log, arguments.ticks().last.map(|tick| tick.0))?;
    let Some(ct) = &log.ct else {
        return Err(Failure::bad_input(format!("{}: this run has no volume", log.path.display())));
    };
    let grid = &ct.volume.grid;
    let mesh = tunnel::surface(grid, &gone.voxels);
    if mesh.triangles.is_empty() {
        return Err(Failure::bad_input(format!(
            "{}: no voxels removed by tick {}, so there is no tunnel",
            log.path.display(),
            gone.tick
        )));
    }
    write_mesh(format, &arguments.output, &mesh)?;
    let voxel_mm3: f64 = grid.spacing_m().iter().map(|spacing_m| 1e3 * spacing_m).product();
    let (count, voxels_mm3, surface_mm3) =
        (gone.voxels.len(), gone.voxels.len() as f64 * voxel_mm3, mesh.volume_mm3());
    let said = format!(
        "tunnel after tick {}: {} triangles enclosing {surface_mm3:.1} mm3; {} ({voxels_mm3:.1} mm3) \
         removed",
        gone.tick,
        mesh.triangles.len(),
        foreign_text::counted(count, "voxel")
    );
    let figures = json!({"tick": gone.tick, "triangles": mesh.triangles.len(), "surface_volume_mm3": surface_mm3,
        "removed_voxels": count, "removed_volume_mm3": voxels_mm3});
    Ok((said, figures, gone.verdict))
}

fn of_tool(format: &str, arguments: &ExportArguments) -> Result<ExportResult, Failure> {
    let seen = StateHistory::of(arguments, f64::INFINITY)?;
    let mesh = tool::surface(&seen.last, &seen.scene.manipulator.radii());
    write_mesh(format, &arguments.output, &mesh)?;
    let (tick, count) = (seen.last.tick, mesh.triangles.len());
    let said = format!("tool after tick {tick}: {count} triangles");
    Ok((said, json!({"tick": tick, "triangles": count}), seen.verdict))
}

fn of_deviation(format: &str, arguments: &ExportArguments) -> Result<ExportResult, Failure> {
    let log = log_path(arguments.log());
    let seen = StateHistory::of(arguments, TABLE_STEP_MM)?;
    let found = deviations(&planned(&log, &seen.scene)?, &seen.places);
    let at = |of: fn(&Deviation) -> f64| found.iter().map(of).collect::<Vec<f64>>();
    let deviation_mm = at(|one| one.deviation_mm);
    match format {
        "vtp" => {
            let points: Vec<[f64; 3]> = found.iter().map(|one| one.place.burr_mm).collect();
            let values = [
                ("deviation_mm", deviation_mm.clone()),
                ("along_mm", at(|one| one.along_mm)),
                ("sim_time_s", at(|one| one.place.time_s)),
            ];
            output_file::write(&arguments.output, mesh_files::curve_vtp(&points, &values))?;
        }
        _ => {
            let columns = COLUMNS.map(Column::computed);
            write_table(&arguments.output, &columns, |table| fill(table, &found))?;
        }
    }
    let most_mm = deviation_mm.iter().fold(0.0, |most: f64, one| most.max(*one));
    let mean = deviation_mm.iter().map(|one| one * one).sum::<f64>() / deviation_mm.len().max(1) as f64;
    let (rms_mm, last_mm) = (mean.sqrt(), deviation_mm.last().copied().unwrap_or(0.0));
    let said = format!(
        "{} burr positions, deviation {most_mm:.2} mm maximum, {rms_mm:.2} mm RMS, {last_mm:.2} mm at the \
         end",
        found.len()
    );
    let figures =
        json!({"rows": found.len(), "most_mm": most_mm, "rms_mm": rms_mm, "at_the_end_mm": last_mm});
    Ok((said, figures, seen.verdict))
}

/// The states of a log up to the requested tick: its scene, the burr's path, the last state, and the log's
/// verdict if no tick was requested.
struct StateHistory {
    scene: Scene,
    places: Vec<PathPoint>,
    last: State,
    verdict: Verdict,
}

impl StateHistory {
    fn of(arguments: &ExportArguments, step_mm: f64) -> Result<StateHistory, Failure> {
        let log = log_path(arguments.log());
        let mut reader = LogReader::open(&LogFile::at(&log))?;
        let scene = scene_of(&reader, &log)?;
        let range = arguments.ticks();
        let (mut path, mut last) = (PathRecorder::new(step_mm), *reader.initial());
        path.see(&last);
        for record in reader.by_ref() {
            let record = record.map_err(Failure::failed)?;
            if !range.contains(Tick(record.state.tick)) {
                break;
            }
            path.see(&record.state);
            last = record.state;
        }
        if let Some(wanted) = range.last.filter(|wanted| wanted.0 > last.tick) {
            return Err(Failure::bad_input(format!(
                "--to is {wanted}, but the log ends at tick {}",
                last.tick
            )));
        }
        let verdict = if range.last.is_none() { reader.stream().verdict() } else { Verdict::default() };
        Ok(StateHistory { scene, places: path.places(), last, verdict })
    }
}

fn scene_of(reader: &LogReader, log: &Path) -> Result<Scene, Failure> {
    Scene::parse(&reader.header().scene_toml, log).map_err(Failure::bad_input)
}

fn planned(log: &Path, scene: &Scene) -> Result<Vec<[f64; 3]>, Failure> {
    planned_path_in_bone_mm(scene).ok_or_else(|| {
        Failure::bad_input(format!(
            "{}: the scene of this run has no planned path; expected a controller `curved_drilling`, \
             `skiving` or `tube_deployment`",
            log.display()
        ))
    })
}

fn write_mesh(format: &str, output: &Path, mesh: &Mesh) -> Result<(), Failure> {
    match format {
        "stl" => output_file::write(output, mesh_files::stl(mesh))?,
        "obj" => output_file::write(output, mesh_files::obj(mesh))?,
        _ => output_file::write(output, mesh_files::vtp(mesh))?,
    }
    Ok(())
}

fn curve(
    name: &str,
    format: &str,
    arguments: &ExportArguments,
    points_mm: &[[f64; 3]],
) -> Result<(String, Value), Failure> {
    let text = match format {
        "mrk.json" => curve_json(name, points_mm),
        "fcsv" => points_fcsv(name, points_mm),
        _ => mesh_files::curve_vtp(points_mm, &[]),
    };
    output_file::write(&arguments.output, text)?;
    Ok((format!("curve of {} points", points_mm.len()), json!({"points": points_mm.len()})))
}

/// Columns of the table of deviations.
const COLUMNS: [&str; 6] = ["sim_time_s", "burr_x_mm", "burr_y_mm", "burr_z_mm", "along_mm", "deviation_mm"];

fn fill(table: &mut dyn Rows, found: &[Deviation]) -> Result<(), LogError> {
    for Deviation { place, along_mm, deviation_mm } in found {
        let [x, y, z] = place.burr_mm;
        let values = [place.time_s, x, y, z, *along_mm, *deviation_mm].map(Scalar::Float64);
        let time_ns = (place.time_s * 1e9 + 0.5) as u64;
        table.row(Tick(place.tick), time_ns, &values)?;
    }
    Ok(())
}
