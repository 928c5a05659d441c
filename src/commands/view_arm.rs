//! The arm as the page draws it.

use ipc_types::arm_meshes::{self, ArmMeshError, LoadedMesh};
use ipc_types::messages::Pose;
use ipc_types::scene::{Arm, ArmMesh, Scene};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use simulation::arm::{ArmGeometry, ArmParameters, Joints, LinkFrames};
use simulation::pose;
use viewer_proc::ArmMeshes;
use viewer_proc::surface::link_mesh;

/// Returns the geometry of a scene's arm without its tool; the last frame is the flange.
fn geometry(scene: &Scene) -> ArmGeometry {
    ArmParameters::of(&scene.arm, scene.dt_s()).geometry.with_tool(None)
}

/// Returns the parts of the arm between its joints, for `ToolShape::arm_parts`.
pub fn arm_parts(scene: &Scene) -> Option<Vec<Pose>> {
    let geometry = geometry(scene);
    let parts = geometry.fixed_parts();
    geometry.turns().then(|| parts[1..].iter().map(pose).collect())
}

/// Returns the links of a scene's arm that have meshes.
pub fn arm_looks(scene: &Scene) -> Result<ArmMeshes, ArmMeshError> {
    let loaded = arm_meshes::load(&scene.arm)?;
    let geometry = geometry(scene);
    let mut links = vec![Vec::new(); geometry.joints() + 1];
    for LoadedMesh { mesh, triangles } in &loaded {
        let (frame, t_frame_mesh) = placed(&scene.arm, mesh, &geometry);
        let place = |corner: &[f32; 3]| -> [f64; 3] {
            let at: [f64; 3] = std::array::from_fn(|axis| f64::from(corner[axis]) * mesh.scale[axis]);
            (t_frame_mesh * Point3::from(at)).into()
        };
        // Mirroring reverses the winding of a triangle.
        let is_mirrored = mesh.scale.iter().product::<f64>() < 0.0;
        links[frame].extend(triangles.iter().map(|[a, b, c]| match is_mirrored {
            true => [a, c, b].map(place),
            false => [a, b, c].map(place),
        }));
    }
    let meshed = links.iter().zip(0..).filter(|(triangles, _)| !triangles.is_empty());
    Ok(ArmMeshes {
        meshes: meshed.map(|(triangles, frame)| link_mesh(frame, triangles)).collect(),
        notes: arm_meshes::undrawn(&scene.arm),
    })
}

/// Returns the index of the frame that a mesh moves with, and the mesh's pose in it. A link behind k revolute
/// joints moves with frame k; fixed joints do not count.
fn placed(arm: &Arm, mesh: &ArmMesh, geometry: &ArmGeometry) -> (usize, Isometry3<f64>) {
    let before = arm.joints_before(mesh);
    let t_base_link = before.iter().fold(Isometry3::identity(), |t_base_link, joint| {
        t_base_link * isometry(joint.position_mm, joint.roll_pitch_yaw_deg)
    });
    let frame = before.iter().filter(|joint| joint.axis.is_some()).count().min(geometry.joints());
    // The flange has the last frame.
    let index = if frame == geometry.joints() { LinkFrames::TOOL } else { frame };
    let t_base_frame = geometry.frames(&Joints::default()).t_base_link(index);
    let t_link_mesh = isometry(mesh.position_mm, mesh.roll_pitch_yaw_deg);
    (frame, t_base_frame.inverse() * t_base_link * t_link_mesh)
}

/// Rotations about the fixed axes x, y and z, in this order, as in URDF.
fn isometry(position_mm: [f64; 3], roll_pitch_yaw_deg: [f64; 3]) -> Isometry3<f64> {
    let [roll, pitch, yaw] = roll_pitch_yaw_deg.map(f64::to_radians);
    let translation = Translation3::from(Vector3::from(position_mm) * 1e-3);
    Isometry3::from_parts(translation, UnitQuaternion::from_euler_angles(roll, pitch, yaw))
}
