//! The simulated world where it differs from what the plan and the controllers assume.

use markups::vector::{cross, dot, length, minus, plus};

use crate::{
    Contact, Drilling, Manipulator, ManipulatorRung, Scene, TrueManipulator, Truth, planned_path_mm,
};

impl Scene {
    /// The true scene: the values of `[truth]` replace those that the plan and the controllers assume, and
    /// `[truth]` itself is removed. For the bone's position see [`Scene::in_bone_mm`].
    pub fn as_it_is(&self) -> Scene {
        let mut scene = self.clone();
        if let Some(truth) = scene.truth.take() {
            manipulator(&mut scene.manipulator, &truth.manipulator);
            contact(&mut scene.contact, &truth.contact);
            drilling(&mut scene.drilling, &truth.drilling);
        }
        scene
    }

    /// True position of a point fixed to the bone, mm, LPS; `point_mm` is its position in the plan.
    pub fn in_bone_mm(&self, point_mm: [f64; 3]) -> [f64; 3] {
        let Some(truth) = &self.truth else { return point_mm };
        let start_mm = self.tool.burr_start_mm;
        let turned = self.turned_with_bone(minus(point_mm, start_mm));
        plus(plus(start_mm, 1.0, turned), 1.0, truth.registration_error_mm)
    }

    /// Rotates a direction of the plan with the true bone.
    pub fn turned_with_bone(&self, direction: [f64; 3]) -> [f64; 3] {
        self.truth.as_ref().map_or(direction, |truth| turned(direction, truth.registration_error_deg))
    }

    /// Whether the true bone lies where that of another scene lies.
    pub fn has_bone_pose_of(&self, other: &Scene) -> bool {
        let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        self.in_bone_mm([0.0; 3]) == other.in_bone_mm([0.0; 3])
            && axes.iter().all(|axis| self.turned_with_bone(*axis) == other.turned_with_bone(*axis))
    }

    /// Whether another scene differs from this one at most in `[truth]`.
    pub fn differs_only_in_truth(&self, other: &Scene) -> bool {
        let [mut here, mut there] = [self.clone(), other.clone()];
        (here.truth, there.truth) = (None, None);
        here == there
    }

    /// Returns the first key by which the state of a simulation of `other`, which differs only in `[truth]`,
    /// means something else in this scene or has another number of entries; `None` if this scene can go on
    /// from it.
    pub fn state_mismatch(&self, other: &Scene) -> Option<&'static str> {
        let [here, there] = [self.as_it_is(), other.as_it_is()];
        let is_modal = here.manipulator.model == Some(ManipulatorRung::Modal);
        let is_stalling = |scene: &Scene| scene.manipulator.burr_stall_torque_nmm.is_some();
        let stiffness = |scene: &Scene| scene.manipulator.stiffness_scale.unwrap_or(1.0);
        let has_side_force = |scene: &Scene| scene.drilling.side_force.unwrap_or(false);
        [
            // The drilled voxels are those of the bone where it lies.
            (!self.has_bone_pose_of(other), "truth.registration_error_mm` or `truth.registration_error_deg"),
            (is_stalling(&here) != is_stalling(&there), "truth.manipulator.burr_stall_torque_nmm"),
            (has_side_force(&here) != has_side_force(&there), "truth.drilling.side_force"),
            // The square of an amplitude is an energy.
            (is_modal && stiffness(&here) != stiffness(&there), "truth.manipulator.stiffness_scale"),
        ]
        .into_iter()
        .find_map(|(differs, key)| differs.then_some(key))
    }

    /// Whether the bone's true pose differs from the plan.
    pub fn has_registration_error(&self) -> bool {
        let moves = |truth: &Truth| {
            [truth.registration_error_mm, truth.registration_error_deg].iter().flatten().any(|x| *x != 0.0)
        };
        self.truth.as_ref().is_some_and(moves)
    }
}

/// The path of [`planned_path_mm`] at its true position in the bone, against which a run is evaluated.
pub fn planned_path_in_bone_mm(scene: &Scene) -> Option<Vec<[f64; 3]>> {
    let path = planned_path_mm(scene)?;
    Some(path.into_iter().map(|point_mm| scene.in_bone_mm(point_mm)).collect())
}

/// Rodrigues' formula. Sine and cosine come from `libm`, identical on every machine: the bone's pose enters
/// the hash of a run.
fn turned(vector: [f64; 3], rotation_vector_deg: [f64; 3]) -> [f64; 3] {
    let angle_deg = length(rotation_vector_deg);
    if angle_deg == 0.0 {
        return vector;
    }
    let axis = rotation_vector_deg.map(|x| x / angle_deg);
    let angle_rad = angle_deg.to_radians();
    let (sine, cosine) = (libm::sin(angle_rad), libm::cos(angle_rad));
    let along = dot(axis, vector);
    let across = cross(axis, vector);
    plus(plus(vector.map(|x| cosine * x), sine, across), along * (1.0 - cosine), axis)
}

/// Copies the keys that are set. Destructures the table, so that a new key cannot be forgotten here.
macro_rules! put {
    ($into:expr, $table:ident { $($key:ident),+ $(,)? } = $given:expr) => {{
        let $table { $($key),+ } = $given;
        $(if $key.is_some() {
            $into.$key.clone_from($key);
        })+
    }};
}

fn manipulator(into: &mut Manipulator, given: &TrueManipulator) {
    put!(
        into,
        TrueManipulator {
            stiffness_scale,
            mass_scale,
            damping_ratio,
            tendon_friction,
            mount_stiffness_n_per_m,
            lateral_stiffness_ratio,
            torsion_stiffness_ratio,
            burr_stall_torque_nmm,
        } = given
    );
}

fn contact(into: &mut Contact, given: &Contact) {
    put!(into, Contact { friction, stiffness_n_per_m, strength_mpa, strength_exponent, voxels } = given);
}

fn drilling(into: &mut Drilling, given: &Drilling) {
    put!(
        into,
        Drilling {
            law,
            specific_energy_j_per_mm3,
            density_exponent,
            cutting_coefficient,
            edge_pressure_mpa,
            edge_force_n_per_mm,
            edge_exponent,
            reach_mm,
            feed_per_revolution_mm,
            side_force,
            removal,
        } = given
    );
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by it")]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::SceneError;
    use crate::declaration::SCENE;

    const TEXT: &str = "name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[volume]\nphantom \
                        = \"block\"\n\
        [drilling]\nedge_pressure_mpa = 1.0\nedge_exponent = 2.0\n\
        [tool]\nburr_start_mm = [1.0, 2.0, 3.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, \
        0.0]\n";

    fn scene(truth: &str) -> Result<Scene, SceneError> {
        Scene::parse(&format!("{TEXT}{truth}"), Path::new("a.toml"))
    }

    #[test]
    fn keys_of_the_truth_take_the_place_of_what_is_believed_and_no_others() {
        let believed =
            scene("[truth.manipulator]\nstiffness_scale = 0.8\n[truth.drilling]\nedge_pressure_mpa = 3.0\n")
                .unwrap();
        let mut expected = scene("[manipulator]\nstiffness_scale = 0.8\n").unwrap();
        expected.drilling.edge_pressure_mpa = Some(3.0);
        assert_eq!(believed.as_it_is(), expected);
        assert_eq!(believed.drilling.edge_pressure_mpa, Some(1.0));
        assert_eq!(scene("").unwrap().as_it_is(), scene("").unwrap());
    }

    /// A quarter turn about z through the burr's start, and a shift.
    #[test]
    fn the_bone_is_turned_about_the_start_and_moved() {
        let scene = scene(
            "[truth]\nregistration_error_mm = [0.5, 0.0, 0.0]\nregistration_error_deg = [0.0, 0.0, 90.0]\n",
        )
        .unwrap();
        let placed = scene.in_bone_mm([11.0, 2.0, 4.0]);
        let expected = [1.5, 12.0, 4.0];
        assert!(length(minus(placed, expected)) < 1e-12, "{placed:?}");
        assert_eq!(scene.turned_with_bone([0.0, 0.0, 1.0]), [0.0, 0.0, 1.0]);
        assert!(scene.has_registration_error());
    }

    /// Rodrigues' rotation preserves lengths, and its trace is 1 + 2 cos of the angle.
    #[test]
    fn a_turn_about_any_axis_is_a_rotation_by_its_angle() {
        let vector = [3.0, -4.0, 12.0];
        let columns = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|axis| turned(axis, vector));
        let trace: f64 = (0..3).map(|i| columns[i][i]).sum();
        assert!((trace - (1.0 + 2.0 * 13.0_f64.to_radians().cos())).abs() < 1e-14);
        let determinant = dot(cross(columns[0], columns[1]), columns[2]);
        assert!((determinant - 1.0).abs() < 1e-14);
        assert!(length(minus(turned(vector, vector), vector)) < 1e-14);
    }

    #[test]
    fn a_truth_out_of_range_or_that_contradicts_itself_is_refused_by_its_key() {
        for (truth, key) in [
            ("[truth.manipulator]\nstiffness_scale = 0.0\n", "truth.manipulator.stiffness_scale"),
            ("[truth]\nregistration_error_mm = [0.0, 200.0, 0.0]\n", "truth.registration_error_mm[1]"),
            ("[truth.manipulator]\nlinks = 5\n", "links"),
            ("[truth.drilling]\nedge_force_n_per_mm = 3.0\n", "truth.drilling.edge_force_n_per_mm"),
        ] {
            let refused = scene(truth).unwrap_err().to_string();
            assert!(refused.contains(key), "{refused}");
        }
        let without = TEXT.replace("[volume]\nphantom = \"block\"\n", "");
        let moved = format!("{without}[truth]\nregistration_error_mm = [0.0, 1.0, 0.0]\n");
        let refused = Scene::parse(&moved, Path::new("a.toml")).unwrap_err().to_string();
        assert!(refused.contains("`truth.registration_error_mm`"), "{refused}");
    }

    #[test]
    fn a_key_of_the_true_tool_has_the_range_of_its_namesake() {
        let truth = SCENE.kind("truth.manipulator").and_then(|kind| kind.table()).unwrap();
        assert!(truth.keys.len() >= 8);
        for key in &truth.keys {
            let [own, believed] = ["truth.manipulator", "manipulator"].map(|table| {
                SCENE
                    .kind(&format!("{table}.{}", key.name))
                    .and_then(|kind| kind.range())
                    .map(|range| [range.lowest, range.highest])
            });
            assert_eq!(own, believed, "{}", key.name);
        }
    }
}
