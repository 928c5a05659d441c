//! Result row of a sweep's run.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::report::{DrillingSummary, PlanSummary, StructureSummary, ToolSummary};

/// How a run of a sweep ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ending {
    /// The run reached the scene's duration.
    Completed,
    /// The scene with these values was rejected; nothing was run.
    Refused,
    /// The physics could not continue.
    SimulationFailed,
    /// A part or a controller failed.
    Failed,
}

impl Ending {
    /// Returns its name in a table.
    pub fn name(self) -> &'static str {
        match self {
            Ending::Completed => "completed",
            Ending::Refused => "refused",
            Ending::SimulationFailed => "simulation_failed",
            Ending::Failed => "failed",
        }
    }
}

/// A row: the point, how its run ended, and its results.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Row {
    pub point: u64,
    /// Keys and values that the study varied.
    pub parameters: Vec<(String, Value)>,
    pub outcome: Ending,
    pub reason: Option<String>,
    pub ticks: u64,
    pub simulated_s: f64,
    /// `State.hash` of the last state, 32 hexadecimal digits.
    pub final_hash: Option<String>,
    pub tool: Option<ToolSummary>,
    pub drilling: Option<DrillingSummary>,
    #[serde(default)]
    pub plan: Option<PlanSummary>,
    /// Clearance of each critical structure.
    #[serde(default)]
    pub structures: Vec<StructureSummary>,
    /// Number of breaches of the bone.
    #[serde(default)]
    pub breaches: u64,
    /// Path of the run's log relative to the sweep's folder.
    pub log: Option<PathBuf>,
    /// Command that repeats the run as a session with a log.
    pub command: String,
}

/// A result of a row: its name, and its value if the row has it.
type Figure = (&'static str, fn(&Row) -> Option<f64>);

/// The results of a row; those of [`ToolSummary`], [`PlanSummary`] and
/// [`DrillingSummary`] are defined as in `summary.json`.
pub const FIGURES: [Figure; 30] = [
    ("ticks", |row| Some(row.ticks as f64)),
    ("simulated_s", |row| Some(row.simulated_s)),
    ("target_error_mm", |row| row.tool.as_ref()?.target_error_mm),
    ("path_deviation_mm", |row| row.plan.as_ref()?.path_deviation_mm),
    ("least_radius_mm", |row| row.plan.as_ref()?.least_radius_mm),
    ("bend_deg", |row| Some(row.tool.as_ref()?.bend_deg)),
    ("max_tension_n", |row| Some(row.tool.as_ref()?.max_tension_n)),
    ("tip_deepest_x_mm", |row| Some(row.tool.as_ref()?.tip_deepest_mm[0])),
    ("tip_deepest_y_mm", |row| Some(row.tool.as_ref()?.tip_deepest_mm[1])),
    ("tip_deepest_z_mm", |row| Some(row.tool.as_ref()?.tip_deepest_mm[2])),
    ("tip_end_x_mm", |row| Some(row.tool.as_ref()?.tip_end_mm[0])),
    ("tip_end_y_mm", |row| Some(row.tool.as_ref()?.tip_end_mm[1])),
    ("tip_end_z_mm", |row| Some(row.tool.as_ref()?.tip_end_mm[2])),
    ("removed_voxels", |row| Some(row.drilling.as_ref()?.removed_voxels as f64)),
    ("removed_volume_mm3", |row| row.drilling.as_ref()?.removed_volume_mm3),
    ("cutting_energy_j", |row| Some(row.drilling.as_ref()?.cutting_energy_j)),
    ("crushing_energy_j", |row| Some(row.drilling.as_ref()?.crushing_energy_j)),
    ("max_burr_force_n", |row| Some(row.drilling.as_ref()?.max_burr_force_n)),
    ("max_contact_force_n", |row| Some(row.drilling.as_ref()?.max_contact_force_n)),
    ("max_wall_force_n", |row| Some(row.drilling.as_ref()?.max_wall_force_n)),
    ("max_flange_force_n", |row| Some(row.drilling.as_ref()?.max_flange_force_n)),
    ("max_stop_excess_deg", |row| Some(row.drilling.as_ref()?.max_stop_excess_deg)),
    ("max_contacts", |row| Some(f64::from(row.drilling.as_ref()?.max_contacts))),
    ("least_clearance_mm", |row| {
        row.structures.iter().filter_map(|structure| structure.least_clearance_mm).reduce(f64::min)
    }),
    ("structure_removed_mm3", |row| {
        let avoided = row.structures.iter().filter(|structure| !structure.is_target);
        avoided.filter_map(|structure| structure.removed_mm3).reduce(|a, b| a + b)
    }),
    ("target_removed_share", |row| {
        row.structures.iter().filter_map(|structure| structure.removed_share).reduce(f64::min)
    }),
    ("healthy_removed_mm3", |row| row.drilling.as_ref()?.healthy_removed_mm3),
    ("breach_area_mm2", |row| row.drilling.as_ref()?.breach_area_mm2),
    ("breaches", |row| row.plan.as_ref().map(|_| row.breaches as f64)),
    ("contact_share", |row| Some(row.drilling.as_ref()?.contact_share)),
];

impl Row {
    /// Returns the result of this name if the row has it.
    pub fn figure(&self, name: &str) -> Option<f64> {
        FIGURES.iter().find(|(figure, _)| *figure == name).and_then(|(_, of)| of(self))
    }

    /// Returns a parameter.
    pub fn value(&self, key: &str) -> Option<&Value> {
        self.parameters.iter().find(|(name, _)| name == key).map(|(_, value)| value)
    }

    /// Returns a parameter as a number if it is one.
    pub fn parameter(&self, key: &str) -> Option<f64> {
        self.value(key)?.as_f64()
    }
}
