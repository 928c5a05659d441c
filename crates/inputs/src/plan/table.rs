//! The table of measured errors and costs.

use std::fmt::Write as _;

use ipc_types::scene::{ContactVoxels, Integrator, ManipulatorRung, Scene};
use simulation::manipulator::Rung;

use super::load::{Load, Pull};

/// Number of flexures of the standard tool.
pub(super) const OWN_LINKS: usize = 27;

/// Number of flexures of a scene's tool.
pub(super) fn own_links(scene: &Scene) -> usize {
    scene.manipulator.tool.as_ref().map_or(OWN_LINKS, |tool| tool.flexures().len())
}

/// The settings of a table row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Model.
    pub rung: Rung,
    /// Number of links; a number equal to that of the tool's flexures (27 for the standard one) means the
    /// flexures themselves.
    pub links: usize,
    /// Integrator.
    pub integrator: Integrator,
    /// Step, ms.
    pub dt_ms: f64,
    /// Contact model of a voxel with the tool's spheres.
    pub contact: ContactVoxels,
}

impl Settings {
    /// The settings as written in tables and messages.
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
            Rung::Modal => ManipulatorRung::Modal,
            Rung::Planar => ManipulatorRung::Planar,
            Rung::Spatial => ManipulatorRung::Spatial,
            Rung::Full => ManipulatorRung::Full,
        });
        // The tool's own flexures come from its tables; no number of equal links reproduces them.
        if self.links != own_links(scene) {
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

/// Errors of the chain as a beam, against closed forms, mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Beam {
    /// Tip error under a pure end moment, against the circular arc.
    pub end_moment_mm: f64,
    /// Tip error under a dead force, worst load, against the elastica.
    pub tip_force_mm: f64,
    /// Tip error under a tendon with friction, against the closed form.
    pub capstan_mm: f64,
    /// Tip error at rest against a wall, against the converged solution.
    pub wall_mm: f64,
    /// Path error while moving onto the wall, r.m.s.
    pub wall_path_mm: f64,
}

impl Beam {
    fn tip_mm(&self) -> f64 {
        worst(&[self.end_moment_mm, self.tip_force_mm, self.capstan_mm, self.wall_mm])
    }
}

/// Measured errors (mm; infinite if the tool was lost or nothing was measured) and costs (microseconds per
/// simulated millisecond).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row {
    /// The settings measured.
    pub settings: Settings,
    /// As a beam; `None` for a scene's own tool, which is compared only with the reference.
    pub beam: Option<Beam>,
    /// Error of a tool sphere at rest on a flat wall of voxels.
    pub voxel_wall_mm: f64,
    /// Tip error at rest under a gentle pull in free space, against the reference.
    pub rest_mm: f64,
    /// The same under a hard pull.
    pub hard_rest_mm: f64,
    /// Path error of gentle pulls in free space, against the reference, r.m.s., the worst pull.
    pub free_path_mm: f64,
    /// The same of hard pulls.
    pub hard_path_mm: f64,
    /// Path error of the burr in bone, against the reference on the same voxels, r.m.s., the worst tunnel.
    pub drilled_path_mm: f64,
    /// Path difference between voxel grid offsets, r.m.s., the worst pair.
    pub grid_path_mm: f64,
    /// Median step time of the pulls in free space: the manipulator alone. Estimated for a scene's own tool.
    pub free_us_per_ms: f64,
    /// Median step time of the default scene, including contact and drilling.
    pub drilling_us_per_ms: f64,
}

const COLUMNS: [&str; 19] = [
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
    "rest_mm",
    "hard_rest_mm",
    "wall_path_mm",
    "free_path_mm",
    "hard_path_mm",
    "drilled_path_mm",
    "grid_path_mm",
    "free_us_per_ms",
    "drilling_us_per_ms",
];

impl Row {
    /// A row without measurements: every error counts as infinite.
    pub(super) fn unmeasured(settings: Settings) -> Row {
        Row {
            settings,
            beam: None,
            voxel_wall_mm: f64::NAN,
            rest_mm: f64::NAN,
            hard_rest_mm: f64::NAN,
            free_path_mm: f64::NAN,
            hard_path_mm: f64::NAN,
            drilled_path_mm: f64::NAN,
            grid_path_mm: f64::NAN,
            free_us_per_ms: f64::NAN,
            drilling_us_per_ms: f64::NAN,
        }
    }

    /// Position error of the burr at rest: the worst problem; the voxel problem counts only with bone.
    pub fn tip_mm(&self, load: Load) -> f64 {
        let voxel_wall_mm = if load.bone { self.voxel_wall_mm } else { 0.0 };
        let rest_mm = match load.pull {
            Pull::Gentle => self.rest_mm,
            Pull::Hard => worst(&[self.rest_mm, self.hard_rest_mm]),
        };
        worst(&[self.beam.map_or(0.0, |beam| beam.tip_mm()), voxel_wall_mm, rest_mm])
    }

    /// Path error of the burr: the worst problem. With bone, the error of the drilled paths and their
    /// dependence on the voxel grid add up.
    pub fn path_mm(&self, load: Load) -> f64 {
        let pulled = match load.pull {
            Pull::Gentle => self.free_path_mm,
            Pull::Hard => worst(&[self.free_path_mm, self.hard_path_mm]),
        };
        let free = worst(&[self.beam.map_or(0.0, |beam| beam.wall_path_mm), pulled]);
        if load.bone { worst(&[free, self.drilled_path_mm]) + worst(&[self.grid_path_mm]) } else { free }
    }

    /// Cost per simulated millisecond, µs.
    pub fn us_per_ms(&self, load: Load) -> f64 {
        if load.bone { self.drilling_us_per_ms } else { self.free_us_per_ms }
    }

    /// The errors in column order; `None` for columns that do not apply to this tool.
    fn errors(&self) -> [Option<f64>; 12] {
        [
            self.beam.map(|beam| beam.end_moment_mm),
            self.beam.map(|beam| beam.tip_force_mm),
            self.beam.map(|beam| beam.capstan_mm),
            self.beam.map(|beam| beam.wall_mm),
            Some(self.voxel_wall_mm),
            Some(self.rest_mm),
            Some(self.hard_rest_mm),
            self.beam.map(|beam| beam.wall_path_mm),
            Some(self.free_path_mm),
            Some(self.hard_path_mm),
            Some(self.drilled_path_mm),
            Some(self.grid_path_mm),
        ]
    }
}

/// The largest error; NaN counts as infinite.
pub(super) fn worst(errors: &[f64]) -> f64 {
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
        for error in row.errors() {
            // Writing to a String cannot fail.
            let _ = match error {
                Some(error) => write!(text, ",{error:.4e}"),
                None => write!(text, ","),
            };
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
    let is_beam = [5, 6, 7, 8, 12].map(|index: usize| cells.get(index).is_some_and(|cell| !cell.is_empty()));
    let beam = match is_beam {
        [false, false, false, false, false] => None,
        _ => Some(Beam {
            end_moment_mm: number(5)?,
            tip_force_mm: number(6)?,
            capstan_mm: number(7)?,
            wall_mm: number(8)?,
            wall_path_mm: number(12)?,
        }),
    };
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
        beam,
        voxel_wall_mm: number(9)?,
        rest_mm: number(10)?,
        hard_rest_mm: number(11)?,
        free_path_mm: number(13)?,
        hard_path_mm: number(14)?,
        drilled_path_mm: number(15)?,
        grid_path_mm: number(16)?,
        free_us_per_ms: number(17)?,
        drilling_us_per_ms: number(18)?,
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;
    use crate::plan::TABLE;

    const FREE: Load = Load { bone: false, pull: Pull::Gentle };

    #[test]
    fn the_table_is_read_as_it_is_written() {
        let rows = read(TABLE).unwrap();
        assert_eq!(write(&rows), TABLE);
        assert!(rows.iter().any(|row| row.path_mm(FREE).is_finite()));
    }

    #[test]
    fn what_was_lost_is_infinitely_wrong() {
        let first = read(TABLE).unwrap()[0];
        let beam = first.beam.map(|beam| Beam { wall_mm: f64::NAN, ..beam });
        let row = Row { beam, ..first };
        assert_eq!(row.tip_mm(FREE), f64::INFINITY);
        assert_eq!(read("rung,links\nplanar,4\n"), None);
    }

    /// A scene's own tool has no closed-form errors: their columns are empty and ignored; partly filled ones
    /// are malformed.
    #[test]
    fn what_is_not_of_a_tool_is_left_out() {
        let row = Row { beam: None, ..read(TABLE).unwrap()[0] };
        let text = write(&[row]);
        // Not compared as rows: unmeasured values are NaN.
        assert_eq!(write(&read(&text).unwrap()), text);
        assert_eq!((row.tip_mm(FREE), row.path_mm(FREE)), (row.rest_mm, row.free_path_mm));
        assert_eq!(read(&text.replacen("planes,,", "planes,1.0,", 1)), None);
    }
}
