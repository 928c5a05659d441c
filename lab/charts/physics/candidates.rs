//! The settings that a plan chooses from, measured on the chart's problems.

use ipc_types::scene::{ContactVoxels, Integrator as SceneIntegrator};
use simulation::manipulator::{Integrator, ManipulatorError, Rung};

use super::drilled::{Drilling, distance_mm};
use super::problems::{self, Effort, Measured};
use super::voxel_wall::voxel_wall_mm;
use crate::charts::method::Method;
use trabecula::failure::Failure;
use trabecula::plan::{Row, Settings};

/// Links of each rung; the tool has 27 flexures. A richer rung is not worth its cost while the error from few links
/// dominates.
const LINKS: [(Rung, &[usize]); 4] = [
    (Rung::ConstantCurvature, &[27]),
    (Rung::Planar, &[4, 8, 13, 27]),
    (Rung::Spatial, &[8, 13, 27]),
    (Rung::Full, &[13, 27]),
];
const DT_MS: [f64; 3] = [0.5, 1.0, 2.0];
/// The converged solution of the default scene.
const CONVERGED: Settings = Settings {
    rung: Rung::Full,
    links: 27,
    integrator: SceneIntegrator::Hybrid,
    dt_ms: 0.5,
    contact: ContactVoxels::Planes,
};
/// Voxel of the default scene, mm.
const SPACING_MM: f64 = 0.5;
/// The coarser voxel size to compare with, mm.
pub const COARSE_MM: f64 = 1.0;
/// Timed repetitions of the drilled path; the shortest counts.
const TIMINGS: usize = 3;
/// Fraction of the drilled path used with quick effort.
const QUICK_SHARE: f64 = 0.02;

/// The settings to measure at this effort.
pub fn settings(effort: Effort) -> Vec<Settings> {
    let (euler, contact) = (SceneIntegrator::LinearlyImplicitEuler, ContactVoxels::Planes);
    if effort == Effort::Quick {
        let planar = Settings {
            rung: Rung::Planar,
            links: 8,
            integrator: SceneIntegrator::Hybrid,
            dt_ms: 1.0,
            contact,
        };
        let arc =
            Settings { rung: Rung::ConstantCurvature, links: 27, integrator: euler, dt_ms: 2.0, contact };
        return vec![arc, planar, Settings { integrator: euler, dt_ms: 2.0, links: 13, ..planar }];
    }
    let mut all = Vec::new();
    for (rung, links) in LINKS {
        // The arc has only one integrator; the full rung is included for its accuracy.
        let integrators: &[SceneIntegrator] = match rung {
            Rung::ConstantCurvature => &[euler],
            Rung::Full => &[SceneIntegrator::Hybrid],
            Rung::Planar | Rung::Spatial => &[euler, SceneIntegrator::Hybrid],
        };
        for &integrator in integrators {
            for &links in links {
                all.extend(DT_MS.map(|dt_ms| Settings { rung, links, integrator, dt_ms, contact }));
            }
        }
    }
    all
}

/// The contact kind only matters when the tool touches bone. The other kind is measured with the time step of most
/// scenes, and only where the drilled path is measured.
fn with_the_other_contact(settings: &Settings) -> Option<Settings> {
    let drilled = is_drilled(settings) && settings.dt_ms == 1.0;
    drilled.then_some(Settings { contact: ContactVoxels::Balls, ..*settings })
}

/// Whether to measure the drilled path with these settings. In contact both integrators are linearly implicit Euler,
/// so varying one of them is enough.
fn is_drilled(settings: &Settings) -> bool {
    let hybrid = settings.integrator == SceneIntegrator::Hybrid;
    match (settings.rung, settings.links) {
        (Rung::Planar, 27) => hybrid || settings.dt_ms == 1.0,
        (Rung::Planar, _) | (Rung::Spatial | Rung::Full, 27) => hybrid && settings.dt_ms == 1.0,
        (Rung::ConstantCurvature, _) => settings.dt_ms == 1.0,
        (Rung::Spatial | Rung::Full, _) => false,
    }
}

/// The chart's method for these settings.
pub fn method(settings: &Settings) -> Method {
    let integrator = match settings.integrator {
        SceneIntegrator::LinearlyImplicitEuler => Integrator::LinearlyImplicitEuler,
        SceneIntegrator::Hybrid => Integrator::Hybrid,
    };
    Method::Rung(settings.rung, integrator)
}

/// The errors on the beam, without bone.
///
/// # Errors
/// Invalid parameters.
pub fn on_the_beam(settings: &Settings) -> Result<Row, ManipulatorError> {
    let by = |problem: fn(Method, usize, f64) -> Measured| {
        problem(method(settings), settings.links, settings.dt_ms)
    };
    let mm = |um: f64| um * 1e-3;
    let named = |more: &[(&str, f64)], name: &str| {
        more.iter().find(|(given, _)| *given == name).map_or(f64::NAN, |(_, um)| mm(*um))
    };
    let (_, end_moment, _) = by(problems::end_moment)?;
    let (_, tip_force, _) = by(problems::tip_force)?;
    let (_, _, capstan) = by(problems::capstan)?;
    let (_, wall_path, wall) = by(problems::wall)?;
    let (free_us_per_ms, swing_path, _) = by(problems::swing)?;
    Ok(Row {
        settings: *settings,
        end_moment_mm: mm(end_moment),
        tip_force_mm: mm(tip_force),
        capstan_mm: named(&capstan, "tip_um"),
        wall_mm: named(&wall, "end_um"),
        voxel_wall_mm: f64::NAN,
        wall_path_mm: mm(wall_path),
        swing_path_mm: mm(swing_path),
        drilled_path_mm: f64::NAN,
        free_us_per_ms,
        drilling_us_per_ms: f64::NAN,
    })
}

/// Measures all settings on all problems, and how far voxels of twice the size move the drilled path, mm. Calls `save`
/// with the rows whenever there are new results.
///
/// # Errors
/// Invalid settings, or results that cannot be saved.
pub fn measure(
    effort: Effort,
    mut save: impl FnMut(&[Row]) -> Result<(), Failure>,
) -> Result<(Vec<Row>, f64), Failure> {
    let mut rows = Vec::new();
    for settings in settings(effort) {
        let row = on_the_beam(&settings).map_err(|cause| Failure::failed(cause.to_string()))?;
        for settings in [Some(settings), with_the_other_contact(&settings)].into_iter().flatten() {
            let voxel_wall_mm = voxel_wall_mm(settings.contact, SPACING_MM)
                .map_err(|cause| Failure::failed(cause.to_string()))?;
            rows.push(Row { settings, voxel_wall_mm, ..row });
        }
    }
    save(&rows)?;
    let share = if effort == Effort::Quick { QUICK_SHARE } else { 1.0 };
    let drilling = Drilling::new(SPACING_MM, share)?;
    let (reference, _) = drilling.run(&CONVERGED)?;
    for place in 0..rows.len() {
        let settings = rows[place].settings;
        if is_drilled(&settings) || effort == Effort::Quick {
            let (path, mut us_per_ms) = drilling.run(&settings)?;
            // The path is the same every time; other load on the machine only adds to the cost.
            for _ in 1..if effort == Effort::Quick { 1 } else { TIMINGS } {
                us_per_ms = us_per_ms.min(drilling.run(&settings)?.1);
            }
            rows[place].drilled_path_mm = distance_mm(&path, &reference);
            rows[place].drilling_us_per_ms = us_per_ms;
            save(&rows)?;
        }
        tell(&rows[place]);
    }
    let at_1_ms = Settings { dt_ms: 1.0, ..CONVERGED };
    let (fine, _) = drilling.run(&at_1_ms)?;
    let (path, _) = Drilling::new(COARSE_MM, share)?.run(&at_1_ms)?;
    let off_mm = distance_mm(&path, &fine);
    say!(
        "drilled     {}, voxel {COARSE_MM} mm instead of {SPACING_MM}: {off_mm:.4} mm r.m.s.",
        at_1_ms.text()
    );
    Ok((rows, off_mm))
}

fn tell(row: &Row) {
    say!(
        "plan        {:<62} tip {:.4} mm in bone, path {:.4} mm (drilled {:.4}), {:.2} us/ms free, {:.2} drilling",
        row.settings.text(),
        row.tip_mm(true),
        row.path_mm(true),
        row.drilled_path_mm,
        row.free_us_per_ms,
        row.drilling_us_per_ms
    );
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;
    use trabecula::plan::{TABLE, table::read};

    /// The errors do not depend on the machine: 1e-3 covers the rounding of the table's five digits, and 1 nm the
    /// rounding of errors that are zero.
    #[test]
    fn the_table_of_measured_errors_is_current() {
        let rows = read(TABLE).unwrap();
        for settings in settings(Effort::Quick) {
            let table = rows.iter().find(|row| row.settings == settings).unwrap();
            let now = on_the_beam(&settings).unwrap();
            for (name, then, now) in [
                ("end moment", table.end_moment_mm, now.end_moment_mm),
                ("tip force", table.tip_force_mm, now.tip_force_mm),
                ("capstan", table.capstan_mm, now.capstan_mm),
                ("wall", table.wall_mm, now.wall_mm),
                ("voxel wall", table.voxel_wall_mm, voxel_wall_mm(settings.contact, SPACING_MM).unwrap()),
                ("wall path", table.wall_path_mm, now.wall_path_mm),
                ("swing path", table.swing_path_mm, now.swing_path_mm),
            ] {
                assert!(
                    (then - now).abs() <= 1e-3 * then + 1e-6,
                    "{}, {name}: the table says {then} mm, measured {now}; make it anew: trabecula chart physics, then physics-plan.csv to src/plan/table.csv",
                    settings.text()
                );
            }
        }
    }
}
