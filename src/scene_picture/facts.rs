//! Measurements of a scene before its run.

use ipc_types::scene::Scene;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use serde_json::{Value, json};
use simulation::arm::{ArmParameters, Redundancy, initial_q_rad, place_base_for};
use simulation::{CtView, Verdict, findings};
use voxel_grid::Volume;

use super::metres;
use super::scale::Scale;
use super::shape::{Shapes, length};
use super::surroundings::Surroundings;
use crate::failure::Failure;
use crate::feasibility::is_program;
use crate::prediction::Prediction;

/// How far in front of a path that begins in bone its entry is searched, mm.
const BEFORE_MM: f64 = 100.0;
/// Maximum feed of the arm that is checked, and the step, mm.
const FEED_MM: u32 = 400;
const FEED_STEP_MM: u32 = 2;

/// A sample of Hounsfield units on the path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Distance along the path from its start, mm; negative before it.
    pub along_mm: f64,
    pub place_mm: Vector3<f64>,
    /// Hounsfield units; `None` outside the volume.
    pub hu: Option<f64>,
}

/// Measurements of a scene.
#[derive(Debug, Clone)]
pub struct Facts {
    /// Hounsfield units along the path.
    pub profile: Vec<Sample>,
    /// Lengths that follow from the volume.
    pub scale: Scale,
    /// Where the path enters bone; on its straight extension if it begins inside bone.
    pub entry: Option<Sample>,
    pub start: Sample,
    /// The end of the path.
    pub target: Sample,
    /// Length of the path after its entry in voxels at or above the threshold, mm.
    pub in_bone_mm: f64,
    /// Distance from the target to the nearest point outside the bone, mm.
    pub depth_mm: f64,
    /// Length of bone beyond the target in the direction of the path, mm.
    pub ahead_mm: f64,
    /// How far the arm can feed from the start, mm; at most `FEED_MM`.
    pub feed_mm: f64,
    /// Findings of `scene check` and of the prediction, errors included.
    pub findings: Vec<String>,
}

impl Facts {
    /// Measures a scene; `surroundings` are computed from its volume and shared by many measurements.
    pub fn of(
        scene: &Scene,
        volume: &Volume,
        surroundings: &Surroundings<'_>,
        shapes: &Shapes,
    ) -> Result<Facts, Failure> {
        let threshold_hu = scene.volume.as_ref().map_or(0, |volume| volume.bone_threshold_hu);
        let is_bone = |sample: &Sample| sample.hu.is_some_and(|hu| hu >= f64::from(threshold_hu));
        let scale = Scale::of(&volume.grid);
        let profile = profile(volume, shapes, scale.step_mm, is_bone);
        let nearest = |point: &Vector3<f64>| {
            let by = |sample: &&Sample| (sample.place_mm - point).norm_squared();
            let found = profile.iter().min_by(|a, b| by(a).total_cmp(&by(b)));
            found.copied().unwrap_or(Sample { along_mm: 0.0, place_mm: *point, hu: None })
        };
        let (start, target) = (nearest(&shapes.start_mm), nearest(&shapes.target_mm()));
        let entry = profile.iter().find(|sample| is_bone(sample)).copied();
        let in_bone = profile.iter().filter(|sample| is_bone(sample)).count();
        let found = findings(scene, Some(CtView::from(volume)), &is_program).map_err(Failure::bad_input)?;
        let word = |verdict| if verdict == Verdict::Impossible { "error" } else { "warning" };
        Ok(Facts {
            scale,
            entry,
            start,
            target,
            in_bone_mm: in_bone as f64 * scale.step_mm,
            depth_mm: surroundings.depth_mm(&shapes.target_mm()),
            ahead_mm: surroundings.ahead_mm(&shapes.target_mm(), &shapes.last_direction()),
            feed_mm: feed_mm(scene, shapes),
            findings: found.iter().map(|finding| format!("{}: {finding}", word(finding.verdict))).collect(),
            profile,
        })
    }

    /// Adds the findings of a prediction.
    pub fn with(mut self, prediction: Option<&Prediction>) -> Facts {
        let found = prediction.iter().flat_map(|prediction| &prediction.findings);
        self.findings.extend(found.map(|finding| format!("warning: predicted: {finding}")));
        self.findings.extend(prediction.iter().flat_map(|prediction| prediction.notes.clone()));
        self
    }

    /// Returns the minimum, mean and maximum Hounsfield units from entry to target, or `None` if the path
    /// meets no bone.
    pub fn hu_range(&self) -> Option<[f64; 3]> {
        let entry = self.entry?;
        let behind = self.profile.iter().filter(|sample| sample.along_mm >= entry.along_mm);
        let values: Vec<f64> = behind.filter_map(|sample| sample.hu).collect();
        let sum: f64 = values.iter().sum();
        let least = values.iter().copied().fold(f64::INFINITY, f64::min);
        let most = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        (!values.is_empty()).then(|| [least, sum / values.len() as f64, most])
    }

    /// Says where the entry is, if it is not where the path begins.
    pub fn entry_note(&self) -> Option<String> {
        let (along_mm, decimals) = (self.entry?.along_mm, self.scale.decimals());
        if along_mm < 0.0 {
            let inside_mm = -along_mm;
            return Some(format!(
                "on the straight extension of the path, which begins {inside_mm:.decimals$} mm inside bone"
            ));
        }
        let is_elsewhere = along_mm > self.scale.step_mm;
        is_elsewhere.then(|| format!("{along_mm:.decimals$} mm after the first point of the path"))
    }

    /// Returns the measurements as JSON.
    pub fn json(&self, shapes: &Shapes) -> Value {
        let place = |sample: &Sample| json!({"place_mm": sample.place_mm.as_slice(), "along_mm": sample.along_mm, "hu": sample.hu});
        let range = self.hu_range();
        json!({
            "is_planned": shapes.is_planned,
            "entry": self.entry.as_ref().map(place),
            "burr_start": place(&self.start),
            "target": place(&self.target),
            "path_mm": length(&shapes.path_mm),
            "insertion_mm": shapes.insertion_mm,
            "in_bone_mm": self.in_bone_mm,
            "least_hu": range.map(|it| it[0]),
            "mean_hu": range.map(|it| it[1]),
            "most_hu": range.map(|it| it[2]),
            "target_depth_mm": self.depth_mm,
            "bone_ahead_mm": self.ahead_mm,
            "arm_feed_mm": self.feed_mm,
            "findings": self.findings,
        })
    }
}

/// Samples Hounsfield units along the path; if the path begins in bone, starts where that bone begins.
fn profile(volume: &Volume, shapes: &Shapes, step_mm: f64, is_bone: impl Fn(&Sample) -> bool) -> Vec<Sample> {
    let sample = |along_mm: f64, place_mm: Vector3<f64>| Sample {
        along_mm,
        place_mm,
        hu: volume.hu_at(metres(place_mm.into())),
    };
    let begin = shapes.path_mm.first().copied().unwrap_or(shapes.start_mm);
    let mut before = Vec::new();
    let mut far_mm = 0.0;
    let mut last = sample(0.0, begin);
    while is_bone(&last) && far_mm < BEFORE_MM {
        far_mm += step_mm;
        last = sample(-far_mm, begin - shapes.along * far_mm);
        before.push(last);
    }
    before.reverse();
    let mut passed_mm = 0.0;
    before.push(sample(0.0, begin));
    for piece in shapes.path_mm.windows(2) {
        let way = piece[1] - piece[0];
        let piece_mm = way.norm();
        let count = (piece_mm / step_mm).round().max(1.0);
        before.extend((1..=count as usize).map(|step| {
            let share = step as f64 / count;
            sample(passed_mm + share * piece_mm, piece[0] + way * share)
        }));
        passed_mm += piece_mm;
    }
    before
}

/// Returns how far the arm can feed the tool's base straight ahead from the start, by inverse kinematics and
/// joint limits.
fn feed_mm(scene: &Scene, shapes: &Shapes) -> f64 {
    let arm = ArmParameters::of(&scene.arm, scene.dt_s());
    let joints = initial_q_rad(&scene.arm);
    let limits = &arm.joint_limits;
    let across = shapes.along.cross(&shapes.toward);
    let axes = Matrix3::from_columns(&[shapes.toward, across, shapes.along]);
    let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let base = |feed_mm: f64| {
        let place_mm = shapes.start_mm + shapes.along * (feed_mm - shapes.tool_mm);
        Isometry3::from_parts(Translation3::from(place_mm * 1e-3), turn)
    };
    let t_arm_world = place_base_for(&arm.geometry, &base(0.0), &joints).inverse();
    let (mut reached_mm, mut near) = (0, joints);
    for feed_mm in (FEED_STEP_MM..=FEED_MM).step_by(FEED_STEP_MM as usize) {
        let goal = t_arm_world * base(f64::from(feed_mm));
        let [lower_rad, upper_rad] = [&limits.lower_rad, &limits.upper_rad];
        let found = arm.geometry.inverse_nearest(&goal, &near, lower_rad, upper_rad, Redundancy::Held);
        let Ok(found) = found else { break };
        (reached_mm, near) = (feed_mm, found);
    }
    f64::from(reached_mm)
}
