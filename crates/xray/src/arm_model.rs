//! X-ray model of the arm: the closed meshes of its links, moved by the joint angles of a state.

use std::sync::Arc;

use messages::State;
use scene::closed_mesh::ClosedMesh;
use scene::{Arm, ArmMesh};

use crate::attenuation::Material;
use crate::placement::Placement;
use crate::solids::PlacedSolids;
use crate::vector::{Vec3, norm, scale};

/// The solids of an arm and the joints that move them.
#[derive(Debug, Clone)]
pub struct ArmModel {
    /// Joints from the arm's base to the flange.
    joints: Vec<Joint>,
    solids: Arc<[ClosedMesh]>,
    /// For each solid, the number of joints before its link and its pose in that link's frame.
    places: Vec<(usize, Placement)>,
    density_g_per_cm3: f64,
}

/// A joint of the chain.
#[derive(Debug, Clone, Copy)]
struct Joint {
    t_before_joint: Placement,
    /// Unit rotation axis in the joint's frame; `None` for a fixed joint.
    axis: Option<Vec3>,
}

impl ArmModel {
    /// Builds the model from the meshes that exist; `None` if X-ray frames show no part of the arm.
    pub fn new<'a>(arm: &Arm, meshes: impl IntoIterator<Item = (&'a ArmMesh, ClosedMesh)>) -> Option<Self> {
        let density_g_per_cm3 = arm.xray_density_g_per_cm3?;
        let chain = arm.joint.as_deref().unwrap_or_default();
        let joints = chain.iter().map(|joint| Joint {
            t_before_joint: placed(joint.position_mm, joint.roll_pitch_yaw_deg),
            axis: joint.axis.map(|axis| scale(axis, 1.0 / norm(axis))),
        });
        let (mut solids, mut places) = (Vec::new(), Vec::new());
        for (mesh, solid) in meshes {
            let t_link_mesh = placed(mesh.position_mm, mesh.roll_pitch_yaw_deg);
            places.push((arm.joints_before(mesh).len(), t_link_mesh));
            solids.push(solid.scaled(mesh.scale));
        }
        let model = Self { joints: joints.collect(), solids: solids.into(), places, density_g_per_cm3 };
        (!model.solids.is_empty()).then_some(model)
    }

    /// Triangles of all meshes.
    pub fn triangles(&self) -> usize {
        self.solids.iter().map(|solid| solid.triangles().len()).sum()
    }

    /// Returns the arm posed in a state. The last link ends at the flange; the joint angles lead from there
    /// back to the base.
    pub fn placed(&self, state: &State) -> PlacedSolids {
        let mut angles_rad = state.arm_joint_position_rad.iter();
        let mut t_base_link = vec![Placement::IDENTITY];
        let mut last = Placement::IDENTITY;
        for joint in &self.joints {
            last = last.then(&joint.t_before_joint);
            if let Some(axis) = joint.axis {
                last = last.turned(axis, angles_rad.next().copied().unwrap_or(0.0));
            }
            t_base_link.push(last);
        }
        let t_world_base = Placement::of_pose(&state.t_world_flange).then(&last.inverse());
        let place = |(link, t_link_mesh): &(usize, Placement)| {
            t_world_base.then(&t_base_link[*link].then(t_link_mesh))
        };
        PlacedSolids {
            solids: Arc::clone(&self.solids),
            places: self.places.iter().map(place).collect(),
            material: Material::Aluminium,
            density_g_per_cm3: self.density_g_per_cm3,
        }
    }
}

fn placed(position_mm: [f64; 3], roll_pitch_yaw_deg: [f64; 3]) -> Placement {
    Placement::of_roll_pitch_yaw(position_mm.map(|x| x * 1e-3), roll_pitch_yaw_deg.map(f64::to_radians))
}
