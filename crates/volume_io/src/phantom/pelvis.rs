//! The pelvis phantom: two hip bones, a sacrum and two proximal femurs in a trunk of soft tissue, the size of
//! a CT of an adult.
//!
//! A substitute where no patient CT is available: it has joints, thin plates and a second side, which the
//! femur phantom lacks. Frame of the shape: millimetres, origin midway between the femoral heads, axes LPS.
//! The left side mirrors the right one.

use super::anatomy::{AIR_HU, Anatomy, HEAD_RADIUS, Tissue, coverage};
use super::fill::{Field, check_placement, fill, grid_along_axes};
use super::noise::value_noise;
use super::shapes::{add_scaled, ellipsoid, smooth_union, sphere, sub, tapered_capsule, triangle};
use crate::error::VolumeError;
use crate::volume::dot;
use voxel_grid::Volume;

/// Lower corner of the volume relative to the midpoint between the heads, mm LPS.
const BOX_LOW_MM: [f64; 3] = [-185.0, -115.0, -100.0];
/// Size of the volume, mm.
const BOX_SIZE_MM: [f64; 3] = [370.0, 235.0, 240.0];
/// Centre of the right femoral head, mm.
const HEAD_MM: [f64; 3] = [-90.0, 0.0, 0.0];
/// Inner and outer radius of the socket: a joint space of 2.5 mm, a wall of 7.5 mm.
const SOCKET_MM: [f64; 2] = [HEAD_RADIUS + 2.5, HEAD_RADIUS + 10.0];
/// Where the right socket opens: lateral, anterior, inferior (inclination about 40 degrees, anteversion about
/// 15).
const OPENING: [f64; 3] = [-0.743, -0.254, -0.619];
/// Half the thickness of the iliac wing and of the sacrum's wings.
const PLATE_MM: f64 = 4.5;
/// Thickness of the cortical shell of hip bones and sacrum (about 1.5 mm: Anderson et al. 2005, J Biomech Eng
/// 127:364, rounded).
const CORTEX_MM: f64 = 1.5;
const CORTEX_HU: f64 = 900.0;
const CANCELLOUS_HU: f64 = 220.0;

/// Parameters of the pelvis phantom. The anatomy is the same at every spacing.
#[derive(Clone, Debug, PartialEq)]
pub struct PelvisSpec {
    /// Edge of the cubic voxels, metres; 0.34e-3 (finer ones would exceed the voxel limit) to 2e-3.
    pub spacing_m: f64,
    /// Midpoint between the femoral heads, world LPS, metres.
    pub center_m: [f64; 3],
    /// Threads to use; 0 for as many as the machine offers. The result does not depend on it.
    pub threads: usize,
}

impl Default for PelvisSpec {
    /// 370 x 235 x 240 voxels of 1 mm; the right hip where `configs/pelvis_ct.toml` drills: head centre at
    /// (−0.085, −0.146, 0.121) m.
    fn default() -> Self {
        Self { spacing_m: 1e-3, center_m: [0.005, -0.146, 0.121], threads: 0 }
    }
}

/// Builds the pelvis phantom.
///
/// A voxel is the field at its centre; surfaces are blended over one voxel, as in the femur phantom, whose
/// proximal femur it contains twice.
///
/// # Errors
/// [`VolumeError::Argument`] for a value outside the ranges of [`PelvisSpec`].
pub fn pelvis(spec: &PelvisSpec) -> Result<Volume, VolumeError> {
    check_placement(spec.spacing_m, "center_m", spec.center_m)?;
    let spacing_mm = spec.spacing_m * 1e3;
    let dims = BOX_SIZE_MM.map(|size| libm::round(size / spacing_mm) as usize);
    let origin_m = [0, 1, 2].map(|axis| spec.center_m[axis] + (BOX_LOW_MM[axis] + 0.5 * spacing_mm) * 1e-3);
    let grid = grid_along_axes("pelvis phantom", dims, [spec.spacing_m; 3], origin_m)?;
    let femur = Anatomy::new(125.0_f64.to_radians(), 15.0_f64.to_radians(), 1);
    let field = PelvisField { femur, center_m: spec.center_m, blur: spacing_mm.max(0.5) };
    Ok(fill(grid, &field, spec.threads))
}

/// Distance to the hip bones and the sacrum, mm, for a point of the right side.
fn hip_distance(p: [f64; 3]) -> f64 {
    let local = sub(p, HEAD_MM);
    let [inner, outer] = SOCKET_MM;
    let ball = sphere(local, [0.0; 3], outer);
    // The iliac wing: two plates from the roof of the socket to the crest.
    let (roof, front) = ([-84.0, 6.0, 28.0], [-122.0, -46.0, 92.0]);
    let (crest, back, joint) = ([-128.0, 8.0, 122.0], [-46.0, 76.0, 104.0], [-52.0, 62.0, 52.0]);
    let wing = triangle(p, roof, front, crest)
        .min(triangle(p, roof, crest, back))
        .min(triangle(p, roof, back, joint))
        - PLATE_MM;
    let root = tapered_capsule(p, [-88.0, 3.0, 22.0], [-86.0, 8.0, 48.0], 19.0, 8.0);
    let ischium = tapered_capsule(p, [-84.0, 18.0, -18.0], [-66.0, 34.0, -66.0], 15.0, 15.0);
    let upper_ramus = tapered_capsule(p, [-78.0, -22.0, -6.0], [-12.0, -48.0, -24.0], 10.0, 9.0);
    let lower_ramus = tapered_capsule(p, [-14.0, -44.0, -40.0], [-58.0, 28.0, -70.0], 7.0, 8.0);
    let pubis = tapered_capsule(p, [-12.0, -47.0, -24.0], [-12.0, -44.0, -40.0], 9.5, 8.0);
    let solids = [root, ischium, upper_ramus, lower_ramus, pubis, ball];
    let hip = solids.into_iter().fold(wing, |all, one| smooth_union(all, one, 6.0));
    // The joint space, and the opening through which the head goes in.
    let space = sphere(local, [0.0; 3], inner);
    let opening = 8.0 - dot(local, OPENING);
    let hip = hip.max(-space).max(-opening.max(ball));
    let body = tapered_capsule(p, [0.0, 66.0, 82.0], [0.0, 88.0, -22.0], 26.0, 8.0);
    let ala = triangle(p, [0.0, 60.0, 96.0], [-42.0, 64.0, 84.0], [0.0, 82.0, 30.0]) - 2.0 * PLATE_MM;
    hip.min(smooth_union(body, ala, 8.0))
}

struct PelvisField {
    femur: Anatomy,
    center_m: [f64; 3],
    /// Width over which surfaces are blended, mm.
    blur: f64,
}

impl PelvisField {
    /// The point in the frame of the shape, on its right side.
    fn right_mm(&self, point_m: [f64; 3]) -> [f64; 3] {
        let [x, y, z] = [0, 1, 2].map(|axis| (point_m[axis] - self.center_m[axis]) * 1e3);
        [-x.abs(), y, z]
    }

    fn skin_distance(p: [f64; 3]) -> f64 {
        ellipsoid([p[0], p[1] - 8.0, 0.0], [172.0, 108.0, 1.0])
    }
}

impl Field for PelvisField {
    type Region = Tissue;

    fn region(&self, center_m: [f64; 3], radius_m: f64) -> Tissue {
        let p = self.right_mm(center_m);
        // Factor 2: the first-order distance of a stretched ellipsoid may overestimate by its axis ratio,
        // here at most 1.6.
        let reach = 2.0 * radius_m * 1e3 + self.blur;
        let bone = hip_distance(p).min(self.femur.bone_distance(sub(p, HEAD_MM)));
        if Self::skin_distance(p) > reach {
            Tissue::Air
        } else if bone > reach {
            Tissue::SoftOrAir
        } else {
            Tissue::Any
        }
    }

    fn hu(&self, region: Tissue, point_m: [f64; 3]) -> f64 {
        if region == Tissue::Air {
            return AIR_HU;
        }
        let p = self.right_mm(point_m);
        let soft = self.femur.soft_tissue_hu(p, Self::skin_distance(p), self.blur);
        if region == Tissue::SoftOrAir {
            return soft;
        }
        let local = sub(p, HEAD_MM);
        let (hip, femur) = (hip_distance(p), self.femur.bone_distance(local));
        let bone = coverage(-hip.min(femur) / self.blur);
        if bone == 0.0 {
            return soft;
        }
        let hu = if femur <= hip {
            self.femur.bone_hu(local, femur, self.blur)
        } else {
            let shell = coverage((CORTEX_MM + hip) / self.blur.max(1.0));
            let grain = value_noise(5, add_scaled([0.0; 3], 1.0 / 1.4, p));
            shell * CORTEX_HU + (1.0 - shell) * (CANCELLOUS_HU + 80.0 * grain)
        };
        soft + bone * (hu - soft)
    }
}

#[cfg(test)]
mod tests {
    use super::super::fill::assert_filled_by;
    use super::*;

    /// Skipping blocks must not change any voxel.
    #[test]
    fn skipping_changes_nothing_in_the_pelvis() {
        let spec = PelvisSpec { spacing_m: 2.0e-3, ..PelvisSpec::default() };
        let volume = pelvis(&spec).unwrap();
        let femur = Anatomy::new(125.0_f64.to_radians(), 15.0_f64.to_radians(), 1);
        let field = PelvisField { femur, center_m: spec.center_m, blur: 2.0 };
        assert_filled_by(&volume, &field, Tissue::Any, 11);
    }

    /// Along the line that `configs/pelvis_ct.toml` drills: soft tissue, the femur's lateral cortex,
    /// cancellous bone in the head, the joint space, and the socket behind it.
    #[test]
    fn the_drilled_line_leads_through_the_right_femur_into_its_head_and_ends_before_the_socket() {
        let spec = PelvisSpec::default();
        let volume = pelvis(&spec).unwrap();
        let hu = |p_mm: [f64; 3]| {
            let voxel = volume.grid.voxel_at(p_mm.map(|x| x * 1e-3));
            volume.at(voxel.map(|x| (x + 0.5) as usize)).unwrap()
        };
        let (start, direction) = ([-99.1, -143.6, 116.6], [0.947, -0.157, 0.280]);
        let along = |s: f64| add_scaled(start, s, direction);
        let bone: Vec<bool> = (-90..60).map(|s| hu(along(f64::from(s))) > 100).collect();
        assert!(hu(along(-80.0)) < 100, "soft tissue lateral of the femur");
        assert!(bone[90] && bone[110], "bone at the burr's start and 20 mm further");
        let entry = bone.iter().position(|bone| *bone).unwrap() as i32 - 90;
        assert!((-70..-35).contains(&entry), "{entry} mm");
        let gap = (30..45).find(|s| !bone[(s + 90) as usize]);
        assert!(gap.is_some(), "no joint space");
        let behind = gap.unwrap();
        assert!((behind..behind + 8).any(|s| bone[(s + 90) as usize]), "no socket behind the joint space");
        // Both sides, and air around.
        assert!(hu([95.0, -146.0, 121.0]) > 100 && hu([-179.0, -250.0, 30.0]) == -1000);
    }
}
