//! Synthetic Hounsfield units for a binary bone mask.

use crate::error::VolumeError;
use std::path::Path;
use voxel_grid::Volume;
use voxel_grid::distance::squared_distance_m2;

/// Model that fills a solid 0/1 mask. The result is synthetic: only the outline comes from the patient.
///
/// The defaults are typical of a proximal femur: Hounsfield units of cortex and cancellous bone from rho
/// [kg/m³] = 131 + 1.067 HU (Rho et al. 1995, Med Eng Phys 17:347) for 1.73 and 0.5 to 0.2 g/cm³.
#[derive(Clone, Debug, PartialEq)]
pub struct MaskModel {
    /// Thickness of the cortical shell under the surface, metres.
    pub cortical_thickness_m: f64,
    /// Hounsfield units of the shell.
    pub cortical_hu: i16,
    /// Hounsfield units of cancellous bone directly under the shell.
    pub cancellous_outer_hu: i16,
    /// Hounsfield units of cancellous bone at `marrow_depth_m`; linear with depth in between.
    pub cancellous_inner_hu: i16,
    /// Depth under the surface at which marrow starts, metres.
    pub marrow_depth_m: f64,
    /// Hounsfield units of marrow.
    pub marrow_hu: i16,
    /// Thickness of soft tissue around the bone, metres; beyond it is air.
    pub soft_tissue_m: f64,
    /// Hounsfield units of soft tissue.
    pub soft_tissue_hu: i16,
    /// Hounsfield units of air.
    pub air_hu: i16,
}

impl Default for MaskModel {
    fn default() -> Self {
        Self {
            cortical_thickness_m: 2.0e-3,
            cortical_hu: 1500,
            cancellous_outer_hu: 350,
            cancellous_inner_hu: 65,
            marrow_depth_m: 18.0e-3,
            marrow_hu: -50,
            soft_tissue_m: 20.0e-3,
            soft_tissue_hu: 50,
            air_hu: -1000,
        }
    }
}

/// Replaces a 0/1 mask by synthetic Hounsfield units: cortical shell, cancellous bone graded with depth,
/// marrow core, soft tissue, air.
///
/// Depth is the exact Euclidean distance from the voxel centre to the nearest centre outside, minus half the
/// smallest spacing (the surface lies between the two). If the mask reaches the edge of the volume, the bone
/// counts as cut there: that face gets no shell.
///
/// # Errors
/// [`VolumeError::Argument`] if the volume is not a mask (0 and one other value, both present) or the model
/// has a negative thickness.
pub fn mask_to_hu(volume: &mut Volume, model: &MaskModel) -> Result<(), VolumeError> {
    check_model(model)?;
    let label = mask_label(volume)?;
    let inside: Vec<bool> = volume.hu.iter().map(|value| *value == label).collect();
    let spacing_m = volume.grid.spacing_m();
    let reach_m = model.soft_tissue_m + 2.0 * spacing_m.iter().copied().fold(0.0, f64::max);
    let part = Part::around(volume, &inside, reach_m);
    let bone: Vec<bool> = part.indices().map(|index| inside[index]).collect();
    let outside: Vec<bool> = bone.iter().map(|b| !b).collect();
    // The surface lies half a voxel from the last centre inside.
    let half_m = 0.5 * spacing_m.iter().copied().fold(f64::INFINITY, f64::min);
    let to_outside = squared_distance_m2(part.dims, spacing_m, &outside);
    let to_bone = squared_distance_m2(part.dims, spacing_m, &bone);

    volume.hu.fill(model.air_hu);
    let distances = to_outside.iter().zip(&to_bone);
    for ((index, is_bone), (depth, height)) in part.indices().zip(&bone).zip(distances) {
        volume.hu[index] = if *is_bone {
            model.bone_hu(f64::from(*depth).sqrt() - half_m)
        } else if f64::from(*height).sqrt() - half_m <= model.soft_tissue_m {
            model.soft_tissue_hu
        } else {
            model.air_hu
        };
    }
    Ok(())
}

/// Sets the voxels of one label to 1, all others to 0.
///
/// # Errors
/// [`VolumeError::NoSuchLabel`] if no voxel has the label; [`VolumeError::Argument`] if there are negative
/// values, which are not labels.
pub(crate) fn keep_label(path: &Path, values: &mut [i16], label: i16) -> Result<(), VolumeError> {
    if let Some(negative) = values.iter().find(|value| **value < 0) {
        return Err(VolumeError::argument(
            "label",
            format!("{label} of {}, which holds {negative}", path.display()),
            "a label map with values of 0 and above; these look like Hounsfield units",
        ));
    }
    if !values.contains(&label) {
        let mut there: Vec<i16> = Vec::new();
        for value in values.iter() {
            if !there.contains(value) {
                there.push(*value);
                if there.len() == 20 {
                    break;
                }
            }
        }
        there.sort_unstable();
        return Err(VolumeError::NoSuchLabel {
            path: path.into(),
            given: format!("label {label} not found"),
            there: format!("voxel values {there:?}"),
        });
    }
    for value in values.iter_mut() {
        *value = i16::from(*value == label);
    }
    Ok(())
}

impl MaskModel {
    /// Hounsfield units at a depth under the surface, metres.
    fn bone_hu(&self, depth_m: f64) -> i16 {
        if depth_m <= self.cortical_thickness_m {
            return self.cortical_hu;
        }
        if depth_m >= self.marrow_depth_m {
            return self.marrow_hu;
        }
        let t = (depth_m - self.cortical_thickness_m) / (self.marrow_depth_m - self.cortical_thickness_m);
        let (outer, inner) = (f64::from(self.cancellous_outer_hu), f64::from(self.cancellous_inner_hu));
        libm::round(outer + (inner - outer) * t) as i16
    }
}

fn check_model(model: &MaskModel) -> Result<(), VolumeError> {
    let lengths = [
        ("cortical_thickness_m", model.cortical_thickness_m),
        ("marrow_depth_m", model.marrow_depth_m),
        ("soft_tissue_m", model.soft_tissue_m),
    ];
    for (field, value) in lengths {
        if !(value.is_finite() && value >= 0.0) {
            return Err(VolumeError::argument(field, format!("{value} m"), "a finite thickness, 0 or more"));
        }
    }
    Ok(())
}

/// The mask's only value other than zero.
fn mask_label(volume: &Volume) -> Result<i16, VolumeError> {
    let refuse =
        |given: String| VolumeError::argument("volume", given, "a binary mask, with 0 and one other value");
    let Some(label) = volume.hu.iter().copied().find(|value| *value != 0) else {
        return Err(refuse("a volume of zeros".into()));
    };
    if let Some(other) = volume.hu.iter().find(|value| **value != 0 && **value != label) {
        return Err(refuse(format!("a volume with 0, {label} and {other}")));
    }
    if !volume.hu.contains(&0) {
        return Err(refuse(format!("a volume with only the value {label}")));
    }
    Ok(label)
}

/// A box of voxels within a volume.
struct Part {
    low: [usize; 3],
    dims: [usize; 3],
    whole: [usize; 3],
}

impl Part {
    /// The bounding box of `inside`, grown by `reach_m` within the volume.
    fn around(volume: &Volume, inside: &[bool], reach_m: f64) -> Self {
        let (dims, spacing_m) = (volume.grid.dims(), volume.grid.spacing_m());
        let (mut low, mut high) = (dims, [0; 3]);
        let voxels = inside.iter().enumerate().filter(|(_, is_inside)| **is_inside);
        for voxel in voxels.filter_map(|(index, _)| volume.grid.voxel(index)) {
            for axis in 0..3 {
                low[axis] = low[axis].min(voxel[axis]);
                high[axis] = high[axis].max(voxel[axis]);
            }
        }
        for axis in 0..3 {
            let grow = libm::ceil(reach_m / spacing_m[axis]) as usize;
            low[axis] = low[axis].saturating_sub(grow);
            high[axis] = high[axis].saturating_add(grow).min(dims[axis] - 1);
        }
        Self { low, dims: [0, 1, 2].map(|axis| high[axis] - low[axis] + 1), whole: dims }
    }

    /// Indices into the whole volume, in the order of the part.
    fn indices(&self) -> impl Iterator<Item = usize> + '_ {
        let [ni, nj, _] = self.whole;
        (0..self.dims[2]).flat_map(move |k| {
            (0..self.dims[1]).flat_map(move |j| {
                let start = self.low[0] + ni * (self.low[1] + j + nj * (self.low[2] + k));
                start..start + self.dims[0]
            })
        })
    }
}
