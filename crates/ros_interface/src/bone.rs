//! The CT's grid, the removed voxels and the bone's surface as messages.

use messages::Pose;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use simulation::pose;
use voxel_grid::VoxelGrid;

use crate::msg::{
    ColorRgba, Float64MultiArray, Header, Marker, PointCloud2, PointField, PoseStamped, RosPose, Time,
    Vector3 as RosVector,
};
use crate::outgoing::{Outgoing, push};
use crate::robot::WORLD;
use crate::topics::Output;

/// Points of a cloud: 176 kB, below what a subscriber of Fast DDS receives in one burst
/// ([`crate::image::MAX_IMAGE_BYTES`]).
pub const POINTS_PER_CLOUD: usize = 11_000;
/// Triangles of the surface: 173 kB.
pub const SURFACE_TRIANGLES: usize = 2_400;
/// Bytes of a point: x, y, z as float32, the voxel's index as uint32.
const POINT_BYTES: usize = 16;

/// Returns the pose of voxel (0, 0, 0) with axes along i, j and k, and the voxels' size along them, m. The
/// third size is negative where the CT's axes are left-handed, which a pose cannot be.
fn placement(grid: &VoxelGrid) -> (Pose, [f64; 3]) {
    let [i, j, k] = grid.axes().map(Vector3::from);
    let handedness = i.cross(&j).dot(&k).signum();
    let axes = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[i, j, k * handedness]));
    let turn = UnitQuaternion::from_rotation_matrix(&axes);
    let placed = Isometry3::from_parts(Translation3::from(Vector3::from(grid.origin_m())), turn);
    let [si, sj, sk] = grid.spacing_m();
    (pose(&placed), [si, sj, sk * handedness])
}

/// Returns the messages of the CT's grid, which does not change during the session.
pub fn of_grid(grid: &VoxelGrid) -> Vec<Outgoing> {
    let (placed, sizes_m) = placement(grid);
    let mut out = Vec::new();
    let header = Header { stamp: Time::default(), frame_id: WORLD.into() };
    push(&mut out, Output::AnatomyPose, &PoseStamped { header, pose: (&placed).into() });
    let counts = grid.dims().map(|count| count as f64).to_vec();
    let rows = [counts, sizes_m.to_vec()];
    push(&mut out, Output::AnatomyVoxels, &Float64MultiArray::of_rows(rows));
    out
}

/// Returns removed voxels as a cloud, at most [`POINTS_PER_CLOUD`]; without voxels, the cloud that tells of a
/// reset.
pub fn of_removed(grid: &VoxelGrid, voxels: &[u32], stamp: Time) -> Vec<Outgoing> {
    let voxels = &voxels[..voxels.len().min(POINTS_PER_CLOUD)];
    let mut data = Vec::with_capacity(voxels.len() * POINT_BYTES);
    for index in voxels {
        let Some(voxel) = grid.voxel(*index as usize) else { continue };
        for along in grid.world_m(voxel.map(|count| count as f64)) {
            data.extend((along as f32).to_le_bytes());
        }
        data.extend(index.to_le_bytes());
    }
    let field = |name: &str, offset, datatype| PointField { name: name.into(), offset, datatype, count: 1 };
    let cloud = PointCloud2 {
        header: Header { stamp, frame_id: WORLD.into() },
        height: 1,
        width: (data.len() / POINT_BYTES) as u32,
        fields: vec![field("x", 0, 7), field("y", 4, 7), field("z", 8, 7), field("index", 12, 6)],
        is_bigendian: false,
        point_step: POINT_BYTES as u32,
        row_step: data.len() as u32,
        data,
        is_dense: true,
    };
    let mut out = Vec::new();
    push(&mut out, Output::RemovedPoints, &cloud);
    out
}

/// Returns the bone's surface from the corners of its triangles, m.
pub fn of_surface(corners_m: impl IntoIterator<Item = [f64; 3]>, stamp: Time) -> Vec<Outgoing> {
    let marker = Marker {
        header: Header { stamp, frame_id: WORLD.into() },
        ns: "bone".to_owned(),
        id: 0,
        kind: 11,
        action: 0,
        pose: RosPose::from(&Pose { position_m: [0.0; 3], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] }),
        scale: RosVector { x: 1.0, y: 1.0, z: 1.0 },
        color: ColorRgba { r: 0.89, g: 0.85, b: 0.79, a: 1.0 },
        lifetime: Time::default(),
        frame_locked: false,
        points: corners_m.into_iter().map(RosVector::from).collect(),
        colors: Vec::new(),
        texture_resource: String::new(),
        texture: (Header::default(), String::new(), Vec::new()),
        uv_coordinates: Vec::new(),
        text: String::new(),
        mesh_resource: String::new(),
        mesh_file: (String::new(), Vec::new()),
        mesh_use_embedded_materials: false,
    };
    let mut out = Vec::new();
    push(&mut out, Output::BoneSurface, &marker);
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cdr::{self, Order};

    /// Pose, counts and signed sizes give the place of every voxel, in left-handed grids too.
    #[test]
    fn every_voxel_is_where_pose_and_sizes_have_it() {
        let (sin, cos) = (0.6, 0.8);
        for handedness in [1.0, -1.0] {
            let axes = [[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, handedness]];
            let grid = VoxelGrid::new([4, 5, 6], [1e-3, 2e-3, 3e-3], [0.1, 0.2, 0.3], axes).unwrap();
            let (placed, sizes_m) = placement(&grid);
            let t_world_grid = crate::robot::isometry(&placed);
            assert_eq!(sizes_m[2], 3e-3 * handedness);
            let voxel = [3.0, 1.0, 5.0];
            let local = Vector3::from_fn(|axis, _| voxel[axis] * sizes_m[axis]);
            let found = t_world_grid.transform_point(&local.into()).coords;
            assert!((found - Vector3::from(grid.world_m(voxel))).norm() < 1e-15, "{handedness}");
            let array: Float64MultiArray = cdr::decode(&of_grid(&grid)[1].cdr, Order::Little).unwrap();
            assert_eq!(array.data[..3], [4.0, 5.0, 6.0]);
            assert_eq!(array.layout.dim.iter().map(|dim| dim.size).collect::<Vec<_>>(), [2, 3]);
        }
    }

    #[test]
    fn a_cloud_holds_each_voxels_place_and_index_and_none_exceeds_a_burst() {
        let grid = VoxelGrid::axis_aligned([100; 3], [0.5e-3; 3], [0.01, 0.02, 0.03]).unwrap();
        let voxels: Vec<u32> = (0..2 * POINTS_PER_CLOUD as u32).map(|number| number * 7).collect();
        let cdr = of_removed(&grid, &voxels, Time { sec: 3, nanosec: 5 }).remove(0).cdr;
        assert!(cdr.len() > 170_000 && cdr.len() < crate::image::MAX_IMAGE_BYTES, "{}", cdr.len());
        // The last point is followed by `is_dense`.
        let last = &cdr[cdr.len() - 1 - POINT_BYTES..cdr.len() - 1];
        let index = u32::from_le_bytes(last[12..].try_into().unwrap());
        assert_eq!(index, voxels[POINTS_PER_CLOUD - 1]);
        let at = grid.world_m(grid.voxel(index as usize).unwrap().map(|count| count as f64));
        for (axis, bytes) in last[..12].chunks_exact(4).enumerate() {
            assert_eq!(f32::from_le_bytes(bytes.try_into().unwrap()), at[axis] as f32);
        }
        let corners = vec![[0.0; 3]; 3 * SURFACE_TRIANGLES];
        let cdr = of_surface(corners, Time::default()).remove(0).cdr;
        assert!(cdr.len() > 170_000 && cdr.len() < crate::image::MAX_IMAGE_BYTES, "{}", cdr.len());
    }
}
