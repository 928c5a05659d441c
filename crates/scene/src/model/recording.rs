//! `[recording]`: what a run records.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What is recorded.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Recording {
    /// X-ray frames: complete; only their geometry and hash, from which they can be rendered again; or
    /// nothing.
    pub images: Images,
    /// Simulated time between two keyframes, from which a replay can start; 0: no keyframes.
    #[schemars(extend("anyOf" = [{"const": 0.0}, {"minimum": 0.01, "maximum": 3600.0}]))]
    pub keyframe_interval_s: f64,
    /// With `images = "full"`, records the image of every Nth frame; of the others the hash.
    #[schemars(range(min = 1, max = 1_000_000))]
    pub image_every: u64,
    /// Real time: what happens when the recorder's queues would overflow. Either the log gets a gap, which
    /// the run reports and for which it ends with exit code 3; or the physics waits, and its ticks are late.
    /// Lockstep always waits.
    pub on_full: OnFull,
    /// Keeps only the last seconds of a long run, at least this many of simulated time, and at each trigger
    /// saves them and what follows as a log of its own; 0: keeps everything. See docs/logs.md.
    #[schemars(extend("anyOf" = [{"const": 0.0}, {"minimum": 1.0, "maximum": 3600.0}]))]
    pub ring_s: f64,
    /// Simulated time that a log saved from the ring contains after its trigger, at least.
    #[schemars(range(min = 0.0, max = 3600.0))]
    pub after_s: f64,
    /// What saves the ring: an event by its code (`"breach"`, `"controller"` for a controller's remark), a
    /// tick that began late (`"missed_tick"`, or by its main cause: `"missed_tick:run_queue"`), a field of
    /// the state beyond a value (`"burr_force_n > 20"`).
    pub triggers: Vec<String>,
    /// Largest number of logs that triggers save; later triggers are only reported.
    #[schemars(range(min = 1, max = 10_000))]
    pub saved_at_most: u64,
}

impl Recording {
    /// Whether the image of a frame (`Frame.sequence`, from 1) is recorded.
    pub fn keeps_image(&self, sequence: u64) -> bool {
        self.images == Images::Full && sequence.saturating_sub(1).is_multiple_of(self.image_every.max(1))
    }
}

impl Default for Recording {
    fn default() -> Self {
        // Real time is about ticks on schedule: a gap costs only the log, but a wait is felt at the tool.
        Recording {
            images: Images::Full,
            keyframe_interval_s: 2.0,
            image_every: 1,
            on_full: OnFull::Gap,
            ring_s: 0.0,
            after_s: 1.0,
            triggers: Vec::new(),
            saved_at_most: 100,
        }
    }
}

/// Which frames are recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Images {
    /// All, complete.
    Full,
    /// Only their geometry and hash: they can be rendered again.
    HashOnly,
    /// None, and no hash either.
    None,
}

/// What happens when the recorder's queues would overflow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnFull {
    /// The physics waits.
    Wait,
    /// The log has a gap.
    Gap,
}
