//! What a run of a sweep gave.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::report::{DrillingSummary, ToolSummary};

/// How a run of a sweep ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ending {
    /// It ran for the scene's time.
    Completed,
    /// The scene with these values is refused; nothing was run.
    Refused,
    /// The physics could not go on: the state was lost.
    SimulationFailed,
    /// A part or a controller failed.
    Failed,
}

impl Ending {
    /// Its name in a table.
    pub fn name(self) -> &'static str {
        match self {
            Ending::Completed => "completed",
            Ending::Refused => "refused",
            Ending::SimulationFailed => "simulation_failed",
            Ending::Failed => "failed",
        }
    }
}

/// A row: the point, how its run ended, and its figures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Number of the point.
    pub point: u64,
    /// Keys and values that the study varied.
    pub parameters: Vec<(String, Value)>,
    /// How the run ended.
    pub outcome: Ending,
    /// Why it did not complete.
    pub reason: Option<String>,
    /// Number of ticks run.
    pub ticks: u64,
    /// Simulated time.
    pub simulated_s: f64,
    /// `State.hash` of the last state, 32 hexadecimal digits.
    pub final_hash: Option<String>,
    /// The tool; none without a state.
    pub tool: Option<ToolSummary>,
    /// Drilling and contact; none without a state.
    pub drilling: Option<DrillingSummary>,
    /// The run's log, from the sweep's folder.
    pub log: Option<PathBuf>,
    /// Command that makes the run again, as a session with its log.
    pub command: String,
}

/// Names of the figures of a row, in the order of [`Row::figures`].
pub const FIGURES: [&str; 22] = [
    "ticks",
    "simulated_s",
    "target_error_mm",
    "bend_deg",
    "max_tension_n",
    "tip_deepest_x_mm",
    "tip_deepest_y_mm",
    "tip_deepest_z_mm",
    "tip_end_x_mm",
    "tip_end_y_mm",
    "tip_end_z_mm",
    "removed_voxels",
    "removed_volume_mm3",
    "cutting_energy_j",
    "crushing_energy_j",
    "max_burr_force_n",
    "max_contact_force_n",
    "max_wall_force_n",
    "max_flange_force_n",
    "max_stop_excess_deg",
    "max_contacts",
    "contact_share",
];

impl Row {
    /// The figures by [`FIGURES`]; those of [`ToolSummary`] and [`DrillingSummary`] mean what they mean in `summary.json`.
    pub fn figures(&self) -> [Option<f64>; FIGURES.len()] {
        let (tool, drilling) = (self.tool.as_ref(), self.drilling.as_ref());
        let place = |of: fn(&ToolSummary) -> [f64; 3], axis: usize| tool.map(|tool| of(tool)[axis]);
        let deepest = |axis| place(|tool| tool.tip_deepest_mm, axis);
        let end = |axis| place(|tool| tool.tip_end_mm, axis);
        [
            Some(self.ticks as f64),
            Some(self.simulated_s),
            tool.and_then(|tool| tool.target_error_mm),
            tool.map(|tool| tool.bend_deg),
            tool.map(|tool| tool.max_tension_n),
            deepest(0),
            deepest(1),
            deepest(2),
            end(0),
            end(1),
            end(2),
            drilling.map(|drilling| drilling.removed_voxels as f64),
            drilling.and_then(|drilling| drilling.removed_volume_mm3),
            drilling.map(|drilling| drilling.cutting_energy_j),
            drilling.map(|drilling| drilling.crushing_energy_j),
            drilling.map(|drilling| drilling.max_burr_force_n),
            drilling.map(|drilling| drilling.max_contact_force_n),
            drilling.map(|drilling| drilling.max_wall_force_n),
            drilling.map(|drilling| drilling.max_flange_force_n),
            drilling.map(|drilling| drilling.max_stop_excess_deg),
            drilling.map(|drilling| f64::from(drilling.max_contacts)),
            drilling.map(|drilling| drilling.contact_share),
        ]
    }

    /// The figure of this name, if the row has it.
    pub fn figure(&self, name: &str) -> Option<f64> {
        let index = FIGURES.iter().position(|figure| *figure == name)?;
        self.figures()[index]
    }

    /// A parameter.
    pub fn value(&self, key: &str) -> Option<&Value> {
        self.parameters.iter().find(|(name, _)| name == key).map(|(_, value)| value)
    }

    /// A parameter as a number, if it is one.
    pub fn parameter(&self, key: &str) -> Option<f64> {
        self.value(key)?.as_f64()
    }
}
