//! `[run]`: how time passes.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::LONGEST_RUN_S;

/// How the scene runs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Run {
    /// Lockstep: as fast as possible, every tick waits for every controller. Real time: ticks follow the wall
    /// clock.
    pub mode: Mode,
    /// Simulated time of the whole run.
    #[schemars(range(min = 0.001, max = LONGEST_RUN_S))]
    pub duration_s: f64,
    /// Time step.
    #[serde(default = "Run::default_dt_ms")]
    #[schemars(range(min = 0.1, max = 10.0))]
    pub dt_ms: f64,
    /// Real time: ticks for which a late controller's last command is held before the safe command applies.
    #[serde(default = "Run::default_hold_ticks")]
    #[schemars(range(min = 0, max = 100_000))]
    pub hold_ticks: u64,
    /// Lockstep: wall-clock time that a controller can take for one tick.
    #[serde(default = "Run::default_controller_limit_ms")]
    #[schemars(range(min = 10.0, max = 600_000.0))]
    pub controller_limit_ms: f64,
    /// Seed of all random numbers: the noise of frames.
    #[serde(default)]
    pub seed: u64,
    /// How the physics waits for its tick, and physics and controllers for each other: see docs/timing.md.
    #[serde(default)]
    pub wait: Wait,
    /// Real time: scheduling policy of physics and controllers, where the system permits it.
    #[serde(default)]
    pub policy: Policy,
}

defaults!(Run {
    default_dt_ms: f64 = 1.0,
    default_hold_ticks: u64 = 50,
    default_controller_limit_ms: f64 = 5000.0,
});

/// How time passes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// As fast as possible; every tick waits for every controller.
    Lockstep,
    /// Ticks follow the wall clock; late commands are held.
    Realtime,
}

/// How the physics waits for its tick, and physics and controllers for each other.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Wait {
    /// Busy-waits, while there are more cores than spinning processes.
    Spin,
    /// Sleeps immediately.
    Event,
    /// Polls for a short while, as long as no other process needs the core, then sleeps.
    #[default]
    Hybrid,
}

/// Scheduling policy of physics and controllers in real time, where it is permitted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Policy {
    /// As other processes, with a higher weight.
    #[default]
    Other,
    /// Ahead of all other processes (`SCHED_FIFO`).
    Fifo,
}
