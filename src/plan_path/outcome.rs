//! What the simulated run of a candidate would do.

use ipc_types::scene::{BuiltInStructure, Scene, StructureRole};
use serde::Serialize;

use super::offsets::drilling;
use crate::prediction::{Prediction, Reach};
use crate::report::StructureSummary;
use crate::report::outcome::reached_target;

/// Share of the bone of each target region that a plan must remove.
const TARGET_SHARE: f64 = 0.5;

/// Why a plan is not one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Fault {
    /// The scene is bad input: for example, the arm would be in bone.
    Refused,
    /// The simulation failed.
    Failed,
    /// The arm makes a protective stop.
    Stop,
    /// The tool leaves the bone or enters a structure.
    Breach,
    /// The burr misses the target, or leaves most of a target region.
    Miss,
}

impl Fault {
    /// Returns what `count` candidates with this fault do.
    pub fn verb(self, count: usize) -> &'static str {
        let [one, more] = match self {
            Fault::Refused => ["is refused", "are refused"],
            Fault::Failed => ["fails", "fail"],
            Fault::Stop => ["stops the arm", "stop the arm"],
            Fault::Breach => ["breaches", "breach"],
            Fault::Miss => ["misses the target", "miss the target"],
        };
        if count == 1 { one } else { more }
    }
}

/// What a simulated run did.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Outcome {
    /// Least clearance from the structures to avoid.
    pub clearance_mm: Option<f64>,
    /// Volume of the bone removed, without pilot holes and target regions.
    pub bone_removed_mm3: f64,
    /// Distance of the burr from its target.
    pub target_error_mm: Option<f64>,
    /// Least share removed of a target region.
    pub target_removed_share: Option<f64>,
    /// Whether the tool left the bone or entered a structure.
    pub is_breached: bool,
    /// Whether the target was missed.
    pub is_missed: bool,
    /// What is wrong with it first.
    pub fault: Option<Fault>,
    /// Why a scene was refused or its simulation failed.
    pub reason: Option<String>,
}

impl Outcome {
    /// Returns the outcome of a scene that is not run.
    pub fn refused(reason: String) -> Outcome {
        Outcome { is_missed: true, fault: Some(Fault::Refused), reason: Some(reason), ..Outcome::default() }
    }

    /// Returns the outcome of a predicted run.
    pub fn of(scene: &Scene, prediction: &Prediction) -> Outcome {
        let course = &prediction.course;
        let structures = course.clearances.summaries();
        let clearance_mm = clearance_mm(scene, structures);
        let share = structures.iter().filter_map(|structure| structure.removed_share).reduce(f64::min);
        let has_point = drilling(scene).is_some_and(|plan| plan.target_mm.is_some());
        let reason = match &prediction.reach {
            Reach::Failed(cause) => Some(cause.clone()),
            _ => None,
        };
        let is_breached = course.breach_count > 0 || clearance_mm.is_some_and(|least_mm| least_mm < 0.0);
        let is_missed = reason.is_some()
            || (has_point && !reached_target(scene, course))
            || share.is_some_and(|share| share < TARGET_SHARE);
        let faults = [
            (reason.is_some(), Fault::Failed),
            (course.plan().protective_stops > 0, Fault::Stop),
            (is_breached, Fault::Breach),
            (is_missed, Fault::Miss),
        ];
        let removed = course.drilling();
        Outcome {
            clearance_mm,
            bone_removed_mm3: removed
                .and_then(|removed| removed.healthy_removed_mm3.or(removed.removed_volume_mm3))
                .unwrap_or(0.0),
            target_error_mm: course.tool().and_then(|tool| tool.target_error_mm),
            target_removed_share: share,
            is_breached,
            is_missed,
            fault: faults.into_iter().find(|(is_so, _)| *is_so).map(|(_, fault)| fault),
            reason,
        }
    }

    /// Returns whether the simulation got to its end.
    pub fn has_result(&self) -> bool {
        !matches!(self.fault, Some(Fault::Refused | Fault::Failed))
    }

    /// Returns the objectives, both to be minimised; `None` if it is not a plan.
    pub fn objectives(&self) -> Option<[f64; 2]> {
        let clearance_mm = self.clearance_mm.filter(|_| self.fault.is_none())?;
        Some([-clearance_mm, self.bone_removed_mm3])
    }
}

/// Returns the least clearance from the structures to avoid. The tool comes in through the outside of the
/// bone, where its clearance begins at the margin: beyond it, it counts only if there is nothing else.
fn clearance_mm(scene: &Scene, structures: &[StructureSummary]) -> Option<f64> {
    let avoided = scene.structure.iter().zip(structures);
    let avoided = avoided.filter(|(structure, _)| structure.role == StructureRole::Avoid);
    let (mut least_mm, mut kept_mm) = (f64::INFINITY, f64::INFINITY);
    for (structure, found) in avoided {
        let Some(clearance_mm) = found.least_clearance_mm else { continue };
        let is_entrance =
            matches!(structure.built_in, Some(BuiltInStructure::OutsideOfBone | BuiltInStructure::Cortex));
        if is_entrance && clearance_mm >= structure.margin_mm {
            kept_mm = kept_mm.min(structure.margin_mm);
        } else {
            least_mm = least_mm.min(clearance_mm);
        }
    }
    let found_mm = if least_mm.is_finite() { least_mm } else { kept_mm };
    found_mm.is_finite().then_some(found_mm)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn an_entrance_counts_up_to_its_margin() {
        let scene = |structures: &str| {
            let text = "name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n\
                        [volume]\nphantom = \"block\"\n\
                        [tool]\nburr_start_mm = [0.0, 0.0, -40.0]\ndirection = [0.0, 0.0, 1.0]\n\
                        bend_toward = [1.0, 0.0, 0.0]\n";
            Scene::parse(&format!("{text}{structures}"), Path::new("a.toml")).unwrap()
        };
        let nerve =
            "[[structure]]\nname = \"nerve\"\nball = { centre_mm = [9.0, 0.0, 0.0], radius_mm = 1.0 }\n";
        let target = "[[structure]]\nname = \"tumour\"\nrole = \"target\"\n\
                      ball = { centre_mm = [0.0, 0.0, 0.0], radius_mm = 1.0 }\n";
        let outside = "[[structure]]\nname = \"out\"\nmargin_mm = 3.0\nbuilt_in = \"outside_of_bone\"\n";
        let found = |structures: &str, clearances: &[f64]| {
            let summary = |least_mm: &f64| StructureSummary {
                name: String::new(),
                margin_mm: 2.0,
                least_clearance_mm: Some(*least_mm),
                tick: 0,
                ticks_within_margin: 0,
                ticks_inside: 0,
                is_target: false,
                removed_mm3: None,
                removed_share: None,
            };
            clearance_mm(&scene(structures), &clearances.iter().map(summary).collect::<Vec<_>>())
        };
        assert_eq!(found(&format!("{nerve}{outside}"), &[5.0, 3.02]), Some(5.0));
        assert_eq!(found(&format!("{nerve}{outside}"), &[5.0, 2.5]), Some(2.5));
        assert_eq!(found(outside, &[3.02]), Some(3.0));
        assert_eq!(found(outside, &[-1.0]), Some(-1.0));
        assert_eq!(found(target, &[-1.0]), None);
    }
}
