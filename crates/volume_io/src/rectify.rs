//! Resamples slices that are not on a rectangular grid (unevenly spaced, or sheared by a tilted gantry).

use crate::error::{Field, VolumeError};
use crate::volume::{GeometryFields, StatedGeometry, cross, dot, norm, placed, placement, voxel_count};
use std::path::Path;
use voxel_grid::Volume;

/// Value of voxels outside the slices: air.
const AIR_HU: i16 = -1000;
/// Smallest cosine between the normal and the line through the slices: a tilt of 60 degrees.
const LEAST_NORMAL_PART: f64 = 0.5;
/// How a note on resampled slices begins.
pub(crate) const NOTE: &str = "resampled linearly to a rectangular grid";
/// Positions closer than this fraction of a voxel count as equal.
const SAME_PLACE: f64 = 1e-6;

/// Parallel slices of equal size, sorted by height.
pub(crate) struct Slices<'a> {
    pub columns: usize,
    pub rows: usize,
    /// Distance between columns, then between rows.
    pub spacing_m: [f64; 2],
    /// Position of each slice's first voxel: along the row direction, the column direction and the normal.
    pub places_m: &'a [[f64; 3]],
    pub hu: &'a [i16],
}

/// A rectangular grid over the slices, with the same three directions.
pub(crate) struct RectifiedVolume {
    pub dims: [usize; 3],
    pub spacing_m: [f64; 3],
    /// Position of the first voxel, in the coordinates of [`Slices::places_m`].
    pub first_m: [f64; 3],
    pub hu: Vec<i16>,
    /// Describes the resampling and its error.
    pub note: String,
}

/// Resamples by linear interpolation within and between slices. The slice distance is the smallest one found,
/// or slightly less so that the first and the last slice lie on the grid.
///
/// The note states an error estimate and the widest distance that was bridged: each inner slice is predicted
/// from its two neighbours in the same way, and the root mean square of the differences is taken, of all
/// slices and of the worst. Those neighbours are twice as far apart as for any
/// voxel of the result, whose error is smaller where the tissue is smooth.
///
/// # Errors
/// [`VolumeError::TooLarge`].
pub(crate) fn rectify(path: &Path, slices: &Slices<'_>) -> Result<RectifiedVolume, VolumeError> {
    let places = slices.places_m;
    let extreme =
        |axis: usize, pick: fn(f64, f64) -> f64| places.iter().map(|p| p[axis]).reduce(pick).unwrap_or(0.0);
    let low = [0, 1, 2].map(|axis| extreme(axis, f64::min));
    let high = [0, 1, 2].map(|axis| extreme(axis, f64::max));
    let steps: Vec<f64> = places.windows(2).map(|pair| pair[1][2] - pair[0][2]).collect();
    let smallest = steps.iter().copied().fold(f64::INFINITY, f64::min);
    let largest = steps.iter().copied().fold(0.0, f64::max);
    let [across, down] = slices.spacing_m;
    let whole =
        |length: f64, spacing: f64| libm::ceil(length / spacing - SAME_PLACE).clamp(0.0, 1e9) as usize;
    let height = high[2] - low[2];
    let layers = whole(height, smallest).max(1);
    let step = height / layers as f64;
    let spacing_m = [across, down, step];
    let dims = [
        slices.columns + whole(high[0] - low[0], across),
        slices.rows + whole(high[1] - low[1], down),
        layers + 1,
    ];
    voxel_count(path, "Columns, Rows, slices of the rectangular grid", dims)?;
    let mut hu = Vec::with_capacity(dims.iter().product());
    let mut outside = 0_u64;
    for k in 0..dims[2] {
        let height_m = (low[2] + k as f64 * step).min(high[2]);
        let above = places.partition_point(|place| place[2] <= height_m).clamp(1, places.len() - 1);
        let pair = Between::new(slices, above - 1, above, height_m);
        for j in 0..dims[1] {
            for i in 0..dims[0] {
                let at_m = [low[0] + i as f64 * across, low[1] + j as f64 * down];
                let value = pair.value(at_m);
                outside += u64::from(value.is_none());
                hu.push(value.map_or(AIR_HU, |value| libm::round(value) as i16));
            }
        }
    }
    let count = hu.len();
    let error = match predicted_error_hu(slices) {
        Some(PredictedError { all_hu, worst_hu, worst_slice }) => format!(
            "predicting each slice from its two neighbours in the same way gives an error of {all_hu:.1} HU \
             (root mean square, at twice the distance), {worst_hu:.1} HU in the worst slice, at {:.3} mm",
            (places[worst_slice][2] - low[2]) * 1e3
        ),
        None => "with fewer than three slices the error cannot be measured".to_owned(),
    };
    let tilt_deg = tilt_deg(places);
    let note = format!(
        "{NOTE}: slices {:.3} to {:.3} mm apart, stack tilted by \
         {tilt_deg:.2} degrees; {error}; {outside} of {count} voxels are outside the slices and set to \
         {AIR_HU} HU",
        smallest * 1e3,
        largest * 1e3,
    );
    Ok(RectifiedVolume { dims, spacing_m, first_m: low, hu, note })
}

/// Unit directions of a grid whose slices, perpendicular in themselves, are stacked at an angle: of the rows,
/// the columns, and the normal on the side of the next slice. `None` if the slices are sheared, too.
fn stack_axes(stated: &StatedGeometry) -> Option<[[f64; 3]; 3]> {
    let unit = |axis: [f64; 3]| axis.map(|x| x / norm(axis));
    let [u, v] = [unit(stated.axes[0]), unit(stated.axes[1])];
    let cosine = dot(u, v);
    let v = unit([0, 1, 2].map(|i| v[i] - cosine * u[i]));
    let normal = unit(cross(u, v));
    let side = dot(normal, unit(stated.axes[2]));
    let is_stack = cosine.abs() <= voxel_grid::PERPENDICULAR_TOLERANCE && side.abs() > LEAST_NORMAL_PART;
    is_stack.then_some([u, v, normal.map(|x| x * side.signum())])
}

/// Whether a sheared grid is a stack of rectangular slices at an angle, as of a tilted gantry.
pub(crate) fn is_askew_stack(stated: &StatedGeometry, dims: [usize; 3]) -> bool {
    dims[2] > 1 && stack_axes(stated).is_some()
}

/// Resamples a stack of slices at an angle to a rectangular grid; see [`is_askew_stack`].
///
/// # Errors
/// As [`rectify`] and [`placement`].
pub(crate) fn askew_stack(
    path: &Path,
    names: GeometryFields,
    stated: &StatedGeometry,
    dims: [usize; 3],
    hu: &[i16],
    notes: &mut Vec<String>,
) -> Result<Volume, VolumeError> {
    let StatedGeometry { spacing_m: [across, down, along], origin_m, axes: [.., k] } = *stated;
    let axes = stack_axes(stated)
        .ok_or_else(|| VolumeError::SingularDirection(Field::new(path, names.direction, format!("{k:?}"))))?;
    // Refuses invalid spacings before dividing by them.
    placement(path, names, StatedGeometry { axes, ..*stated }, &mut Vec::new())?;
    let step = k.map(|x| x / norm(k) * along);
    let place = |n: usize| {
        let corner = [0, 1, 2].map(|i| origin_m[i] + n as f64 * step[i]);
        axes.map(|axis| dot(axis, corner))
    };
    let places_m: Vec<[f64; 3]> = (0..dims[2]).map(place).collect();
    let slices =
        Slices { columns: dims[0], rows: dims[1], spacing_m: [across, down], places_m: &places_m, hu };
    let out = rectify(path, &slices)?;
    let [u, v, w] = out.first_m;
    let origin_m = [0, 1, 2].map(|i| u * axes[0][i] + v * axes[1][i] + w * axes[2][i]);
    let geometry =
        placement(path, names, StatedGeometry { spacing_m: out.spacing_m, origin_m, axes }, notes)?;
    notes.push(out.note);
    placed(path, out.dims, geometry, out.hu)
}

/// Angle between the line through the first and last slice's corners and the normal.
fn tilt_deg(places: &[[f64; 3]]) -> f64 {
    let (Some(first), Some(last)) = (places.first(), places.last()) else { return 0.0 };
    let [u, v, w] = [0, 1, 2].map(|axis| last[axis] - first[axis]);
    libm::atan2(libm::hypot(u, v), w).to_degrees()
}

/// Two slices, and a height between them.
struct Between<'a> {
    slices: &'a Slices<'a>,
    low: usize,
    high: usize,
    /// Weight of the upper one.
    weight: f64,
}

impl<'a> Between<'a> {
    fn new(slices: &'a Slices<'a>, low: usize, high: usize, height_m: f64) -> Self {
        let (from, to) = (slices.places_m[low][2], slices.places_m[high][2]);
        Self { slices, low, high, weight: ((height_m - from) / (to - from)).clamp(0.0, 1.0) }
    }

    /// The value at a position in the plane; `None` outside a slice that has a weight.
    fn value(&self, at_m: [f64; 2]) -> Option<f64> {
        let lower = if self.weight < 1.0 { self.slices.within(self.low, at_m)? } else { 0.0 };
        let upper = if self.weight > 0.0 { self.slices.within(self.high, at_m)? } else { 0.0 };
        Some(lower + (upper - lower) * self.weight)
    }
}

impl Slices<'_> {
    /// The value within a slice, bilinear between voxel centres.
    fn within(&self, slice: usize, at_m: [f64; 2]) -> Option<f64> {
        let place = self.places_m[slice];
        let (i, across) = cell((at_m[0] - place[0]) / self.spacing_m[0], self.columns)?;
        let (j, down) = cell((at_m[1] - place[1]) / self.spacing_m[1], self.rows)?;
        let start = self.columns * self.rows * slice;
        let (i1, j1) = ((i + 1).min(self.columns - 1), (j + 1).min(self.rows - 1));
        let at = |i: usize, j: usize| f64::from(self.hu[start + i + self.columns * j]);
        let row = |j: usize| at(i, j) + (at(i1, j) - at(i, j)) * across;
        Some(row(j) + (row(j1) - row(j)) * down)
    }
}

/// The voxel below a position along an axis, and the fraction to the next one; `None` outside the outermost
/// centres.
fn cell(place: f64, voxels: usize) -> Option<(usize, f64)> {
    let last = (voxels - 1) as f64;
    if !(-SAME_PLACE..=last + SAME_PLACE).contains(&place) {
        return None;
    }
    let place = place.clamp(0.0, last);
    let low = libm::floor(place);
    Some((low as usize, place - low))
}

/// Root mean square differences of inner slices from the interpolation of their neighbours.
struct PredictedError {
    all_hu: f64,
    /// The largest of a single slice, and its index.
    worst_hu: f64,
    worst_slice: usize,
}

/// The error that [`rectify`] states; `None` without inner slices.
fn predicted_error_hu(slices: &Slices<'_>) -> Option<PredictedError> {
    let (mut sum, mut count) = (0.0, 0_u64);
    let (mut worst, mut worst_slice) = (0.0, 0);
    for slice in 1..slices.places_m.len().saturating_sub(1) {
        let place = slices.places_m[slice];
        let pair = Between::new(slices, slice - 1, slice + 1, place[2]);
        let (sum_before, count_before) = (sum, count);
        for j in 0..slices.rows {
            for i in 0..slices.columns {
                let at_m =
                    [place[0] + i as f64 * slices.spacing_m[0], place[1] + j as f64 * slices.spacing_m[1]];
                let Some(predicted) = pair.value(at_m) else { continue };
                let there = f64::from(slices.hu[i + slices.columns * (j + slices.rows * slice)]);
                sum += (predicted - there) * (predicted - there);
                count += 1;
            }
        }
        if count > count_before {
            let own = (sum - sum_before) / (count - count_before) as f64;
            if own >= worst {
                (worst, worst_slice) = (own, slice);
            }
        }
    }
    let root = |square: f64| square.max(0.0).sqrt();
    (count > 0).then(|| PredictedError {
        all_hu: root(sum / count as f64),
        worst_hu: root(worst),
        worst_slice,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(p: [f64; 3]) -> f64 {
        2e4 * p[0] - 3e4 * p[1] + 5e4 * p[2]
    }

    /// Slices of a field that is linear in space.
    fn linear(places_m: &[[f64; 3]], tilt: bool) -> RectifiedVolume {
        let (columns, rows, spacing_m) = (9, 7, [1e-3, 2e-3]);
        let mut hu = Vec::new();
        for place in places_m {
            for j in 0..rows {
                for i in 0..columns {
                    let p = [place[0] + i as f64 * 1e-3, place[1] + j as f64 * 2e-3, place[2]];
                    hu.push(value(p) as i16);
                }
            }
        }
        let slices = Slices { columns, rows, spacing_m, places_m, hu: &hu };
        let out = rectify(Path::new("s"), &slices).unwrap();
        assert_eq!(tilt, !out.note.contains("tilted by 0.00 degrees"), "{}", out.note);
        out
    }

    fn compare(out: &RectifiedVolume) -> usize {
        let mut compared = 0;
        for (index, hu) in out.hu.iter().enumerate().filter(|(_, hu)| **hu != AIR_HU) {
            let [nx, ny, _] = out.dims;
            let voxel = [index % nx, index / nx % ny, index / (nx * ny)];
            let p = [0, 1, 2].map(|axis| out.first_m[axis] + voxel[axis] as f64 * out.spacing_m[axis]);
            assert!((f64::from(*hu) - value(p)).abs() <= 2.0, "{voxel:?}: {hu} against {}", value(p));
            compared += 1;
        }
        compared
    }

    #[test]
    fn uneven_slices_of_a_linear_field_become_the_same_field() {
        let heights = [0.0, 1e-3, 2.5e-3, 3.5e-3, 6e-3];
        let out = linear(&heights.map(|w| [0.01, -0.02, w]), false);
        assert_eq!((out.dims, out.spacing_m), ([9, 7, 7], [1e-3, 2e-3, 1e-3]));
        assert_eq!(compare(&out), 9 * 7 * 7);
    }

    #[test]
    fn a_tilted_stack_of_a_linear_field_becomes_the_same_field() {
        let places: Vec<[f64; 3]> = (0..6).map(|k| [0.0, 5e-4 * f64::from(k), 2e-3 * f64::from(k)]).collect();
        let out = linear(&places, true);
        assert_eq!(out.dims, [9, 9, 6]);
        assert!(compare(&out) > 9 * 5 * 6);
        assert!(out.note.contains("tilted by 14.04 degrees"), "{}", out.note);
    }
}
