//! Measures the memory of each process with a large volume, to show that there is one CT in shared memory
//! rather than one per process.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use ipc_types::process::EndRequest;
use ipc_types::scene::Volume as SceneVolume;
use ipc_types::session::SessionId;
use serde_json::json;
use voxel_grid::Volume;
use zerocopy::IntoBytes;

use super::{complete_run, cut, failed};
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::launcher::part::Memory;
use trabecula::launcher::run::RunPlan;
use trabecula::launcher::volume_source;
use trabecula::launcher::volume_source::VolumeFiles;
use trabecula::machine::Machine;
use trabecula::scenes::SceneSource;

/// Bytes of a mebibyte.
const MEBIBYTE: f64 = 1_048_576.0;

/// Parses three sizes separated by `x`.
///
/// # Errors
/// An error text for the user.
pub fn parse_dimensions(text: &str) -> Result<[usize; 3], String> {
    let sizes: Vec<usize> = text.split('x').map_while(|size| size.parse().ok()).collect();
    match sizes[..] {
        [i, j, k] if sizes.iter().all(|size| (8..=2048).contains(size)) => Ok([i, j, k]),
        _ => Err("expected three sizes of 8 to 2048, such as 512x512x400".to_owned()),
    }
}

/// Runs the scene for `ticks` with its volume resampled to `dimensions`, and prints the memory of each
/// process.
///
/// # Errors
/// An invalid scene, or one without a volume (2); a run that fails.
pub fn run(
    scene: &SceneSource,
    dimensions: [usize; 3],
    ticks: u64,
    sheet: &mut Sheet,
) -> Result<(), Failure> {
    let mut scene = scene.load()?;
    cut(&mut scene, Some(ticks));
    let folder = tempfile::tempdir().map_err(failed)?;
    let file = folder.path().join("large.nrrd");
    let ct = volume_source::load(&scene, VolumeFiles::default()).map_err(Failure::bad_input)?;
    let ct = ct.ok_or_else(|| Failure::bad_input("the scene has no `[volume]`"))?;
    write_resampled(&ct.volume, dimensions, &file).map_err(failed)?;
    drop(ct);
    if let Some(source) = &mut scene.volume {
        *source = SceneVolume { phantom: None, path: Some(file), mask: false, ..source.clone() };
    }
    let end = EndRequest::install().map_err(failed)?;
    let ct_bytes = dimensions.iter().product::<usize>() as u64 * 2;
    let (mut segments, mut running) = (Vec::new(), Memory::default());
    let machine = Machine::watch();
    let plan = RunPlan {
        scene,
        output: Some(folder.path().to_owned()),
        view: None,
        volume_files: VolumeFiles::default(),
    };
    let result = complete_run(&plan, &end, |glance| {
        running.measure("self");
        if segments.is_empty() {
            segments = shared_segments(glance.session, ct_bytes);
        }
    })?;
    let [i, j, k] = dimensions;
    let name = &plan.scene.name;
    sheet.line(&format!(
        "scene {name}, {ticks} ticks, CT of {i} x {j} x {k} voxels: {}\n",
        mebibytes(ct_bytes)
    ));
    sheet.set("ct_bytes", json!(ct_bytes));
    let columns = |name: &str, resident: &str, own: &str| format!("{name:<46} {resident:>14} {own:>14}");
    sheet.line(&columns("process", "peak resident", "private"));
    for (name, memory) in &result.memory {
        let (resident_bytes, own_bytes) = (memory.peak_resident, memory.peak_private);
        sheet.line(&columns(name, &mebibytes(resident_bytes), &mebibytes(own_bytes)));
        sheet.push(
            "processes",
            json!({"name": name, "peak_resident_bytes": resident_bytes, "peak_own_bytes": own_bytes}),
        );
    }
    // At its peak the launcher holds both the volume it read and the shared one.
    sheet.line(&columns("launcher, while the parts run", "", &mebibytes(running.peak_private)));
    sheet.set("launcher_running_own_bytes", json!(running.peak_private));
    let sizes: Vec<String> = segments.iter().map(|bytes| mebibytes(*bytes)).collect();
    let text = format!("{} ({})", segments.len(), sizes.join(", "));
    sheet.row("shared segments as large as the CT", &text, "shared_segment_bytes", json!(segments));
    sheet.machine(&machine);
    Ok(())
}

fn mebibytes(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / MEBIBYTE)
}

/// Sizes of a session's shared-memory segments that are large enough for a whole CT.
fn shared_segments(session: &Path, ct_bytes: u64) -> Vec<u64> {
    let Some(prefix) = SessionId::of(session).map(|id| id.shared_memory_prefix()) else { return Vec::new() };
    let entries = std::fs::read_dir("/dev/shm").into_iter().flatten().flatten();
    let ours = entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix));
    ours.filter_map(|entry| entry.metadata().ok())
        .map(|meta| meta.len())
        .filter(|bytes| *bytes >= ct_bytes)
        .collect()
}

/// Writes the volume as an uncompressed NRRD file, resampled to other dimensions over the same space with the
/// nearest voxel.
fn write_resampled(volume: &Volume, dims: [usize; 3], path: &Path) -> std::io::Result<()> {
    let (grid, had) = (&volume.grid, volume.grid.dims());
    let ratio = [0, 1, 2].map(|axis| had[axis] as f64 / dims[axis] as f64);
    // The first voxel's centre is half a new voxel inside the corner, not half an old one.
    let origin_mm = grid.world_m(ratio.map(|ratio| 0.5 * ratio - 0.5)).map(|metres| metres * 1e3);
    let vector = |v: [f64; 3]| format!("({:?},{:?},{:?})", v[0], v[1], v[2]);
    let axes = [0, 1, 2].map(|axis| {
        let length_mm = grid.spacing_m()[axis] * ratio[axis] * 1e3;
        vector(grid.axes()[axis].map(|x| x * length_mm))
    });
    let mut file = BufWriter::new(File::create(path)?);
    write!(
        file,
        "NRRD0005\ntype: int16\ndimension: 3\nspace: left-posterior-superior\nsizes: {} {} {}\n\
         space directions: {} {} {}\nendian: little\nencoding: raw\nspace units: \"mm\" \"mm\" \
         \"mm\"\nspace origin: {}\n\n",
        dims[0],
        dims[1],
        dims[2],
        axes[0],
        axes[1],
        axes[2],
        vector(origin_mm)
    )?;
    let nearest = |axis: usize| (0..dims[axis]).map(move |at| at * had[axis] / dims[axis]);
    let mut line = Vec::with_capacity(dims[0]);
    for k in nearest(2) {
        for j in nearest(1) {
            let start = (k * had[1] + j) * had[0];
            line.clear();
            line.extend(nearest(0).map(|i| volume.hu[start + i]));
            file.write_all(line.as_bytes())?;
        }
    }
    file.flush()
}

#[cfg(test)]
mod tests {
    use voxel_grid::VoxelGrid;

    use super::*;

    #[test]
    fn dimensions_are_three_sizes_in_range() {
        assert_eq!(parse_dimensions("512x512x400"), Ok([512, 512, 400]));
        for bad in ["512x512", "512x512x400x2", "4x512x512", "512x512x4000", "axbxc", ""] {
            assert!(parse_dimensions(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn a_resampled_file_covers_the_same_space_with_the_same_values() {
        let hu = (0..24).collect();
        let grid = VoxelGrid::axis_aligned([4, 3, 2], [1e-3, 2e-3, 3e-3], [0.01, 0.02, 0.03]).unwrap();
        let volume = Volume { grid, hu };
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("finer.nrrd");
        write_resampled(&volume, [8, 9, 2], &file).unwrap();
        let finer = volume_io::read(&file).unwrap();
        assert_eq!(finer.grid.dims(), [8, 9, 2]);
        for (i, j, k) in [(0, 0, 0), (7, 8, 1), (3, 4, 0)] {
            assert_eq!(finer.at([i, j, k]), volume.at([i / 2, j / 3, k]));
        }
        // The outer corner of the first voxel is unchanged; printing millimetres as text rounds at 1e-16
        // relative.
        let corner = |volume: &Volume| volume.grid.world_m([-0.5; 3]);
        for (a, b) in corner(&volume).iter().zip(corner(&finer)) {
            assert!((a - b).abs() < 1e-12, "{a} {b}");
        }
    }
}
