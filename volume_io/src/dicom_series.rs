//! A DICOM CT series: which files belong to it, how they stack, and the volume.

use crate::dicom_scan::is_part10;
use crate::dicom_slice::{Slice, read_header, read_pixels, series_of};
use crate::error::VolumeError;
use crate::input::{self, Codec, DataFiles, folder_of};
use crate::scalar::HuSink;
use crate::volume::{GeometryFields, Volume, VolumeInfo, cross, dot, norm, placement, voxel_count};
use foreign_text::foreign;
use std::path::{Path, PathBuf};

const POSITION: &str = "(0020,0032) ImagePositionPatient";
const ORIENTATION: &str = "(0020,0037) ImageOrientationPatient";

/// Slice directions that differ by more than this count as different orientations; the rounding of DICOM decimals stays below it.
const SAME_DIRECTION: f64 = 1e-3;
/// Largest sideways drift of the stack that counts as straight, metres (rounded decimals of the positions).
const STRAIGHT_M: f64 = 5e-5;
/// Largest deviation of a slice distance from the mean, as a fraction of it.
const EVEN: f64 = 0.01;

/// Reads the series in a folder; every image in it must belong to the one series.
pub(crate) fn read_folder(folder: &Path, files: DataFiles) -> Result<(Volume, VolumeInfo), VolumeError> {
    let mut slices = Vec::new();
    let mut skipped = 0;
    for file in dicom_files(folder, files, &mut skipped)? {
        match read_header(&file)? {
            Some(slice) => slices.push(slice),
            None => skipped += 1,
        }
    }
    if slices.is_empty() {
        return Err(VolumeError::NotAVolume {
            path: folder.into(),
            given: format!("a folder without DICOM images ({skipped} other files)"),
        });
    }
    let notes = if skipped > 0 {
        vec![format!("{skipped} files that are not DICOM images were left out")]
    } else {
        vec![]
    };
    assemble(folder, slices, notes)
}

/// Reads the series that a DICOM file belongs to: every file beside it with the same SeriesInstanceUID.
pub(crate) fn read_file(path: &Path, files: DataFiles) -> Result<(Volume, VolumeInfo), VolumeError> {
    let Some(first) = read_header(path)? else {
        return Err(VolumeError::NotAVolume {
            path: path.into(),
            given: "a DICOM file without an image".into(),
        });
    };
    let folder = folder_of(path);
    let own_name = path.file_name();
    let mut slices = vec![first];
    if !slices[0].series_uid.is_empty() {
        for file in dicom_files(folder, files, &mut 0)? {
            if file.file_name() != own_name
                && series_of(&file).as_deref() == Some(slices[0].series_uid.as_str())
            {
                slices.extend(read_header(&file)?);
            }
        }
    }
    assemble(path, slices, Vec::new())
}

/// The DICOM Part 10 files of a folder, by name, without its subfolders and index; counts the others. Refuses a link to such a file
/// elsewhere unless `where_to` allows it: an untrusted folder may hold links to the user's own images.
fn dicom_files(folder: &Path, where_to: DataFiles, others: &mut usize) -> Result<Vec<PathBuf>, VolumeError> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(input::io_error(folder, "list"))? {
        let path = entry.map_err(input::io_error(folder, "list"))?.path();
        let is_index = path.file_name().is_some_and(|name| name == "DICOMDIR");
        if path.is_file() && !is_index && is_part10(&input::head(&path, 0, Codec::Raw, 132)?) {
            if input::inside(folder, &path, where_to)?.is_none() {
                return Err(VolumeError::Elsewhere {
                    path: folder.into(),
                    field: "link".into(),
                    given: format!("`{}`", path.file_name().unwrap_or_default().to_string_lossy()),
                });
            }
            files.push(path);
        } else {
            *others += 1;
        }
    }
    files.sort();
    Ok(files)
}

fn assemble(
    path: &Path,
    mut slices: Vec<Slice>,
    mut notes: Vec<String>,
) -> Result<(Volume, VolumeInfo), VolumeError> {
    check_same(path, &slices)?;
    let first = slices[0].clone();
    let (row, column) = directions(path, &first, &mut notes)?;
    let normal = cross(row, column);
    let along_m = |slice: &Slice| dot(slice.position_mm, normal) * 1e-3;
    if slices.iter().any(|s| !s.position_mm.iter().all(|p| p.abs() <= 1e7)) {
        return Err(VolumeError::Header {
            path: path.into(),
            field: POSITION.into(),
            given: "a position that is not finite or beyond 10 km".into(),
            expected: "a position in millimetres".into(),
        });
    }
    slices.sort_by(|a, b| along_m(a).total_cmp(&along_m(b)).then_with(|| a.path.cmp(&b.path)));
    check_straight(path, &slices, normal)?;
    let step_m = slice_distance(path, &slices, &slices.iter().map(along_m).collect::<Vec<_>>(), &mut notes)?;

    let [row_mm, column_mm] = first.pixel_spacing_mm;
    let names = GeometryFields {
        spacing: "(0028,0030) PixelSpacing, slice distance",
        direction: ORIENTATION,
        origin: POSITION,
    };
    let spacing_m = [column_mm * 1e-3, row_mm * 1e-3, step_m];
    let origin_m = slices[0].position_mm.map(|p| p * 1e-3);
    let geometry = placement(path, names, spacing_m, origin_m, [row, column, normal])?;
    let dims = [first.columns, first.rows, slices.len()];
    voxel_count(path, "Columns, Rows, number of slices", dims)?;

    let mut sink = HuSink::default();
    for slice in &slices {
        read_pixels(slice, &mut sink)?;
    }
    if first.modality != "CT" {
        let modality = foreign(&first.modality);
        notes.push(format!("modality is `{modality}`, not CT: the values are not Hounsfield units"));
    }
    let hu = sink.finish(&mut notes);
    let volume = Volume::placed(dims, &geometry, hu);
    let format = format!("DICOM series of {} files ({})", slices.len(), first.transfer.name);
    let stored_as = format!("slope {}, intercept {}", first.scale.slope, first.scale.intercept);
    let info = VolumeInfo::new(&volume, format, stored_as, "mm".into(), notes);
    Ok((volume, info))
}

/// Checks everything that must not change within a series.
fn check_same(path: &Path, slices: &[Slice]) -> Result<(), VolumeError> {
    let first = &slices[0];
    let mixed = |field: &str, other: &Slice, a: String, b: String| {
        Err(VolumeError::MixedSeries {
            path: path.into(),
            field: field.into(),
            given: format!("{a} in {} and {b} in {}", name(first), name(other)),
        })
    };
    let close =
        |a: &[f64], b: &[f64], tolerance: f64| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= tolerance);
    for other in &slices[1..] {
        if other.series_uid != first.series_uid {
            let (a, b) = (first.series_uid.clone(), other.series_uid.clone());
            return mixed("(0020,000e) SeriesInstanceUID", other, a, b);
        }
        if !close(&first.orientation, &other.orientation, SAME_DIRECTION) {
            return mixed(
                ORIENTATION,
                other,
                format!("{:?}", first.orientation),
                format!("{:?}", other.orientation),
            );
        }
        let spacing = first.pixel_spacing_mm;
        if !close(&spacing, &other.pixel_spacing_mm, 1e-4 * spacing[0].abs()) {
            return mixed(
                "(0028,0030) PixelSpacing",
                other,
                format!("{spacing:?}"),
                format!("{:?}", other.pixel_spacing_mm),
            );
        }
        if (other.rows, other.columns) != (first.rows, first.columns) {
            let size = |s: &Slice| format!("{} x {}", s.rows, s.columns);
            return mixed("(0028,0010) Rows, (0028,0011) Columns", other, size(first), size(other));
        }
    }
    Ok(())
}

/// Unit row and column directions; restores a right angle that is off only by rounded decimals.
fn directions(
    path: &Path,
    slice: &Slice,
    notes: &mut Vec<String>,
) -> Result<([f64; 3], [f64; 3]), VolumeError> {
    let [a, b, c, d, e, f] = slice.orientation;
    let (row, column) = ([a, b, c], [d, e, f]);
    let (row_length, column_length) = (norm(row), norm(column));
    let unit_length = |length: f64| (0.9..=1.1).contains(&length);
    if !(unit_length(row_length) && unit_length(column_length)) {
        return Err(VolumeError::SingularDirection {
            path: path.into(),
            field: ORIENTATION.into(),
            given: format!("{:?}", slice.orientation),
        });
    }
    let row = row.map(|v| v / row_length);
    let column = column.map(|v| v / column_length);
    let cosine = dot(row, column);
    if cosine.abs() > SAME_DIRECTION {
        return Err(VolumeError::Sheared {
            path: path.into(),
            field: ORIENTATION.into(),
            given: format!("{:?}", slice.orientation),
            tolerance: SAME_DIRECTION,
        });
    }
    if cosine.abs() > 1e-6 {
        notes.push(format!(
            "row and column directions were made perpendicular (cosine {cosine:.1e}: rounded decimals)"
        ));
    }
    let straightened = [0, 1, 2].map(|i| column[i] - cosine * row[i]);
    let length = norm(straightened);
    Ok((row, straightened.map(|v| v / length)))
}

/// Refuses a stack whose slices drift sideways: a tilted gantry.
fn check_straight(path: &Path, slices: &[Slice], normal: [f64; 3]) -> Result<(), VolumeError> {
    let start = slices[0].position_mm;
    for slice in &slices[1..] {
        let offset = [0, 1, 2].map(|i| (slice.position_mm[i] - start[i]) * 1e-3);
        let along = dot(offset, normal);
        let aside = norm([0, 1, 2].map(|i| offset[i] - along * normal[i]));
        if aside > STRAIGHT_M.max(voxel_grid::PERPENDICULAR_TOLERANCE * along.abs()) {
            let tilt =
                slice.gantry_tilt_deg.map_or(String::new(), |t| format!("; GantryDetectorTilt {t} degrees"));
            return Err(VolumeError::Sheared {
                path: path.into(),
                field: POSITION.into(),
                given: format!(
                    "{} lies {:.3} mm beside the line along the slice normal through {}, over {:.3} mm{tilt}",
                    name(slice),
                    aside * 1e3,
                    name(&slices[0]),
                    along.abs() * 1e3
                ),
                tolerance: voxel_grid::PERPENDICULAR_TOLERANCE,
            });
        }
    }
    Ok(())
}

/// The distance between neighbouring slices, metres; `along_m` are their ascending positions along the normal.
fn slice_distance(
    path: &Path,
    slices: &[Slice],
    along_m: &[f64],
    notes: &mut Vec<String>,
) -> Result<f64, VolumeError> {
    let steps: Vec<f64> = along_m.windows(2).map(|w| w[1] - w[0]).collect();
    if steps.is_empty() {
        let thickness = slices[0].slice_thickness_mm.ok_or_else(|| VolumeError::Header {
            path: path.into(),
            field: "(0018,0050) SliceThickness".into(),
            given: "nothing, and a single slice".into(),
            expected: "a slice thickness, or at least two slices".into(),
        })?;
        notes.push(format!("a single slice: its thickness of {thickness} mm is taken as the slice distance"));
        return Ok(thickness * 1e-3);
    }
    if let Some(i) = steps.iter().position(|step| *step < 1e-6) {
        return Err(VolumeError::DuplicateSlices {
            path: path.into(),
            field: POSITION.into(),
            given: format!(
                "{} and {} both at {:.3} mm along the normal",
                name(&slices[i]),
                name(&slices[i + 1]),
                along_m[i] * 1e3
            ),
        });
    }
    let smallest = steps.iter().copied().fold(f64::INFINITY, f64::min);
    let even = |step: f64, whole: f64| (step - whole * smallest).abs() <= 2.0 * EVEN * smallest;
    let uneven = steps.iter().position(|step| !even(*step, 1.0));
    let Some(i) = uneven else {
        let total: f64 = along_m[along_m.len() - 1] - along_m[0];
        return Ok(total / steps.len() as f64);
    };
    let given = format!(
        "{:.4} mm between {} and {}, but {:.4} mm elsewhere",
        steps[i] * 1e3,
        name(&slices[i]),
        name(&slices[i + 1]),
        smallest * 1e3
    );
    if steps.iter().all(|step| even(*step, libm::round(step / smallest))) {
        return Err(VolumeError::MissingSlices { path: path.into(), field: POSITION.into(), given });
    }
    Err(VolumeError::VariableSpacing {
        path: path.into(),
        field: POSITION.into(),
        given,
        tolerance_m: 2.0 * EVEN * smallest,
    })
}

fn name(slice: &Slice) -> String {
    slice.path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}
