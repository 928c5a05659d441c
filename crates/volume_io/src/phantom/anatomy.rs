//! The shape of a right proximal femur and the density inside it, as functions of position.
//!
//! Frame: millimetres, origin at the centre of the femoral head, axes LPS. For a right femur +x is medial, +y
//! posterior, +z superior. Sizes are those of an average adult: head diameter 46 mm, neck-shaft angle 125
//! degrees, anteversion 15 degrees, offset about 43 mm (Noble et al. 1988, Clin Orthop 235:148; Toogood et
//! al. 2009, Clin Orthop 467:876: rounded means).

use super::noise::value_noise;
use super::shapes::{add_scaled, ellipsoid, smooth_union, smoothstep, sphere, sub, table, tapered_capsule};
use crate::volume::{cross, dot, norm};
use voxel_grid::density;

/// Possible contents of a block of voxels around bones.
#[derive(Clone, Copy, PartialEq)]
pub enum Tissue {
    /// Air.
    Air,
    /// Soft tissue, air, or both.
    SoftOrAir,
    /// Anything.
    Any,
}

/// Radius of the femoral head, mm.
pub const HEAD_RADIUS: f64 = 23.0;
/// Distance from the shaft axis to the head centre along the neck axis, mm.
pub const NECK_LENGTH: f64 = 52.5;

/// Shaft: height above the neck-shaft crossing, half width (medial-lateral), half depth (anterior-posterior),
/// mm.
const SHAFT: [[f64; 3]; 6] = [
    [-90.0, 14.0, 14.2],
    [-60.0, 14.6, 14.4],
    [-40.0, 16.0, 15.2],
    [-22.0, 18.0, 16.0],
    [-5.0, 20.5, 16.5],
    [6.0, 20.0, 16.0],
];
/// Neck: distance from the shaft axis along the neck axis, half height, half depth, mm. Thinnest just below
/// the head.
const NECK: [[f64; 3]; 5] =
    [[4.0, 21.0, 15.0], [16.0, 18.0, 13.5], [27.0, 15.8, 12.4], [33.0, 15.8, 12.6], [40.0, 18.0, 15.5]];
/// Cortical thickness of the shaft and metaphysis: height above the crossing, thickness, mm
/// (1.5 mm around the head to 6 mm at mid-shaft: Treece et al. 2010, Med Image Anal 14:276, rounded).
const CORTEX: [[f64; 2]; 5] = [[-90.0, 6.0], [-60.0, 5.0], [-38.0, 3.6], [-15.0, 2.2], [5.0, 1.5]];

/// The femur with its derived axes.
#[derive(Clone, Debug)]
pub struct Anatomy {
    /// Unit vector from the shaft to the head along the neck axis.
    pub neck: [f64; 3],
    /// Unit vector across the neck, upward.
    neck_up: [f64; 3],
    /// Unit vector across the neck, completing a right-handed triple.
    neck_side: [f64; 3],
    /// Crossing of neck axis and shaft axis.
    pub crossing: [f64; 3],
    /// Start and unit direction of the principal compressive group, from the calcar to the top of the head.
    compressive: ([f64; 3], [f64; 3]),
    seed: u64,
}

impl Anatomy {
    /// A femur with the given neck-shaft angle and anteversion (radians) and texture seed.
    pub fn new(neck_shaft_angle_rad: f64, anteversion_rad: f64, seed: u64) -> Self {
        let rise = -libm::cos(neck_shaft_angle_rad);
        let reach = libm::sin(neck_shaft_angle_rad);
        let neck = [reach * libm::cos(anteversion_rad), -reach * libm::sin(anteversion_rad), rise];
        let crossing = neck.map(|c| -NECK_LENGTH * c);
        let up = add_scaled([0.0, 0.0, 1.0], -neck[2], neck);
        let neck_up = up.map(|c| c / norm(up));
        let calcar = add_scaled(add_scaled(crossing, 20.0, neck), -16.5, neck_up);
        let toward = sub([2.0, 0.0, 6.0], calcar);
        let compressive = (calcar, toward.map(|c| c / norm(toward)));
        Self { neck, neck_up, neck_side: cross(neck, neck_up), crossing, compressive, seed }
    }

    /// Point given relative to the neck-shaft crossing.
    fn relative_to_crossing(&self, offset: [f64; 3]) -> [f64; 3] {
        add_scaled(self.crossing, 1.0, offset)
    }

    /// Tip of the greater trochanter's core (its surface lies 8 mm further up).
    pub fn greater_trochanter(&self) -> [f64; 3] {
        self.relative_to_crossing([-7.0, 11.0, 24.5])
    }

    /// Centre of the lesser trochanter's rounded end.
    pub fn lesser_trochanter(&self) -> [f64; 3] {
        self.relative_to_crossing([12.5, 14.5, -29.0])
    }

    /// Distance to the outer surface of the bone, mm; negative inside, first-order accurate near the surface.
    pub fn bone_distance(&self, p: [f64; 3]) -> f64 {
        let q = sub(p, self.crossing);
        let [_, half_width, half_depth] = table(&SHAFT, q[2]);
        let above = (q[2] - 2.0).max(0.0);
        let shaft = ellipsoid([q[0], q[1], above], [half_width, half_depth, 14.0]);

        let along = dot(q, self.neck);
        let [_, half_height, half_side] = table(&NECK, along);
        let beyond = if along > 40.0 { along - 40.0 } else { (4.0 - along).max(0.0) };
        let neck_q = [dot(q, self.neck_up), dot(q, self.neck_side), beyond];
        let neck = ellipsoid(neck_q, [half_height, half_side, 12.0]);

        let head = sphere(p, [0.0; 3], HEAD_RADIUS);
        let trunk = smooth_union(smooth_union(shaft, neck, 14.0), head, 5.0);

        let tip = self.greater_trochanter();
        let greater = ellipsoid(sub(q, [-11.5, 4.0, 9.0]), [12.5, 15.5, 19.0]);
        let greater = smooth_union(
            greater,
            tapered_capsule(p, self.relative_to_crossing([-11.0, 7.0, 8.0]), tip, 11.0, 8.0),
            6.0,
        );
        let lesser_end = self.lesser_trochanter();
        let lesser = tapered_capsule(p, self.relative_to_crossing([3.0, 4.0, -22.0]), lesser_end, 11.0, 6.0);
        let crest = tapered_capsule(p, self.relative_to_crossing([-8.0, 13.0, 14.0]), lesser_end, 6.0, 4.5);
        let processes = smooth_union(smooth_union(greater, crest, 8.0), lesser, 8.0);
        let bone = smooth_union(trunk, processes, 8.0);

        // The fovea: a shallow pit where the ligament of the head attaches, on the medial side, a little
        // behind and below.
        let fovea = sphere(p, [23.2, 6.2, -5.0], 4.5);
        -smooth_union(-bone, fovea, 2.0)
    }

    /// Thickness of the cortical shell around a point, mm.
    pub fn cortex_thickness(&self, p: [f64; 3]) -> f64 {
        let [_, shaft] = table(&CORTEX, p[2] - self.crossing[2]);
        // The lower (medial) cortex of the neck carries the load and is the thickest part of the proximal
        // femur: the calcar.
        let from_calcar = norm(sub(p, self.compressive.0));
        shaft + 2.2 * bump(from_calcar, 13.0)
    }

    /// Apparent density of the cortex, g/cm³: thin shells are more porous than the shaft.
    fn cortical_density(&self, thickness: f64) -> f64 {
        1.35 + 0.45 * smoothstep(1.5, 4.5, thickness)
    }

    /// Apparent density of cancellous bone before texture, g/cm³.
    ///
    /// Levels by site after Morgan and Keaveny 2001 (J Biomech 34:569: femoral neck 0.56, greater
    /// trochanter 0.22 g/cm³ on average); their layout (compressive group, tensile group, Ward's
    /// triangle) after Singh et al. 1970 (J Bone Joint Surg Am 52:457).
    fn cancellous_density(&self, p: [f64; 3], depth: f64) -> f64 {
        let q = sub(p, self.crossing);
        let along = dot(q, self.neck);
        let height = dot(q, self.neck_up);
        let toward_head = smoothstep(0.0, NECK_LENGTH, along);
        let base = 0.16 + 0.19 * toward_head;

        // Principal compressive group: a fan that widens from the calcar to the top of the head.
        let (start, direction) = self.compressive;
        let offset = sub(p, start);
        let s = dot(offset, direction);
        let aside = norm(add_scaled(offset, -s, direction));
        let width = 7.0 + 0.16 * s.max(0.0);
        let compressive = 0.38 * bump(aside, width) * smoothstep(-12.0, 4.0, s);

        // Principal tensile group: an arch under the upper cortex, from the lateral cortex below the
        // trochanter into the head.
        let arch = 11.0 - 0.011 * (along - 26.0) * (along - 26.0);
        let side = dot(q, self.neck_side);
        let tensile =
            0.20 * bump((height - arch).abs(), 4.5) * bump(side, 11.0) * smoothstep(-16.0, 0.0, along);

        // Ward's triangle: the gap between the groups, low in the neck.
        let ward = sub(p, add_scaled(add_scaled(self.crossing, 16.0, self.neck), -1.0, self.neck_up));
        let gap = 0.15 * bump(norm(ward), 9.0);

        let near_cortex = 0.16 * libm::exp(-depth.max(0.0) / 3.0);
        let rho = base + compressive + tensile - gap + near_cortex;
        // Below the lesser trochanter the trabeculae thin out into the marrow canal.
        let remaining = smoothstep(-62.0, -26.0, q[2]);
        MARROW_DENSITY + (rho - MARROW_DENSITY).max(0.0) * remaining
    }

    /// Trabecular texture in [−1, 1]: grains of about 1 mm, longer along the compressive group.
    fn texture(&self, p: [f64; 3]) -> f64 {
        let u = self.compressive.1;
        let v = self.neck_side;
        let w = cross(u, v);
        let grain = [dot(p, u) / 2.6, dot(p, v) / 1.1, dot(p, w) / 1.1];
        0.7 * value_noise(self.seed, grain) + 0.3 * value_noise(self.seed ^ 1, p.map(|c| c / 3.0))
    }

    /// Apparent density of bone and marrow at a depth below the surface, g/cm³, given the blend width at the
    /// inner cortex.
    fn bone_density(&self, p: [f64; 3], depth: f64, blur: f64) -> f64 {
        let thickness = self.cortex_thickness(p);
        let cortical = coverage((thickness - depth) / blur.max(1.0));
        let texture = self.texture(p);
        let mut rho = 0.0;
        if cortical > 0.0 {
            rho += cortical * self.cortical_density(thickness) * (1.0 + 0.025 * texture);
        }
        if cortical < 1.0 {
            let cancellous = self.cancellous_density(p, depth - thickness);
            let contrast = 0.45 * smoothstep(MARROW_DENSITY, 0.2, cancellous) + 0.1;
            rho += (1.0 - cortical) * (cancellous * (1.0 + contrast * texture)).max(0.04);
        }
        rho
    }

    /// Hounsfield units of bone at `p`, whose [`Anatomy::bone_distance`] is `distance`, blended over `blur`
    /// mm.
    pub fn bone_hu(&self, p: [f64; 3], distance: f64, blur: f64) -> f64 {
        density::hu_of(1000.0 * self.bone_density(p, -distance, blur))
    }

    /// Distance to the skin, mm: an elliptic thigh, slim so that air is within the volume.
    pub fn skin_distance(&self, p: [f64; 3]) -> f64 {
        let slope = 0.03 * (-p[2]).max(0.0);
        ellipsoid([p[0] + 15.0, p[1] - 6.0, 0.0], [67.0 - slope, 52.0 - slope, 1.0])
    }

    /// Hounsfield units of muscle and fat at a depth under the skin (mm), and of air outside, blended over
    /// `blur` mm.
    ///
    /// Muscle +55, fat −105, air −1000 HU: ICRU Report 46 tissues as they appear on CT.
    pub fn soft_tissue_hu(&self, p: [f64; 3], skin_distance: f64, blur: f64) -> f64 {
        let body = coverage(-skin_distance / blur);
        if body == 0.0 {
            return AIR_HU;
        }
        let under_fat = smoothstep(5.0, 8.0, -skin_distance);
        // Fat between muscles: sheets where a slow noise crosses zero; stretched along the limb as muscles
        // are.
        let slow = value_noise(self.seed ^ 2, [p[0] / 17.0, p[1] / 17.0, p[2] / 60.0]);
        let septum = 1.0 - smoothstep(0.0, 0.10, slow.abs());
        let muscle = under_fat * (1.0 - 0.8 * septum);
        let fine = value_noise(self.seed ^ 3, p.map(|c| c / 1.5));
        let tissue = FAT_HU + (MUSCLE_HU - FAT_HU) * muscle + 10.0 * fine;
        AIR_HU + (tissue - AIR_HU) * body
    }
}

/// Hounsfield units of air.
pub const AIR_HU: f64 = -1000.0;
const MUSCLE_HU: f64 = 55.0;
const FAT_HU: f64 = -105.0;
/// Apparent bone density that gives yellow marrow's value ([`density`]): −57 HU, between fat and water.
const MARROW_DENSITY: f64 = 0.07;

/// Fraction of a voxel inside a surface `depth` voxel widths below its centre: a linear ramp, as from a box
/// average.
pub fn coverage(depth: f64) -> f64 {
    (depth + 0.5).clamp(0.0, 1.0)
}

/// A bell of height 1 and half width `width`: exp(−(x/width)²).
fn bump(x: f64, width: f64) -> f64 {
    let t = x / width;
    libm::exp(-t * t)
}
