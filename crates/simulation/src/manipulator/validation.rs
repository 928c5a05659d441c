//! Accepted ranges of a manipulator's parameters and of a step's input.

use super::error::{ManipulatorError, check, check_all};
use super::flexure::StiffnessRatios;
use super::parameters::{ManipulatorParameters, Section, TendonRoute};
use super::state::{BaseMotion, StepInput};
use super::{MAX_LINKS, MAX_SHAFT_SPHERES, MAX_TENDONS};

impl ManipulatorParameters {
    /// Checks every field. The error names the first invalid one, its value and the accepted range.
    pub fn validate(&self) -> Result<(), ManipulatorError> {
        self.validate_chain()?;
        self.validate_body()?;
        self.validate_tendon()?;
        self.validate_contact()
    }

    fn validate_chain(&self) -> Result<(), ManipulatorError> {
        let n = self.joint_positions_m.len();
        if !(1..=MAX_LINKS).contains(&n) {
            return Err(ManipulatorError::Length {
                field: "joint_positions_m",
                given: n,
                expected: "1 to 64 (1 to 32 for the planar model)",
            });
        }
        if self.joint_stiffness_nm_per_rad.len() != n {
            return Err(ManipulatorError::Length {
                field: "joint_stiffness_nm_per_rad",
                given: self.joint_stiffness_nm_per_rad.len(),
                expected: "as many as joint_positions_m",
            });
        }
        check_all("joint_positions_m", &self.joint_positions_m, "0 to 10 m", |z| (0.0..=10.0).contains(&z))?;
        for i in 1..n {
            let value = self.joint_positions_m[i];
            if value - self.joint_positions_m[i - 1] < 1e-6 {
                return Err(ManipulatorError::EntryOutOfRange {
                    field: "joint_positions_m",
                    index: i,
                    value,
                    allowed: "at least 1e-6 m past the entry before it",
                });
            }
        }
        let stiffness = &self.joint_stiffness_nm_per_rad;
        check_all("joint_stiffness_nm_per_rad", stiffness, "1e-6 to 1e6 N m/rad", |k| {
            (1e-6..=1e6).contains(&k)
        })?;
        if !self.joint_rest_rad.is_empty() && self.joint_rest_rad.len() != n {
            return Err(ManipulatorError::Length {
                field: "joint_rest_rad",
                given: self.joint_rest_rad.len(),
                expected: "0, or as many as joint_positions_m",
            });
        }
        check_all("joint_rest_rad", &self.joint_rest_rad, "-1.6 to 1.6 rad", |x| x.abs() <= 1.6)?;
        check("joint_limit_rad", self.joint_limit_rad, "above 0 and at most 3.1 rad", |x| {
            x > 0.0 && x <= 3.1
        })?;
        let stop = self.joint_stop_stiffness_nm_per_rad;
        check("joint_stop_stiffness_nm_per_rad", stop, "1e-3 to 1e9 N m/rad", |x| (1e-3..=1e9).contains(&x))?;
        let ratio = |x: f64| (1e-3..=1e3).contains(&x);
        let [lateral, torsion] = [self.lateral_stiffness_ratio, self.torsion_stiffness_ratio];
        check("lateral_stiffness_ratio", lateral.unwrap_or(1.0), "0.001 to 1000", ratio)?;
        check("torsion_stiffness_ratio", torsion.unwrap_or(1.0), "0.001 to 1000", ratio)?;
        self.validate_section()?;
        check("poisson_ratio", self.poisson_ratio, "0 to 0.5", |x| (0.0..=0.5).contains(&x))?;
        check("tip_offset_m", self.tip_offset_m, "1e-6 to 1 m", |x| (1e-6..=1.0).contains(&x))?;
        check("damping_ratio", self.damping_ratio, "0 to 10", |x| (0.0..=10.0).contains(&x))
    }

    fn validate_section(&self) -> Result<(), ManipulatorError> {
        let Section::Ratios(ratios) = &self.section else { return Ok(()) };
        if ratios.len() != self.joint_positions_m.len() {
            return Err(ManipulatorError::Length {
                field: "section",
                given: ratios.len(),
                expected: "as many as joint_positions_m",
            });
        }
        for (field, value) in ratios.iter().flat_map(StiffnessRatios::named) {
            check(field, value, "1e-6 to 1e15", |x| (1e-6..=1e15).contains(&x))?;
        }
        Ok(())
    }

    fn validate_body(&self) -> Result<(), ManipulatorError> {
        let length = |x: f64| (1e-6..=1.0).contains(&x);
        check("linear_density_kg_per_m", self.linear_density_kg_per_m, "1e-9 to 1e6 kg/m", |x| {
            (1e-9..=1e6).contains(&x)
        })?;
        check("tube_radii_m[0]", self.tube_radii_m[0], "1e-6 to 1 m", length)?;
        let outer = self.tube_radii_m[0];
        check("tube_radii_m[1]", self.tube_radii_m[1], "0 to the outer radius", |x| {
            (0.0..=outer).contains(&x)
        })?;
        for (field, value) in [("burr_mass_kg", self.burr_mass_kg), ("shaft_mass_kg", self.shaft_mass_kg)] {
            check(field, value, "0 to 1000 kg", |x| (0.0..=1000.0).contains(&x))?;
        }
        check("shaft_centre_m", self.shaft_centre_m, "-10 to 10 m", |x| x.abs() <= 10.0)?;
        check_all("mount_stiffness_n_per_m", &self.mount_stiffness_n_per_m, "1 to 1e12 N/m", |k| {
            (1.0..=1e12).contains(&k)
        })?;
        check("mount_damping_ratio", self.mount_damping_ratio, "0 to 100", |x| (0.0..=100.0).contains(&x))?;
        check_all("gravity_m_per_s2", self.gravity_m_per_s2.as_slice(), "-1000 to 1000", |x| {
            x.abs() <= 1000.0
        })?;
        if self.shaft_sphere_count > MAX_SHAFT_SPHERES {
            return Err(ManipulatorError::Length {
                field: "shaft_sphere_count",
                given: self.shaft_sphere_count,
                expected: "at most 8",
            });
        }
        check_all("shaft_sphere_span_m", &self.shaft_sphere_span_m, "-10 to 10 m", |x| x.abs() <= 10.0)?;
        check("shaft_sphere_radius_m", self.shaft_sphere_radius_m, "1e-6 to 1 m", length)?;
        check("segment_sphere_radius_m", self.segment_sphere_radius_m, "1e-6 to 1 m", length)?;
        let last_m = self.tip_offset_m;
        for ball in self.cutter.balls() {
            check("cutter, radius", ball.radius_m, "1e-6 to 1 m", length)?;
            check("cutter, behind_m", ball.behind_m, "0 to tip_offset_m", |x| (0.0..=last_m).contains(&x))?;
        }
        Ok(())
    }

    fn validate_tendon(&self) -> Result<(), ManipulatorError> {
        let tendon = &self.tendon;
        check("tendon.offset_m", tendon.offset_m, "0 to 1 m", |x| (0.0..=1.0).contains(&x))?;
        check("tendon.gap_m", tendon.gap_m, "0 to 1 m", |x| (0.0..=1.0).contains(&x))?;
        check("tendon.stiffness_n_per_m", tendon.stiffness_n_per_m, "1 to 1e12 N/m", |x| {
            (1.0..=1e12).contains(&x)
        })?;
        self.validate_routes(self.tendon_routes.as_deref().unwrap_or_default())?;
        let friction = tendon.friction_coefficient;
        check("tendon.friction_coefficient", friction, "0 to 5", |x| (0.0..=5.0).contains(&x))?;
        check("tendon.presliding_m", tendon.presliding_m, "1e-9 to 1 m", |x| (1e-9..=1.0).contains(&x))
    }

    fn validate_routes(&self, routes: &[TendonRoute]) -> Result<(), ManipulatorError> {
        let given = routes.len();
        if given > MAX_TENDONS {
            let expected = "at most 4";
            return Err(ManipulatorError::Length { field: "tendon_routes", given, expected });
        }
        let joints = self.joint_positions_m.len();
        for route in routes {
            let TendonRoute { channel_m, reach, twist_rad_per_m, stiffness_n_per_m, friction_coefficient } =
                route;
            check_all("tendon_routes.channel_m", channel_m, "-1 to 1 m", |x| x.abs() <= 1.0)?;
            check_all(
                "tendon_routes.stiffness_n_per_m",
                stiffness_n_per_m.as_slice(),
                "1 to 1e12 N/m",
                |x| (1.0..=1e12).contains(&x),
            )?;
            check_all(
                "tendon_routes.friction_coefficient",
                friction_coefficient.as_slice(),
                "0 to 5",
                |x| (0.0..=5.0).contains(&x),
            )?;
            let longest_m = self.cell_edges_m().windows(2).map(|cell| cell[1] - cell[0]).fold(0.0, f64::max);
            let allowed = "at most an eighth of a turn from one flexure to the next";
            check("tendon_routes.twist_rad_per_m", *twist_rad_per_m, allowed, |twist| {
                (twist * longest_m).abs() <= core::f64::consts::FRAC_PI_4 * (1.0 + 1e-9)
            })?;
            let to = reach.to.unwrap_or(joints);
            check("tendon_routes.reach.to", to as f64, "1 to the number of flexures", |_| {
                (1..=joints).contains(&to)
            })?;
            check("tendon_routes.reach.from", reach.from as f64, "0 to below `to`", |_| reach.from < to)?;
        }
        Ok(())
    }

    fn validate_contact(&self) -> Result<(), ManipulatorError> {
        let contact = &self.contact;
        let friction = |x: f64| (0.0..=10.0).contains(&x);
        check("contact.friction_coefficient", contact.friction_coefficient, "0 to 10", friction)?;
        check("contact.burr_friction_coefficient", contact.burr_friction_coefficient, "0 to 10", friction)?;
        check("contact.stiffness_n_per_m", contact.stiffness_n_per_m, "1 to 1e12 N/m", |x| {
            (1.0..=1e12).contains(&x)
        })?;
        check("contact.push_out_speed_m_per_s", contact.push_out_speed_m_per_s, "0 to 1000 m/s", |x| {
            (0.0..=1000.0).contains(&x)
        })?;
        let iterations = contact.max_iterations as f64;
        check("contact.max_iterations", iterations, "1 to 10000", |x| (1.0..=10000.0).contains(&x))?;
        check("contact.tolerance_m_per_s", contact.tolerance_m_per_s, "0 to 1 m/s", |x| {
            (0.0..=1.0).contains(&x)
        })?;
        let modes = self.moment_modes as f64;
        check("moment_modes", modes, "2 to 8", |modes| (2.0..=8.0).contains(&modes))?;
        check("hybrid_tolerance_rad", self.hybrid_tolerance_rad, "above 0 and at most 1 rad", |x| {
            x > 0.0 && x <= 1.0
        })
    }
}

/// Rejects input that is not finite or out of range.
pub(super) fn validate(dt: f64, input: &StepInput) -> Result<(), ManipulatorError> {
    check("dt_s", dt, "1e-7 to 0.1 s", |x| (1e-7..=0.1).contains(&x))?;
    validate_base(&input.base)?;
    let each = input.tendon.values();
    if input.tendon.is_displacement() {
        check_all("tendon displacement", &each, "-1 to 1 m", |x| x.abs() <= 1.0)?;
    } else {
        check_all("tendon force", &each, "-1e5 to 1e5 N", |x| x.abs() <= 1e5)?;
    }
    let wrench = &input.tip_wrench;
    check_all("tip_wrench.force_n", wrench.force_n.as_slice(), "-1e5 to 1e5 N", |x| x.abs() <= 1e5)?;
    check_all("tip_wrench.torque_nm", wrench.torque_nm.as_slice(), "-1e5 to 1e5 N m", |x| x.abs() <= 1e5)
}

/// Rejects a base motion that is not finite, not a rotation, or out of range.
pub(super) fn validate_base(base: &BaseMotion) -> Result<(), ManipulatorError> {
    let pose = &base.t_world_base;
    check_all("base translation", pose.translation.vector.as_slice(), "-1000 to 1000 m", |x| x.abs() <= 1e3)?;
    let norm = pose.rotation.coords.norm_squared();
    check("base rotation, squared norm", norm, "1 within 1e-6", |x| (x - 1.0).abs() <= 1e-6)?;
    let linear = base.linear_velocity_m_per_s.as_slice();
    check_all("base.linear_velocity_m_per_s", linear, "-100 to 100 m/s", |x| x.abs() <= 100.0)?;
    let angular = base.angular_velocity_rad_per_s.as_slice();
    check_all("base.angular_velocity_rad_per_s", angular, "-1000 to 1000 rad/s", |x| x.abs() <= 1000.0)
}
