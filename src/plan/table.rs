//! The table of measured errors and costs.

use std::fmt::Write as _;

use ipc_types::scene::{ContactVoxels, Integrator, ManipulatorRung, Scene};
use simulation::manipulator::Rung;

/// Number of flexures of the standard tool.
pub(super) const OWN_LINKS: usize = 27;

/// The settings of a table row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Rung.
    pub rung: Rung,
    /// Number of links; 27 means the tool's own flexures.
    pub links: usize,
    /// Integrator.
    pub integrator: Integrator,
    /// Step, ms.
    pub dt_ms: f64,
    /// How a voxel of bone acts on the tool's spheres.
    pub contact: ContactVoxels,
}

impl Settings {
    /// The settings as tables and messages write them.
    pub fn text(&self) -> String {
        let integrator = integrator_name(self.integrator);
        let contact = contact_name(self.contact);
        let Settings { rung, links, dt_ms, .. } = self;
        format!("{}, {links} links, {integrator}, dt {dt_ms} ms, contact {contact}", rung.name())
    }

    /// Applies the settings to a scene.
    pub fn write_into(&self, scene: &mut Scene) {
        scene.manipulator.model = Some(match self.rung {
            Rung::ConstantCurvature => ManipulatorRung::ConstantCurvature,
            Rung::Planar => ManipulatorRung::Planar,
            Rung::Spatial => ManipulatorRung::Spatial,
            Rung::Full => ManipulatorRung::Full,
        });
        // The tool's own flexures come from its tables; no number of equal links reproduces them.
        if self.links != OWN_LINKS {
            scene.manipulator.links = Some(self.links);
        }
        scene.manipulator.integrator = Some(self.integrator);
        scene.run.dt_ms = self.dt_ms;
        if scene.volume.is_some() {
            scene.contact.voxels = Some(self.contact);
        }
    }
}

/// A scene's name of a contact kind.
pub fn contact_name(contact: ContactVoxels) -> &'static str {
    match contact {
        ContactVoxels::Planes => "planes",
        ContactVoxels::Balls => "balls",
    }
}

/// A scene's name of an integrator.
pub fn integrator_name(integrator: Integrator) -> &'static str {
    match integrator {
        Integrator::LinearlyImplicitEuler => "linearly_implicit_euler",
        Integrator::Hybrid => "hybrid",
    }
}

/// Measured errors (mm; infinite where the tool was lost) and costs (microseconds per simulated millisecond).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row {
    /// The settings measured.
    pub settings: Settings,
    /// Tip error under a pure end moment, against the circular arc.
    pub end_moment_mm: f64,
    /// Tip error under a dead force, worst load, against the elastica.
    pub tip_force_mm: f64,
    /// Tip error under a tendon with friction, against the closed form.
    pub capstan_mm: f64,
    /// Tip error at rest against a wall, against the converged solution.
    pub wall_mm: f64,
    /// Error of a tool sphere at rest on a flat wall of voxels.
    pub voxel_wall_mm: f64,
    /// Path error while moving onto the wall, r.m.s.
    pub wall_path_mm: f64,
    /// Path error of a sudden pull in free space, r.m.s.
    pub swing_path_mm: f64,
    /// Path error of the burr in the default scene, r.m.s.
    pub drilled_path_mm: f64,
    /// Median step time of the sudden pull: the manipulator alone.
    pub free_us_per_ms: f64,
    /// Median step time of the default scene, including contact and drilling.
    pub drilling_us_per_ms: f64,
}

const COLUMNS: [&str; 15] = [
    "rung",
    "links",
    "integrator",
    "dt_ms",
    "contact",
    "end_moment_mm",
    "tip_force_mm",
    "capstan_mm",
    "wall_mm",
    "voxel_wall_mm",
    "wall_path_mm",
    "swing_path_mm",
    "drilled_path_mm",
    "free_us_per_ms",
    "drilling_us_per_ms",
];

impl Row {
    /// Position error of the burr at rest: the worst problem; the voxel problem counts only with bone.
    pub fn tip_mm(&self, bone: bool) -> f64 {
        let voxel_wall_mm = if bone { self.voxel_wall_mm } else { 0.0 };
        worst(&[self.end_moment_mm, self.tip_force_mm, self.capstan_mm, self.wall_mm, voxel_wall_mm])
    }

    /// Path error of the burr: the worst problem; drilling counts only with bone.
    pub fn path_mm(&self, bone: bool) -> f64 {
        let free = [self.wall_path_mm, self.swing_path_mm];
        if bone { worst(&[free[0], free[1], self.drilled_path_mm]) } else { worst(&free) }
    }

    /// Cost per simulated millisecond, µs.
    pub fn us_per_ms(&self, bone: bool) -> f64 {
        if bone { self.drilling_us_per_ms } else { self.free_us_per_ms }
    }
}

/// The largest error; NaN counts as infinite.
fn worst(errors: &[f64]) -> f64 {
    errors.iter().fold(0.0, |most, &error| if error.is_finite() { most.max(error) } else { f64::INFINITY })
}

/// The rows as CSV.
pub fn write(rows: &[Row]) -> String {
    let mut text = COLUMNS.join(",");
    text.push('\n');
    for row in rows {
        let s = &row.settings;
        let (integrator, contact) = (integrator_name(s.integrator), contact_name(s.contact));
        let _ = write!(text, "{},{},{integrator},{},{contact}", s.rung.name(), s.links, s.dt_ms);
        for error in [
            row.end_moment_mm,
            row.tip_force_mm,
            row.capstan_mm,
            row.wall_mm,
            row.voxel_wall_mm,
            row.wall_path_mm,
            row.swing_path_mm,
            row.drilled_path_mm,
        ] {
            // Writing to a String cannot fail.
            let _ = write!(text, ",{error:.4e}");
        }
        let _ = writeln!(text, ",{:.2},{:.2}", row.free_us_per_ms, row.drilling_us_per_ms);
    }
    text
}

/// Parses the rows of a table; `None` if the text is not one.
pub fn read(text: &str) -> Option<Vec<Row>> {
    let mut lines = text.lines();
    if lines.next()? != COLUMNS.join(",") {
        return None;
    }
    lines.map(row).collect()
}

fn row(line: &str) -> Option<Row> {
    let cells: Vec<&str> = line.split(',').collect();
    if cells.len() != COLUMNS.len() {
        return None;
    }
    let number = |index: usize| cells.get(index)?.parse::<f64>().ok();
    Some(Row {
        settings: Settings {
            rung: Rung::ALL.into_iter().find(|rung| Some(&rung.name()) == cells.first())?,
            links: cells.get(1)?.parse().ok()?,
            integrator: [Integrator::LinearlyImplicitEuler, Integrator::Hybrid]
                .into_iter()
                .find(|integrator| Some(&integrator_name(*integrator)) == cells.get(2))?,
            dt_ms: number(3)?,
            contact: [ContactVoxels::Planes, ContactVoxels::Balls]
                .into_iter()
                .find(|contact| Some(&contact_name(*contact)) == cells.get(4))?,
        },
        end_moment_mm: number(5)?,
        tip_force_mm: number(6)?,
        capstan_mm: number(7)?,
        wall_mm: number(8)?,
        voxel_wall_mm: number(9)?,
        wall_path_mm: number(10)?,
        swing_path_mm: number(11)?,
        drilled_path_mm: number(12)?,
        free_us_per_ms: number(13)?,
        drilling_us_per_ms: number(14)?,
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;
    use crate::plan::TABLE;

    #[test]
    fn the_table_is_read_as_it_is_written() {
        let rows = read(TABLE).unwrap();
        assert_eq!(write(&rows), TABLE);
        assert!(rows.iter().any(|row| row.path_mm(false).is_finite()));
    }

    #[test]
    fn what_was_lost_is_infinitely_wrong() {
        let row = Row { wall_mm: f64::NAN, ..read(TABLE).unwrap()[0] };
        assert_eq!(row.tip_mm(false), f64::INFINITY);
        assert_eq!(read("rung,links\nplanar,4\n"), None);
    }
}
