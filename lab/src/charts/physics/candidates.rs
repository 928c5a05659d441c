//! The settings from which a plan chooses, measured on the chart's problems.

use crate::effort::Effort;
use ipc_types::scene::{ContactVoxels, Integrator as SceneIntegrator};
use simulation::manipulator::{Integrator, ManipulatorError, Rung};

use super::drilled::Drilling;
use super::problems::{self, Measured};
use super::standard::{self, TunnelReferences};
use super::voxel_wall::voxel_wall_mm;
use crate::charts::method::Method;
use trabecula::failure::Failure;
use trabecula::plan::measure::against::{References, distance_mm};
use trabecula::plan::{Beam, Pull, Row, Settings};

/// Link counts of each measured rung. `modal` is not measured: a tolerance never chooses it, because it is
/// not valid where single flexures are at their stops. The tool has 27 flexures. A richer rung is not worth
/// its cost while the error from few links dominates.
const LINKS: [(Rung, &[usize]); 4] = [
    (Rung::ConstantCurvature, &[27]),
    (Rung::Planar, &[4, 8, 13, 27]),
    (Rung::Spatial, &[8, 13, 27]),
    (Rung::Full, &[13, 27]),
];
const DT_MS: [f64; 3] = [0.5, 1.0, 2.0];
/// The settings whose path shows the effect of the voxels.
const STANDARD: Settings = Settings {
    rung: Rung::Planar,
    links: 27,
    integrator: SceneIntegrator::Hybrid,
    dt_ms: 1.0,
    contact: ContactVoxels::Planes,
};
/// Also measured and drawn, but in no table, because no plan chooses it.
const BESIDE: Settings = Settings { rung: Rung::Modal, ..STANDARD };
/// Voxel of the default scene, mm.
const SPACING_MM: f64 = 0.5;
/// The coarser voxel size to compare with, mm.
pub const COARSE_MM: f64 = 1.0;
/// Timed repetitions of the drilled path; the shortest counts.
const TIMINGS: usize = 2;
/// Fraction of the drilled path used with quick effort.
const QUICK_SHARE: f64 = 0.02;

/// Results for the settings.
pub struct Settled {
    /// The table of settings from which a plan chooses.
    pub rows: Vec<Row>,
    /// Moment modes, measured in the same way.
    pub beside: Row,
    /// Change of the drilled path with voxels of twice the size, mm.
    pub coarse_mm: f64,
}

/// Returns the settings to measure at this effort.
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
            Rung::Modal | Rung::Planar | Rung::Spatial => &[euler, SceneIntegrator::Hybrid],
        };
        for &integrator in integrators {
            for &links in links {
                all.extend(DT_MS.map(|dt_ms| Settings { rung, links, integrator, dt_ms, contact }));
            }
        }
    }
    all
}

/// The contact kind only matters when the tool touches bone. The other kind is measured with the time step of
/// most scenes, and only where the drilled path is measured.
fn with_the_other_contact(settings: &Settings) -> Option<Settings> {
    let drilled = is_drilled(settings) && settings.dt_ms == 1.0;
    drilled.then_some(Settings { contact: ContactVoxels::Balls, ..*settings })
}

/// Whether to measure the drilled path with these settings. In contact both integrators are linearly implicit
/// Euler, so varying one of them is enough.
fn is_drilled(settings: &Settings) -> bool {
    let hybrid = settings.integrator == SceneIntegrator::Hybrid;
    match (settings.rung, settings.links) {
        (Rung::Planar, 27) => hybrid || settings.dt_ms == 1.0,
        (Rung::Planar, _) | (Rung::Spatial | Rung::Full, 27) => hybrid && settings.dt_ms == 1.0,
        (Rung::ConstantCurvature, _) => settings.dt_ms == 1.0,
        (Rung::Modal | Rung::Spatial | Rung::Full, _) => false,
    }
}

/// Returns the chart's method for these settings.
pub fn method(settings: &Settings) -> Method {
    let integrator = match settings.integrator {
        SceneIntegrator::LinearlyImplicitEuler => Integrator::LinearlyImplicitEuler,
        SceneIntegrator::Hybrid => Integrator::Hybrid,
    };
    Method::Rung(settings.rung, integrator)
}

/// Measures the errors without bone: on the beam, and on the standard tool's pulls.
///
/// # Errors
/// Invalid parameters.
pub fn without_bone(settings: &Settings, references: &mut References) -> Result<Row, Failure> {
    let refused = |cause: ManipulatorError| Failure::failed(cause.to_string());
    let by = |problem: fn(Method, usize, f64) -> Measured| {
        problem(method(settings), settings.links, settings.dt_ms).map_err(refused)
    };
    let mm = |um: f64| um * 1e-3;
    let named = |more: &[(&str, f64)], name: &str| {
        more.iter().find(|(given, _)| *given == name).map_or(f64::NAN, |(_, um)| mm(*um))
    };
    let (_, end_moment, _) = by(problems::end_moment)?;
    let (_, tip_force, _) = by(problems::tip_force)?;
    let (_, _, capstan) = by(problems::capstan)?;
    let (_, wall_path, wall) = by(problems::wall)?;
    let gentle = standard::free(settings, Pull::Gentle, references)?;
    let hard = standard::free(settings, Pull::Hard, references)?;
    Ok(Row {
        settings: *settings,
        beam: Some(Beam {
            end_moment_mm: mm(end_moment),
            tip_force_mm: mm(tip_force),
            capstan_mm: named(&capstan, "tip_um"),
            wall_mm: named(&wall, "end_um"),
            wall_path_mm: mm(wall_path),
        }),
        voxel_wall_mm: f64::NAN,
        rest_mm: gentle.end_mm,
        hard_rest_mm: hard.end_mm,
        free_path_mm: gentle.worst_path_mm,
        hard_path_mm: hard.worst_path_mm,
        drilled_path_mm: f64::NAN,
        grid_path_mm: f64::NAN,
        free_us_per_ms: gentle.us_per_ms,
        drilling_us_per_ms: f64::NAN,
    })
}

/// Measures all settings on all problems. Calls `save` with the rows whenever there are new results.
///
/// # Errors
/// Invalid settings, or results that cannot be saved.
pub fn measure(
    effort: Effort,
    mut save: impl FnMut(&[Row]) -> Result<(), Failure>,
) -> Result<Settled, Failure> {
    let (mut rows, mut references) = (Vec::new(), References::default());
    let mut of_tunnels = TunnelReferences::default();
    for settings in settings(effort) {
        let row = without_bone(&settings, &mut references)?;
        for settings in [Some(settings), with_the_other_contact(&settings)].into_iter().flatten() {
            let voxel_wall_mm = voxel_wall_mm(settings.contact, SPACING_MM)
                .map_err(|cause| Failure::failed(cause.to_string()))?;
            rows.push(Row { settings, voxel_wall_mm, ..row });
        }
    }
    save(&rows)?;
    let quick = effort == Effort::Quick;
    let drilling = Drilling::new(SPACING_MM, if quick { QUICK_SHARE } else { 1.0 })?;
    let grid = |contact| standard::grid_mm(&Settings { contact, ..STANDARD });
    let grid_mm =
        if quick { [f64::NAN; 2] } else { [grid(ContactVoxels::Planes)?, grid(ContactVoxels::Balls)?] };
    for place in 0..rows.len() {
        let settings = rows[place].settings;
        if is_drilled(&settings) || quick {
            in_bone(&mut rows[place], &drilling, effort, &mut references, &mut of_tunnels)?;
            rows[place].grid_path_mm = grid_mm[usize::from(settings.contact == ContactVoxels::Balls)];
            save(&rows)?;
        }
        tell(&rows[place]);
    }
    let mut beside = without_bone(&BESIDE, &mut references)?;
    in_bone(&mut beside, &drilling, effort, &mut references, &mut of_tunnels)?;
    tell(&beside);
    let (fine, _) = drilling.path(&STANDARD)?;
    let (path, _) = Drilling::new(COARSE_MM, if quick { QUICK_SHARE } else { 1.0 })?.path(&STANDARD)?;
    let off_mm = distance_mm(&path, &fine);
    say!(
        "drilled     {}, voxel {COARSE_MM} mm instead of {SPACING_MM}: {off_mm:.4} mm r.m.s.",
        STANDARD.text()
    );
    Ok(Settled { rows, beside, coarse_mm: off_mm })
}

/// Measures the errors and the cost of drilling; with quick effort only at the beginning of the default
/// scene.
fn in_bone(
    row: &mut Row,
    drilling: &Drilling,
    effort: Effort,
    references: &mut References,
    of_tunnels: &mut TunnelReferences,
) -> Result<(), Failure> {
    let settings = row.settings;
    let compared = drilling.compare(&settings, references)?;
    let (mut worst_mm, mut us_per_ms) = (compared.worst_path_mm, compared.us_per_ms);
    if effort == Effort::Full {
        let tunnels_mm = standard::drilled_mm(&settings, of_tunnels)?;
        worst_mm = if tunnels_mm.is_nan() { f64::NAN } else { worst_mm.max(tunnels_mm) };
        // The path is the same every time; other load on the machine only adds to the cost.
        for _ in 1..TIMINGS {
            us_per_ms = us_per_ms.min(drilling.path(&settings)?.1);
        }
    }
    (row.drilled_path_mm, row.drilling_us_per_ms) = (worst_mm, us_per_ms);
    Ok(())
}

fn tell(row: &Row) {
    say!(
        "plan        {:<62} rest {:.4} mm, hard {:.4}; path {:.4} mm, hard {:.4}, drilled {:.4} + {:.4}; \
         {:.2} us/ms free, {:.2} drilling",
        row.settings.text(),
        row.rest_mm,
        row.hard_rest_mm,
        row.free_path_mm,
        row.hard_path_mm,
        row.drilled_path_mm,
        row.grid_path_mm,
        row.free_us_per_ms,
        row.drilling_us_per_ms
    );
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;
    use trabecula::plan::{TABLE, table::read};

    /// Fraction by which the step's own error may differ between link counts.
    const ROUNDED: f64 = 0.05;

    /// Returns pairs of table rows, with planes, that differ in the number of links: fewer and more.
    fn pairs(rows: &[Row]) -> Vec<(&Row, &Row)> {
        let planes = |row: &&Row| row.settings.contact == ContactVoxels::Planes;
        let more = |few: &Row, many: &Row| {
            many.settings.links > few.settings.links
                && many.settings == Settings { links: many.settings.links, ..few.settings }
        };
        let of = |few| rows.iter().filter(move |many| more(few, many)).map(move |many| (few, many));
        rows.iter().filter(planes).flat_map(of).collect()
    }

    /// More links are never worse: the reference has the tool's own flexures. The error left at 27 links is
    /// that of the step. Hard pulls are excluded: they throw the flexures against their stops, where the step
    /// dominates.
    #[test]
    fn errors_of_the_table_fall_as_links_rise() {
        let rows = read(TABLE).unwrap();
        let pairs = pairs(&rows);
        assert!(pairs.len() > 30, "{}", pairs.len());
        for (few, many) in pairs {
            for (name, few_mm, many_mm) in [
                ("rest", few.rest_mm, many.rest_mm),
                ("free path", few.free_path_mm, many.free_path_mm),
                ("tip force", few.beam.unwrap().tip_force_mm, many.beam.unwrap().tip_force_mm),
            ] {
                let both = few_mm.is_finite() && many_mm.is_finite();
                assert!(
                    !both || many_mm <= few_mm * (1.0 + ROUNDED),
                    "{name}: {} is off by {few_mm} mm, {} by {many_mm}",
                    few.settings.text(),
                    many.settings.text()
                );
            }
        }
    }

    /// A drilled path depends on the position of each flexure: equal links have about the same error
    /// regardless of their number.
    #[test]
    fn a_drilled_path_is_best_with_the_tools_own_flexures() {
        let rows = read(TABLE).unwrap();
        let drilled = |pair: &(&Row, &Row)| {
            let (few, own) = pair;
            own.settings.links == STANDARD.links
                && few.drilled_path_mm.is_finite()
                && own.drilled_path_mm.is_finite()
        };
        let pairs: Vec<_> = pairs(&rows).into_iter().filter(drilled).collect();
        assert_eq!(pairs.len(), 3);
        for (few, own) in pairs {
            assert!(
                own.drilled_path_mm < few.drilled_path_mm,
                "{} is off by {} mm, {} by {}",
                few.settings.text(),
                few.drilled_path_mm,
                own.settings.text(),
                own.drilled_path_mm
            );
        }
    }

    /// The errors do not depend on the machine: 1e-3 covers the rounding of the table's five digits, and 1 nm
    /// the rounding of errors that are zero.
    #[test]
    fn the_table_of_measured_errors_is_current() {
        let (rows, mut references) = (read(TABLE).unwrap(), References::default());
        for settings in settings(Effort::Quick) {
            let table = rows.iter().find(|row| row.settings == settings).unwrap();
            let now = without_bone(&settings, &mut references).unwrap();
            let (then, of_beam) = (table.beam.unwrap(), now.beam.unwrap());
            for (name, then, now) in [
                ("end moment", then.end_moment_mm, of_beam.end_moment_mm),
                ("tip force", then.tip_force_mm, of_beam.tip_force_mm),
                ("capstan", then.capstan_mm, of_beam.capstan_mm),
                ("wall", then.wall_mm, of_beam.wall_mm),
                ("voxel wall", table.voxel_wall_mm, voxel_wall_mm(settings.contact, SPACING_MM).unwrap()),
                ("wall path", then.wall_path_mm, of_beam.wall_path_mm),
                ("rest", table.rest_mm, now.rest_mm),
                ("hard rest", table.hard_rest_mm, now.hard_rest_mm),
                ("free path", table.free_path_mm, now.free_path_mm),
                ("hard path", table.hard_path_mm, now.hard_path_mm),
            ] {
                assert!(
                    (then - now).abs() <= 1e-3 * then + 1e-6,
                    "{}, {name}: the table says {then} mm, measured {now}; update it: \
                     trabecula-lab chart physics, then copy physics-plan.csv to src/plan/table.csv",
                    settings.text()
                );
            }
        }
    }
}
