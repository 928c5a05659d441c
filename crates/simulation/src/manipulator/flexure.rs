//! Stiffness of a flexure in its six freedoms, from the shape of the tube.
//!
//! The bending stiffness is a parameter ([`super::ManipulatorParameters::joint_stiffness_nm_per_rad`]),
//! because published finite-element and experimental results give it. The other five follow from it: each is
//! the bending stiffness times a ratio that depends only on the shape, so no elastic modulus is needed.

use core::f64::consts::PI;

/// Shear coefficient of a rectangular section (Timoshenko's 5/6).
const RECTANGLE_SHEAR: f64 = 5.0 / 6.0;
/// Rotation of the end of a beam of height h and unit thickness clamped in an elastic half plane, under a
/// moment M: 16.67 M / (pi E h^2) (O'Donnell 1960, J. Appl. Mech. 27, 461).
const ROOT_TURN: f64 = 16.67 / PI;
/// Effective height of the root beyond the web's minimum height, as a fraction of the radius of the notch's
/// round end. Fitted to finite elements (docs/accuracy-physics.md).
const ROOT_SHARE: f64 = 0.125;
/// Compliance of the two roots of a web to its shear force V, in V / (E t). Fitted to the same finite
/// elements.
const ROOT_YIELD: f64 = 2.6;
/// Compliance of the two roots of a web to its axial force N along x, in N / (E t). Fitted to the same finite
/// elements.
const ROOT_STRETCH: f64 = 0.8;
/// Number of interval pairs of Simpson's rule along half a web.
const PAIRS: usize = 100;

/// Stiffness of a flexure in each freedom, divided by its bending stiffness.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StiffnessRatios {
    /// Bending across the bending plane, about x.
    pub lateral: f64,
    /// Torsion, about z.
    pub torsion: f64,
    /// Stretch along z, 1/m^2.
    pub axial_per_m2: f64,
    /// Shear in the bending plane, along x, 1/m^2.
    pub shear_toward_per_m2: f64,
    /// Shear across the bending plane, along y, 1/m^2.
    pub shear_across_per_m2: f64,
}

impl StiffnessRatios {
    /// Returns the ratios of a round tube without notches: `lateral` 1, `torsion` 1 / (1 + nu), axial A/I = 4
    /// / (r_o^2 + r_i^2), and shear with Cowper's coefficient of a thin tube, `kappa G/E = 1 / (4 + 3 nu)`
    /// (Cowper 1966, J. Appl. Mech. 33).
    pub fn tube([outer_m, inner_m]: [f64; 2], poisson_ratio: f64) -> Self {
        let axial = 4.0 / (outer_m * outer_m + inner_m * inner_m);
        let shear = axial / (4.0 + 3.0 * poisson_ratio);
        Self {
            lateral: 1.0,
            torsion: 1.0 / (1.0 + poisson_ratio),
            axial_per_m2: axial,
            shear_toward_per_m2: shear,
            shear_across_per_m2: shear,
        }
    }

    /// Returns the ratios of flexures in series, each given by its bending compliance and ratios: compliances
    /// add up for each freedom.
    pub(super) fn in_series(parts: &[(f64, Self)]) -> Self {
        let bending: f64 = parts.iter().map(|(compliance, _)| compliance).sum();
        let ratio = |of: fn(&Self) -> f64| {
            bending / parts.iter().map(|(compliance, own)| compliance / of(own)).sum::<f64>()
        };
        Self {
            lateral: ratio(|own| own.lateral),
            torsion: ratio(|own| own.torsion),
            axial_per_m2: ratio(|own| own.axial_per_m2),
            shear_toward_per_m2: ratio(|own| own.shear_toward_per_m2),
            shear_across_per_m2: ratio(|own| own.shear_across_per_m2),
        }
    }

    /// Returns every ratio with its name in errors.
    pub(super) fn named(&self) -> [(&'static str, f64); 5] {
        [
            ("ratios.lateral", self.lateral),
            ("ratios.torsion", self.torsion),
            ("ratios.axial_per_m2", self.axial_per_m2),
            ("ratios.shear_toward_per_m2", self.shear_toward_per_m2),
            ("ratios.shear_across_per_m2", self.shear_across_per_m2),
        ]
    }
}

/// Notches of a tube: slots with round ends, cut alternately from both sides of the bending plane. Two
/// neighbouring slots leave two webs between them, at +y and -y, along x: a flexure. A slot leaves half a
/// ring on its far side: a link.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Notch {
    /// Width of a slot along the tube, m; its end is a semicircle.
    pub width_m: f64,
    /// Depth of a slot beyond the tube axis, m; at least half its width, so that the webs have a straight
    /// part.
    pub past_axis_m: f64,
}

impl Notch {
    /// The slots of the BIGSS/JHU manipulator, measured in the visual and collision meshes of the published
    /// simulator (`ADF/meshes/bigss_cm_burr`, `high_res/seg11.OBJ`, `low_res/seg10.OBJ`,
    /// htp2/continuum-manip-volumetric-drilling-plugin, exported from the CAD): 0.73 mm wide, to 0.495 mm
    /// past the axis, one slot per flexure.
    pub const JHU: Self = Self { width_m: 0.73e-3, past_axis_m: 0.495e-3 };

    /// Returns the stiffness of a flexure for an elastic modulus of 1 Pa, N/m and N m/rad; `pitch_m` is the
    /// spacing of the flexures.
    ///
    /// A web is a Timoshenko beam along x: thickness t, the tube's wall; height h(x) = pitch - width, more at
    /// the round ends of the slots; from -e to e, with e = `past_axis_m`. Each end rotates in its half ring
    /// by O'Donnell's `16.67 M / (pi E t h_r^2) + (1 - nu) V / (E t h)`, h_r = h + width/16. With R the mean
    /// radius and two webs side by side:
    ///
    /// - bending: 1/k = 1/2 [int 12 / (E t h^3) dx + 2 * 16.67 / (pi E t h_r^2)];
    /// - axial: 1/k = 1/2 [int (12 x^2 / (E t h^3) + 6 / (5 G t h)) dx + 2 (16.67 e^2 / (pi E t h_r^2) + 2
    ///   (1 - nu) e / (E t h)) + 2.6 / (E t)];
    /// - lateral: the two webs sheared in opposite directions, `k_axial (R^2 + t^2/12)`;
    /// - shear toward: the webs stretched, 1/k = 1/2 [int dx / (E t h) + 0.8 / (E t)];
    /// - shear across and torsion: the webs bent about z, and the half ring between two flexures, on which
    ///   their forces act a pitch apart. It is an arc of height H = 2 pitch - width that begins H/2 behind
    ///   the slot's end (Saint-Venant), from the angle asin((e + H/2) / R) on each side, and is twisted by a
    ///   moment F pitch / 2: along its own axis under shear (as in a helical spring), along y under torsion.
    ///   Its bending is neglected, because it is stiff compared with the twist.
    pub fn unit_stiffness(
        &self,
        pitch_m: f64,
        [outer_m, inner_m]: [f64; 2],
        poisson_ratio: f64,
    ) -> UnitStiffness {
        let shape = Web { notch: *self, pitch_m, thickness_m: outer_m - inner_m, poisson_ratio };
        let radius = 0.5 * (outer_m + inner_m);
        let t = shape.thickness_m;
        let axial = 1.0 / shape.axial_compliance();
        let stretched = shape.integral(|_, h| 0.5 / (t * h)) + 0.5 * ROOT_STRETCH / t;
        let ring = shape.ring_compliance(radius);
        let turned = 1.0 / shape.integral(|_, h| 6.0 / (h * t * t * t));
        UnitStiffness {
            bending_nm_per_rad: 1.0 / shape.bending_compliance(),
            lateral_nm_per_rad: axial * (radius * radius + t * t / 12.0),
            torsion_nm_per_rad: turned + 1.0 / (stretched / (radius * radius) + ring.torsion),
            axial_n_per_m: axial,
            shear_toward_n_per_m: 1.0 / stretched,
            shear_across_n_per_m: 1.0 / (shape.across_compliance() + ring.shear),
        }
    }
}

/// Stiffness of a flexure for an elastic modulus of 1 Pa.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UnitStiffness {
    /// Bending about y.
    pub bending_nm_per_rad: f64,
    /// Lateral bending about x.
    pub lateral_nm_per_rad: f64,
    /// Torsion about z.
    pub torsion_nm_per_rad: f64,
    /// Stretch along z.
    pub axial_n_per_m: f64,
    /// Shear along x.
    pub shear_toward_n_per_m: f64,
    /// Shear along y.
    pub shear_across_n_per_m: f64,
}

impl UnitStiffness {
    /// Returns each stiffness over the bending stiffness.
    pub fn ratios(&self) -> StiffnessRatios {
        let k = self.bending_nm_per_rad;
        StiffnessRatios {
            lateral: self.lateral_nm_per_rad / k,
            torsion: self.torsion_nm_per_rad / k,
            axial_per_m2: self.axial_n_per_m / k,
            shear_toward_per_m2: self.shear_toward_n_per_m / k,
            shear_across_per_m2: self.shear_across_n_per_m / k,
        }
    }
}

/// One web, for an elastic modulus of 1 Pa.
struct Web {
    notch: Notch,
    pitch_m: f64,
    thickness_m: f64,
    poisson_ratio: f64,
}

/// Contribution of the half ring between two flexures to the compliance of one.
struct Ring {
    shear: f64,
    torsion: f64,
}

impl Web {
    fn shear_modulus(&self) -> f64 {
        0.5 / (1.0 + self.poisson_ratio)
    }

    /// Returns the minimum height of the web.
    fn height_m(&self) -> f64 {
        self.pitch_m - self.notch.width_m
    }

    /// Returns the integral over the web, -e to e, of a function of x and of the local height, which must be
    /// even in x. Uses Simpson's rule over the straight part, and over the angle of the round end, in which
    /// the height is smooth.
    fn integral(&self, of: impl Fn(f64, f64) -> f64) -> f64 {
        let (height, r) = (self.height_m(), 0.5 * self.notch.width_m);
        let straight = self.notch.past_axis_m - r;
        let by_simpson = |end: f64, of: &dyn Fn(f64) -> f64| {
            let step = end / (2 * PAIRS) as f64;
            let mut sum = 0.0;
            for pair in 0..PAIRS {
                let x = (2 * pair) as f64 * step;
                sum += of(x) + 4.0 * of(x + step) + of(x + 2.0 * step);
            }
            sum * step / 3.0
        };
        let flat = by_simpson(straight, &|x| of(x, height));
        let round = by_simpson(0.5 * PI, &|angle| {
            let (sin, cos) = libm::sincos(angle);
            of(straight + r * sin, height + r * (1.0 - cos)) * r * cos
        });
        2.0 * (flat + round)
    }

    fn root_turn(&self) -> f64 {
        let height = self.height_m() + ROOT_SHARE * 0.5 * self.notch.width_m;
        ROOT_TURN / (self.thickness_m * height * height)
    }

    fn bending_compliance(&self) -> f64 {
        let t = self.thickness_m;
        self.integral(|_, h| 6.0 / (t * h * h * h)) + self.root_turn()
    }

    fn axial_compliance(&self) -> f64 {
        let (t, e) = (self.thickness_m, self.notch.past_axis_m);
        let shear = RECTANGLE_SHEAR * self.shear_modulus() * t;
        let web = self.integral(|x, h| 6.0 * x * x / (t * h * h * h) + 0.5 / (shear * h));
        let turned = 2.0 * (1.0 - self.poisson_ratio) * e / (t * self.height_m());
        web + e * e * self.root_turn() + turned + 0.5 * ROOT_YIELD / t
    }

    /// Returns the compliance of the webs alone, along y.
    fn across_compliance(&self) -> f64 {
        let t = self.thickness_m;
        let shear = RECTANGLE_SHEAR * self.shear_modulus() * t;
        self.integral(|x, h| 6.0 * x * x / (h * t * t * t) + 0.5 / (shear * h))
    }

    fn ring_compliance(&self, radius: f64) -> Ring {
        let (t, pitch) = (self.thickness_m, self.pitch_m);
        let height = 2.0 * pitch - self.notch.width_m;
        // Torsion of a rectangle, long side a and short side b, to 4 % (Roark's Formulas for Stress and
        // Strain, 7th ed., table 10.1, case 4).
        let (a, b) = (height.max(t), height.min(t));
        let twist = self.shear_modulus()
            * a
            * b
            * b
            * b
            * (1.0 / 3.0 - 0.21 * b / a * (1.0 - b * b * b * b / (12.0 * a * a * a * a)));
        let start = libm::asin(((self.notch.past_axis_m + 0.5 * height) / radius).min(1.0));
        let span = PI - 2.0 * start;
        let along = 0.5 * (span + libm::sin(2.0 * start));
        let arm = 0.5 * pitch;
        Ring { shear: arm * arm * radius * span / twist, torsion: arm * arm / radius * along / twist }
    }
}
