//! Stacks the slices of a series into a volume.

use super::file::DicomFile;
use super::pixels;
use super::slice::Slice;
use crate::error::{Field, VolumeError};
use crate::options::{ReadOptions, SliceHandling};
use crate::rectify::{self, rectify};
use crate::volume::{
    GeometryFields, StatedGeometry, VolumeInfo, cross, dot, norm, placed, placement, voxel_count,
};
use foreign_text::{counted, foreign};
use std::path::Path;
use voxel_grid::Volume;

const POSITION: &str = "(0020,0032) ImagePositionPatient";
const ORIENTATION: &str = "(0020,0037) ImageOrientationPatient";

/// Slice directions that differ by more than this are different orientations; the rounding of DICOM decimals
/// stays below it.
const SAME_DIRECTION: f64 = 1e-3;
/// Largest lateral drift of a straight stack, metres (rounded decimals of the positions).
const STRAIGHT_M: f64 = 5e-5;
/// Largest deviation of a slice distance from the mean, as a fraction of it.
const EVEN: f64 = 0.01;
/// Largest distance of a slice from its place on the even grid, as a fraction of the slice distance: small
/// steps within [`EVEN`] may add up.
const OFF_PLACE: f64 = 0.1;
/// Smaller distances are rounding, as a fraction of the slice distance.
const NOTED_OFF_PLACE: f64 = 0.01;
/// Widest gap that is interpolated, in typical slice distances.
const WIDEST_GAP: f64 = 5.0;
/// Smaller tilts are rounding.
const LEAST_TILT_DEG: f64 = 0.05;

const NAMES: GeometryFields = GeometryFields {
    spacing: "(0028,0030) PixelSpacing, slice distance",
    direction: ORIENTATION,
    origin: POSITION,
};

/// Assembles the volume of at least one slice.
pub(super) fn assemble(
    path: &Path,
    mut slices: Vec<Slice>,
    options: &ReadOptions,
    mut notes: Vec<String>,
) -> Result<(Volume, VolumeInfo), VolumeError> {
    check_same(path, &slices)?;
    let Some(first) = slices.first().cloned() else {
        return Err(VolumeError::not_a_volume(path, "no slices"));
    };
    let (row, column) = directions(path, &first, &mut notes)?;
    let axes = [row, column, cross(row, column)];
    let along_m = |slice: &Slice| dot(slice.position_mm, axes[2]) * 1e-3;
    if slices.iter().any(|s| !s.position_mm.iter().all(|p| p.abs() <= 1e7)) {
        return Err(VolumeError::header(
            path,
            POSITION,
            "an infinite or NaN position, or one beyond 10 km",
            "a position in millimetres",
        ));
    }
    slices.sort_by(|a, b| {
        along_m(a).total_cmp(&along_m(b)).then_with(|| (&a.path, a.frame).cmp(&(&b.path, b.frame)))
    });
    let heights_m: Vec<f64> = slices.iter().map(along_m).collect();
    check_apart(path, &slices, &heights_m)?;
    check_gaps(path, &slices, &heights_m)?;
    let straight = check_straight(path, &slices, axes[2]);
    let distance = slice_distance(path, &slices, &heights_m, &mut notes);
    let askew = straight.is_err() || distance.is_err();
    let dims = [first.columns, first.rows, slices.len()];
    voxel_count(path, "Columns, Rows, number of slices", dims)?;
    if options.slices == SliceHandling::AsTheyLie || slices.len() == 1 {
        straight?;
    } else if askew {
        let read = read_pixels(path, &slices, options, &mut notes)?;
        let volume = rectified(path, &slices, axes, &read, &mut notes)?;
        return Ok(described(volume, &slices, options, notes));
    }
    let step_m = distance?;
    note_tilt(&slices, &mut notes);
    let [row_mm, column_mm] = first.pixel_spacing_mm;
    let spacing_m = [column_mm * 1e-3, row_mm * 1e-3, step_m];
    let origin_m = slices[0].position_mm.map(|p| p * 1e-3);
    let geometry = placement(path, NAMES, StatedGeometry { spacing_m, origin_m, axes }, &mut notes)?;
    let hu = read_pixels(path, &slices, options, &mut notes)?;
    Ok(described(placed(path, dims, geometry, hu)?, &slices, options, notes))
}

/// The pixels of all slices in order. Frames of one file are usually consecutive, so the file is opened only
/// once for them.
fn read_pixels(
    path: &Path,
    slices: &[Slice],
    options: &ReadOptions,
    notes: &mut Vec<String>,
) -> Result<Vec<i16>, VolumeError> {
    let mut sink = options.sink(path)?;
    let mut open: Option<(&Path, DicomFile)> = None;
    for slice in slices {
        let file = match open.take().filter(|(path, _)| *path == slice.path) {
            Some((_, file)) => file,
            None => DicomFile::open(&slice.path)?,
        };
        pixels::append(slice, &file, &mut sink)?;
        open = Some((&slice.path, file));
    }
    Ok(sink.finish(notes))
}

/// Resamples the slices to a rectangular grid.
fn rectified(
    path: &Path,
    slices: &[Slice],
    axes: [[f64; 3]; 3],
    hu: &[i16],
    notes: &mut Vec<String>,
) -> Result<Volume, VolumeError> {
    let first = &slices[0];
    let places_m: Vec<[f64; 3]> =
        slices.iter().map(|slice| axes.map(|axis| dot(slice.position_mm, axis) * 1e-3)).collect();
    let [row_mm, column_mm] = first.pixel_spacing_mm;
    let stack = rectify::Slices {
        columns: first.columns,
        rows: first.rows,
        spacing_m: [column_mm * 1e-3, row_mm * 1e-3],
        places_m: &places_m,
        hu,
    };
    // Refuses invalid spacings before dividing by them.
    let in_plane =
        StatedGeometry { spacing_m: [column_mm * 1e-3, row_mm * 1e-3, 1e-3], origin_m: [0.0; 3], axes };
    placement(path, NAMES, in_plane, &mut Vec::new())?;
    let out = rectify(path, &stack)?;
    let [u, v, w] = out.first_m;
    let origin_m = [0, 1, 2].map(|i| u * axes[0][i] + v * axes[1][i] + w * axes[2][i]);
    let geometry =
        placement(path, NAMES, StatedGeometry { spacing_m: out.spacing_m, origin_m, axes }, notes)?;
    notes.push(out.note);
    placed(path, out.dims, geometry, out.hu)
}

fn described(
    volume: Volume,
    slices: &[Slice],
    options: &ReadOptions,
    mut notes: Vec<String>,
) -> (Volume, VolumeInfo) {
    let first = &slices[0];
    if options.grey.is_some() {
        // The caller states the unit.
    } else if first.modality != "CT" {
        let modality = foreign(&first.modality);
        notes.push(format!("modality is `{modality}`, not CT: the values are not Hounsfield units"));
    } else {
        note_unit(slices, &mut notes);
    }
    let mut files: Vec<&Path> = slices.iter().map(|slice| slice.path.as_path()).collect();
    files.dedup();
    let frames = if first.frames > 1 { format!(", {} frames", slices.len()) } else { String::new() };
    let count = counted(files.len(), "file");
    let format = format!("DICOM series of {count} ({}{frames})", first.transfer.name);
    if slices.iter().any(|slice| !slice.has_own_position) {
        notes.push(
            "only the first frame has a position: the others are stacked along the normal, by \
             SpacingBetweenSlices (0018,0088)"
                .to_owned(),
        );
    }
    let one_scale = slices.iter().all(|slice| slice.scale == first.scale);
    let stored_as = if one_scale {
        format!("slope {}, intercept {}", first.scale.slope, first.scale.intercept)
    } else {
        "slope and intercept of each slice".to_owned()
    };
    let info = VolumeInfo::new(&volume, format, stored_as, "mm".into(), notes);
    (volume, info)
}

/// Adds a note if CT values might not be Hounsfield units. Without RescaleType they are (DICOM PS3.3, table
/// C.8-3).
fn note_unit(slices: &[Slice], notes: &mut Vec<String>) {
    let bare = slices.iter().filter(|slice| !slice.has_intercept).count();
    if bare > 0 {
        let part =
            if bare == slices.len() { String::new() } else { format!(" in {}", counted(bare, "slice")) };
        notes.push(format!(
            "no RescaleIntercept (0028,1052){part}: the stored values are read as Hounsfield units"
        ));
    }
    let other = slices.iter().filter_map(|slice| slice.rescale_type.as_deref()).find(|kind| !is_hu(kind));
    if let Some(kind) = other {
        let kind = foreign(kind);
        notes.push(format!("RescaleType (0028,1054) is `{kind}`: the values are read as Hounsfield units"));
    }
}

/// Hounsfield units, or modified Hounsfield units (DICOM PS3.3, C.11.1.1.2).
fn is_hu(rescale_type: &str) -> bool {
    matches!(rescale_type, "HU" | "HU_MOD")
}

/// Adds a note if the tags state a tilt that the positions do not show: the slices were resampled upright, or
/// their positions ignore the tilt.
fn note_tilt(slices: &[Slice], notes: &mut Vec<String>) {
    let tilt_deg = slices
        .iter()
        .filter_map(|slice| slice.gantry_tilt_deg)
        .fold(0.0, |a: f64, b| if b.abs() > a.abs() { b } else { a });
    if tilt_deg.abs() > LEAST_TILT_DEG && slices.len() > 1 {
        notes.push(format!(
            "GantryDetectorTilt (0018,1120) is {tilt_deg} degrees, but the slices are stacked straight: the \
             positions are trusted; if they ignore the tilt, \
             the volume is sheared"
        ));
    }
}

/// Checks everything that must be constant within a series.
fn check_same(path: &Path, slices: &[Slice]) -> Result<(), VolumeError> {
    let Some(first) = slices.first() else { return Ok(()) };
    let close =
        |a: &[f64], b: &[f64], tolerance: f64| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= tolerance);
    let spacing_tolerance = 1e-4 * first.pixel_spacing_mm[0].abs();
    type Same<'s> = (&'s str, &'s dyn Fn(&Slice) -> bool, &'s dyn Fn(&Slice) -> String);
    let all: [Same; 4] = [
        // Values of other modalities are not Hounsfield units.
        ("(0008,0060) Modality", &|s| s.modality == first.modality, &|s| format!("{:?}", s.modality)),
        (ORIENTATION, &|s| close(&first.orientation, &s.orientation, SAME_DIRECTION), &|s| {
            format!("{:?}", s.orientation)
        }),
        (
            "(0028,0030) PixelSpacing",
            &|s| close(&first.pixel_spacing_mm, &s.pixel_spacing_mm, spacing_tolerance),
            &|s| format!("{:?}", s.pixel_spacing_mm),
        ),
        (
            "(0028,0010) Rows, (0028,0011) Columns",
            &|s| (s.rows, s.columns) == (first.rows, first.columns),
            &|s| format!("{} x {}", s.rows, s.columns),
        ),
    ];
    // The stored values of slices without RescaleIntercept are their own unit.
    if let Some(bare) = slices.iter().find(|slice| !slice.has_intercept)
        && let Some(scaled) = slices.iter().find(|slice| slice.has_intercept && slice.scale != bare.scale)
    {
        let given = format!("no value in {} and {} in {}", name(bare), scaled.scale.intercept, name(scaled));
        return Err(VolumeError::MixedSeries(Field::new(path, "(0028,1052) RescaleIntercept", given)));
    }
    for other in &slices[1..] {
        if let Some((field, _, say)) = all.iter().find(|(_, is_same, _)| !is_same(other)) {
            let given = format!("{} in {} and {} in {}", say(first), name(first), say(other), name(other));
            return Err(VolumeError::MixedSeries(Field::new(path, *field, given)));
        }
    }
    Ok(())
}

/// Unit row and column directions; corrects a right angle that is off only by rounded decimals.
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
        return Err(VolumeError::SingularDirection(Field::new(
            path,
            ORIENTATION,
            format!("{:?}", slice.orientation),
        )));
    }
    let row = row.map(|v| v / row_length);
    let column = column.map(|v| v / column_length);
    let cosine = dot(row, column);
    if cosine.abs() > SAME_DIRECTION {
        return Err(VolumeError::Sheared(
            Field::new(path, ORIENTATION, format!("{:?}", slice.orientation)),
            SAME_DIRECTION,
        ));
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
            return Err(VolumeError::Sheared(
                Field::new(
                    path,
                    POSITION,
                    format!(
                        "{} lies {:.3} mm off the line along the slice normal through {}, over {:.3} \
                         mm{tilt}",
                        name(slice),
                        aside * 1e3,
                        name(&slices[0]),
                        along.abs() * 1e3
                    ),
                ),
                voxel_grid::PERPENDICULAR_TOLERANCE,
            ));
        }
    }
    Ok(())
}

/// Refuses two slices at the same position.
fn check_apart(path: &Path, slices: &[Slice], along_m: &[f64]) -> Result<(), VolumeError> {
    let Some(i) = along_m.windows(2).position(|pair| pair[1] - pair[0] < 1e-6) else { return Ok(()) };
    let both = format!("{} and {}", name(&slices[i]), name(&slices[i + 1]));
    Err(VolumeError::DuplicateSlices(Field::new(
        path,
        POSITION,
        format!("{both} both at {:.3} mm along the normal", along_m[i] * 1e3),
    )))
}

/// The distance between neighbouring slices, metres; `along_m` are their ascending positions along the
/// normal.
fn slice_distance(
    path: &Path,
    slices: &[Slice],
    along_m: &[f64],
    notes: &mut Vec<String>,
) -> Result<f64, VolumeError> {
    let steps: Vec<f64> = along_m.windows(2).map(|w| w[1] - w[0]).collect();
    if steps.is_empty() {
        let thickness = slices[0].slice_thickness_mm.ok_or_else(|| {
            VolumeError::header(
                path,
                "(0018,0050) SliceThickness",
                "no value, for a single slice",
                "a slice thickness, or at least two slices",
            )
        })?;
        notes.push(format!("single slice: its thickness of {thickness} mm is used as the slice distance"));
        return Ok(thickness * 1e-3);
    }
    let smallest = steps.iter().copied().fold(f64::INFINITY, f64::min);
    let even = |step: f64, whole: f64| (step - whole * smallest).abs() <= 2.0 * EVEN * smallest;
    let uneven = steps.iter().position(|step| !even(*step, 1.0));
    let Some(i) = uneven else {
        let mean = (along_m[along_m.len() - 1] - along_m[0]) / steps.len() as f64;
        return off_place(path, slices, along_m, mean, notes).map(|()| mean);
    };
    let given = format!(
        "{:.4} mm between {} and {}, but {:.4} mm elsewhere",
        steps[i] * 1e3,
        name(&slices[i]),
        name(&slices[i + 1]),
        smallest * 1e3
    );
    if steps.iter().all(|step| even(*step, libm::round(step / smallest))) {
        return Err(VolumeError::MissingSlices(Field::new(path, POSITION, given)));
    }
    Err(VolumeError::VariableSpacing(Field::new(path, POSITION, given), 2.0 * EVEN * smallest))
}

/// Refuses slices that lie too far from their places on the even grid of this step; notes smaller distances.
fn off_place(
    path: &Path,
    slices: &[Slice],
    along_m: &[f64],
    step_m: f64,
    notes: &mut Vec<String>,
) -> Result<(), VolumeError> {
    let off = |i: usize| (along_m[i] - along_m[0] - i as f64 * step_m).abs();
    let Some(worst) = (0..along_m.len()).max_by(|a, b| off(*a).total_cmp(&off(*b))) else { return Ok(()) };
    let said = format!(
        "{} {:.3} mm from its place among slices {:.4} mm apart",
        name(&slices[worst]),
        off(worst) * 1e3,
        step_m * 1e3
    );
    if off(worst) > OFF_PLACE * step_m {
        return Err(VolumeError::VariableSpacing(Field::new(path, POSITION, said), OFF_PLACE * step_m));
    }
    if off(worst) > NOTED_OFF_PLACE * step_m {
        notes.push(format!("slices slightly uneven: at worst {said}"));
    }
    Ok(())
}

/// Refuses a gap that is too wide to interpolate, compared with the median slice distance.
fn check_gaps(path: &Path, slices: &[Slice], along_m: &[f64]) -> Result<(), VolumeError> {
    let steps: Vec<f64> = along_m.windows(2).map(|w| w[1] - w[0]).collect();
    let mut sorted = steps.clone();
    sorted.sort_by(f64::total_cmp);
    let Some(typical) = sorted.get(sorted.len() / 2) else { return Ok(()) };
    let Some(i) = steps.iter().position(|step| *step > WIDEST_GAP * typical) else { return Ok(()) };
    let given = format!(
        "{:.4} mm between {} and {}, with a median of {:.4} mm",
        steps[i] * 1e3,
        name(&slices[i]),
        name(&slices[i + 1]),
        typical * 1e3
    );
    Err(VolumeError::Gap(Field::new(path, POSITION, given), WIDEST_GAP))
}

fn name(slice: &Slice) -> String {
    let file = slice.path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    if slice.frames == 1 { file } else { format!("frame {} of {file}", slice.frame + 1) }
}
