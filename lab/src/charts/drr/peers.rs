//! Other projectors on the same volume and poses.
//!
//! Each `NAME.py` of the peers' folder, with its pinned packages in `NAME.txt`, is run in its own virtual
//! environment with its input folder: `mu.raw` (float32 attenuation per millimetre, x
//! fastest) and `poses.json` (grid and poses, millimetres). It writes, for each pose and number of threads,
//! `NAME_POSE_T.raw` (float32 line integrals, row by row), and prints `POSE THREADS MS` for every timed
//! frame.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::json;
use xray::Material;

use super::{Candidate, Errors, Plan, Point, PosedReference, STANDARD, Sample};
use crate::charts::peers::{new_input, run, scripts};
use trabecula::failure::Failure;

/// Runs every script, and after each the default projector again, so that both see the same machine state. A
/// script that cannot be installed or run gives a note, not a failure. Returns the notes.
pub fn measure(
    folder: &Path,
    plan: &Plan,
    sample: &Sample,
    poses: &[PosedReference],
    points: &mut Vec<Point>,
) -> Result<Vec<String>, Failure> {
    let io = |path: &Path| {
        let path = path.to_owned();
        move |cause: std::io::Error| Failure::failed(format!("{}: {cause}", path.display()))
    };
    let work = std::path::absolute(plan.out.join("peers")).map_err(io(&plan.out))?;
    let input = new_input(&work)?;
    write_input(input.path(), sample, poses, plan.rounds)?;
    let mut notes = Vec::new();
    for (name, script) in scripts(folder)? {
        match run(&script, &name, &work, input.path()) {
            Err(reason) => notes.push(format!("peer {name}: not measured ({reason})")),
            Ok(printed) => collect(&name, &printed, input.path(), sample, poses, points, &mut notes),
        }
        let candidate = Candidate { name: STANDARD.0, projector: STANDARD.1, threads: 2 };
        super::measure(sample, poses, &candidate, plan.rounds, points).map_err(super::failed)?;
    }
    Ok(notes)
}

fn write_input(work: &Path, sample: &Sample, poses: &[PosedReference], rounds: usize) -> Result<(), Failure> {
    let mu_water = Material::Water.mu_per_m(60.0).map_err(|cause| Failure::failed(cause.to_string()))?;
    let mu = |hu: i16| (mu_water * 1e-3 * (1.0 + f64::from(hu) / 1000.0)).max(0.0) as f32;
    let bytes: Vec<u8> = sample.hu.iter().flat_map(|&hu| mu(hu).to_le_bytes()).collect();
    output_file::write(&work.join("mu.raw"), bytes)?;
    let mm = |v: [f64; 3]| v.map(|x| x * 1e3);
    let list: Vec<serde_json::Value> = poses
        .iter()
        .map(|pose| {
            let c = &pose.c_arm;
            json!({
                "name": pose.name,
                "source_mm": mm(c.source_m),
                "detector_centre_mm": mm(c.detector_centre_m),
                "row_axis": c.row_axis,
                "column_axis": c.column_axis,
                "pixel_pitch_mm": c.pixel_pitch_m.map(|p| p * 1e3),
                "columns": c.columns,
                "rows": c.rows,
            })
        })
        .collect();
    let text = json!({
        "dims": sample.grid.dims(),
        "spacing_mm": mm(sample.grid.spacing_m()),
        "origin_mm": mm(sample.grid.origin_m()),
        "rounds": rounds,
        "poses": list,
    });
    Ok(output_file::write(&work.join("poses.json"), text.to_string())?)
}

fn collect(
    name: &str,
    printed: &str,
    work: &Path,
    sample: &Sample,
    poses: &[PosedReference],
    points: &mut Vec<Point>,
    notes: &mut Vec<String>,
) {
    let mut times: BTreeMap<(String, usize), Vec<f64>> = BTreeMap::new();
    for line in printed.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        if let [pose, threads, ms] = words.as_slice()
            && let (Ok(threads), Ok(ms)) = (threads.parse(), ms.parse())
        {
            times.entry(((*pose).to_owned(), threads)).or_default().push(ms);
        }
    }
    for ((pose_name, threads), times_ms) in times {
        let Some(pose) = poses.iter().find(|pose| pose.name == pose_name) else { continue };
        let path = work.join(format!("{name}_{pose_name}_{threads}.raw"));
        let bytes = std::fs::read(&path).unwrap_or_default();
        let image: Vec<f64> =
            bytes.chunks_exact(4).map(|b| f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]]))).collect();
        if image.len() != pose.c_arm.pixels() {
            notes.push(format!("peer {name}: {} is not an image of the pose", path.display()));
            continue;
        }
        points.push(Point {
            method: format!("peer:{name}"),
            coarseness: sample.coarseness,
            pose: pose.name,
            threads,
            times_ms,
            exact: Errors::of(&image, &pose.exact),
            siddon: Errors::of(&image, &pose.siddon),
        });
    }
}
