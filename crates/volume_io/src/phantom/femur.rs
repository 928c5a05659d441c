//! The femur phantom: specification, landmarks, and the volume.

use super::anatomy::{Anatomy, HEAD_RADIUS, NECK_LENGTH, Tissue, coverage};
use super::fill::{Field, check_placement, fill, grid_along_axes};
use super::shapes::add_scaled;
use crate::error::VolumeError;
use voxel_grid::Volume;

/// Lower corner of the volume relative to the head centre, mm LPS.
const BOX_LOW_MM: [f64; 3] = [-85.0, -44.0, -125.0];
/// Size of the volume, mm.
const BOX_SIZE_MM: [f64; 3] = [120.0, 100.0, 160.0];

/// Parameters of the femur phantom. The anatomy is the same at every spacing.
#[derive(Clone, Debug, PartialEq)]
pub struct FemurSpec {
    /// Edge of the cubic voxels, metres; 0.25e-3 to 2e-3.
    pub spacing_m: f64,
    /// Centre of the femoral head, world LPS, metres.
    pub head_center_m: [f64; 3],
    /// Angle between the neck axis and the downward shaft axis, radians; 115 to 140 degrees.
    pub neck_shaft_angle_rad: f64,
    /// Angle of the neck in front of the coronal plane, radians; −10 to 35 degrees.
    pub anteversion_rad: f64,
    /// Seed of the trabecular and muscle texture; the shape does not depend on it.
    pub seed: u64,
    /// Threads to use; 0 for as many as the machine offers. The result does not depend on it.
    pub threads: usize,
}

impl Default for FemurSpec {
    /// 240 x 200 x 320 voxels of 0.5 mm; head centre at (−0.09, 0, 0) m; 125 and 15 degrees.
    fn default() -> Self {
        Self {
            spacing_m: 0.5e-3,
            head_center_m: [-0.09, 0.0, 0.0],
            neck_shaft_angle_rad: 125.0_f64.to_radians(),
            anteversion_rad: 15.0_f64.to_radians(),
            seed: 1,
            threads: 0,
        }
    }
}

/// Landmarks of the femur phantom, world LPS, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FemurLandmarks {
    /// Centre of the femoral head.
    pub head_center_m: [f64; 3],
    /// Radius of the femoral head.
    pub head_radius_m: f64,
    /// Unit vector along the neck axis, from the shaft to the head centre. Also the direction to drill from
    /// `entry_point_m`.
    pub neck_axis: [f64; 3],
    /// Crossing of the neck axis and the shaft axis.
    pub neck_shaft_crossing_m: [f64; 3],
    /// Unit vector along the shaft axis, upward.
    pub shaft_axis: [f64; 3],
    /// Outer surface of the lateral cortex on the line through the neck axis.
    pub entry_point_m: [f64; 3],
    /// Distance from `entry_point_m` to `head_center_m`.
    pub entry_to_head_center_m: f64,
    /// Point inside the tip of the greater trochanter.
    pub greater_trochanter_m: [f64; 3],
    /// Point inside the end of the lesser trochanter.
    pub lesser_trochanter_m: [f64; 3],
}

/// Builds the femur phantom: a synthetic right proximal femur in a slim thigh, surrounded by air; no pelvis.
///
/// A voxel is the field at its centre. Surfaces are blended over one voxel (at least 0.5 mm), like a CT's
/// partial-volume effect, so that the half-way surface is the same at every spacing. Hounsfield units lie
/// within −1000..=1700.
///
/// # Errors
/// [`VolumeError::Argument`] for a value outside the ranges of [`FemurSpec`].
pub fn femur(spec: &FemurSpec) -> Result<Volume, VolumeError> {
    check(spec)?;
    let spacing_mm = spec.spacing_m * 1e3;
    let dims = BOX_SIZE_MM.map(|size| libm::round(size / spacing_mm) as usize);
    let origin_m =
        [0, 1, 2].map(|axis| spec.head_center_m[axis] + (BOX_LOW_MM[axis] + 0.5 * spacing_mm) * 1e-3);
    let grid = grid_along_axes("femur phantom", dims, [spec.spacing_m; 3], origin_m)?;
    let field =
        FemurField { anatomy: anatomy(spec), head_center_m: spec.head_center_m, blur: spacing_mm.max(0.5) };
    Ok(fill(grid, &field, spec.threads))
}

/// The landmarks of the femur that [`femur`] builds from the same specification.
///
/// # Errors
/// [`VolumeError::Argument`] for a value outside the ranges of [`FemurSpec`].
pub fn femur_landmarks(spec: &FemurSpec) -> Result<FemurLandmarks, VolumeError> {
    check(spec)?;
    let anatomy = anatomy(spec);
    let entry_mm = lateral_cortex_mm(&anatomy);
    let world = |p: [f64; 3]| add_scaled(spec.head_center_m, 1e-3, p);
    Ok(FemurLandmarks {
        head_center_m: spec.head_center_m,
        head_radius_m: HEAD_RADIUS * 1e-3,
        neck_axis: anatomy.neck,
        neck_shaft_crossing_m: world(anatomy.crossing),
        shaft_axis: [0.0, 0.0, 1.0],
        entry_point_m: world(anatomy.neck.map(|c| -entry_mm * c)),
        entry_to_head_center_m: entry_mm * 1e-3,
        greater_trochanter_m: world(anatomy.greater_trochanter()),
        lesser_trochanter_m: world(anatomy.lesser_trochanter()),
    })
}

fn anatomy(spec: &FemurSpec) -> Anatomy {
    Anatomy::new(spec.neck_shaft_angle_rad, spec.anteversion_rad, spec.seed)
}

/// Distance from the head centre along the neck axis, laterally, to the outer surface, mm.
fn lateral_cortex_mm(anatomy: &Anatomy) -> f64 {
    let distance = |s: f64| anatomy.bone_distance(anatomy.neck.map(|c| -s * c));
    // The crossing with the shaft axis is inside; 60 mm further is outside for every accepted angle.
    let mut inside = NECK_LENGTH;
    let mut outside = NECK_LENGTH;
    while distance(outside) < 0.0 && outside < NECK_LENGTH + 60.0 {
        inside = outside;
        outside += 0.5;
    }
    for _ in 0..50 {
        let middle = 0.5 * (inside + outside);
        if distance(middle) < 0.0 {
            inside = middle;
        } else {
            outside = middle;
        }
    }
    0.5 * (inside + outside)
}

fn check(spec: &FemurSpec) -> Result<(), VolumeError> {
    let refuse = |field: &'static str, given: String, expected: &str| {
        Err(VolumeError::argument(field, given, expected))
    };
    check_placement(spec.spacing_m, "head_center_m", spec.head_center_m)?;
    let angle_deg = spec.neck_shaft_angle_rad.to_degrees();
    if !(115.0..=140.0).contains(&angle_deg) {
        return refuse("neck_shaft_angle_rad", format!("{angle_deg} degrees"), "115 to 140 degrees");
    }
    let anteversion_deg = spec.anteversion_rad.to_degrees();
    if !(-10.0..=35.0).contains(&anteversion_deg) {
        return refuse("anteversion_rad", format!("{anteversion_deg} degrees"), "-10 to 35 degrees");
    }
    Ok(())
}

struct FemurField {
    anatomy: Anatomy,
    head_center_m: [f64; 3],
    /// Width over which surfaces are blended, mm.
    blur: f64,
}

impl FemurField {
    fn local_mm(&self, p: [f64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|axis| (p[axis] - self.head_center_m[axis]) * 1e3)
    }
}

impl Field for FemurField {
    type Region = Tissue;

    fn region(&self, center_m: [f64; 3], radius_m: f64) -> Tissue {
        let p = self.local_mm(center_m);
        // Factor 2: the first-order distance of a stretched ellipsoid may overestimate by its axis ratio,
        // here at most 1.6.
        let reach = 2.0 * radius_m * 1e3 + self.blur;
        if self.anatomy.skin_distance(p) > reach {
            Tissue::Air
        } else if self.anatomy.bone_distance(p) > reach {
            Tissue::SoftOrAir
        } else {
            Tissue::Any
        }
    }

    fn hu(&self, region: Tissue, point_m: [f64; 3]) -> f64 {
        let p = self.local_mm(point_m);
        let soft = || self.anatomy.soft_tissue_hu(p, self.anatomy.skin_distance(p), self.blur);
        match region {
            Tissue::Air => super::anatomy::AIR_HU,
            Tissue::SoftOrAir => soft(),
            Tissue::Any => {
                let distance = self.anatomy.bone_distance(p);
                let bone = coverage(-distance / self.blur);
                let mut hu = 0.0;
                if bone > 0.0 {
                    hu += bone * self.anatomy.bone_hu(p, distance, self.blur);
                }
                if bone < 1.0 {
                    hu += (1.0 - bone) * soft();
                }
                hu
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::fill::assert_filled_by;
    use super::*;

    /// Skipping blocks must not change any voxel: compares the volume with the field evaluated without
    /// skipping.
    #[test]
    fn skipping_changes_nothing() {
        for spacing_m in [1.0e-3, 2.0e-3] {
            let spec = FemurSpec { spacing_m, ..FemurSpec::default() };
            let volume = femur(&spec).unwrap();
            let field = FemurField {
                anatomy: anatomy(&spec),
                head_center_m: spec.head_center_m,
                blur: spacing_m * 1e3,
            };
            assert_filled_by(&volume, &field, Tissue::Any, 7);
        }
    }
}
