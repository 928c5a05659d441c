//! Where the critical structures of a scene are in its volume, and how much bone was removed in them.

use nalgebra::Vector3;
use scene::{Scene, StructureRole};
use voxel_grid::{Volume, VoxelGrid};

use crate::shape::Shape;

/// The structures of a scene in its volume.
#[derive(Debug, Clone, PartialEq)]
pub struct Regions {
    grid: VoxelGrid,
    each: Vec<Option<Region>>,
}

#[derive(Debug, Clone, PartialEq)]
struct Region {
    shape: Shape,
    /// Number of bone voxels in a target; `None` for other structures.
    target_voxels: Option<usize>,
}

/// What was removed in a structure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Removal {
    /// Volume of the removed voxels whose centres are inside.
    pub volume_mm3: f64,
    /// Share of a target's bone.
    pub share: Option<f64>,
}

impl Regions {
    /// Finds the structures of a scene in its volume; `None` without a volume or a structure. Those that are
    /// built in have no region.
    pub fn of(scene: &Scene, volume: Option<&Volume>) -> Option<Regions> {
        let (settings, volume) = (scene.volume.as_ref()?, volume?);
        if scene.structure.is_empty() {
            return None;
        }
        let region = |structure: &scene::Structure| {
            let shape = Shape::of(scene, structure, None).ok()?;
            let is_target = structure.role == StructureRole::Target;
            let target_voxels = is_target.then(|| bone_voxels(&shape, volume, settings.bone_threshold_hu));
            Some(Region { shape, target_voxels })
        };
        Some(Regions { grid: volume.grid, each: scene.structure.iter().map(region).collect() })
    }

    fn centre_m(&self, voxel: u32) -> Option<Vector3<f64>> {
        let voxel = self.grid.voxel(voxel as usize)?;
        Some(self.grid.world_m(voxel.map(|index| index as f64)).into())
    }

    fn voxel_mm3(&self) -> f64 {
        self.grid.spacing_m().into_iter().map(|edge_m| 1e3 * edge_m).product()
    }

    /// Returns what was removed in each structure, by the drilled voxels whose centres are inside.
    pub fn removals(&self, drilled: &[u32]) -> impl Iterator<Item = Option<Removal>> {
        let centres_m: Vec<Vector3<f64>> = drilled.iter().filter_map(|voxel| self.centre_m(*voxel)).collect();
        self.each.iter().map(move |region| {
            let Region { shape, target_voxels } = region.as_ref()?;
            let count = centres_m.iter().filter(|centre_m| shape.distance_m(centre_m) < 0.0).count();
            let share = target_voxels.filter(|voxels| *voxels > 0).map(|voxels| count as f64 / voxels as f64);
            Some(Removal { volume_mm3: count as f64 * self.voxel_mm3(), share })
        })
    }

    /// Returns the volume removed outside of all targets; `None` without a target.
    pub fn healthy_mm3(&self, drilled: &[u32]) -> Option<f64> {
        let targets = || self.each.iter().flatten().filter(|region| region.target_voxels.is_some());
        targets().next()?;
        let is_healthy =
            |centre_m: &Vector3<f64>| targets().all(|target| target.shape.distance_m(centre_m) >= 0.0);
        let centres_m = drilled.iter().filter_map(|voxel| self.centre_m(*voxel));
        Some(centres_m.filter(is_healthy).count() as f64 * self.voxel_mm3())
    }
}

/// Counts the bone voxels whose centres are inside a shape.
fn bone_voxels(shape: &Shape, volume: &Volume, threshold_hu: i16) -> usize {
    let (grid, [ni, nj, nk]) = (&volume.grid, volume.grid.dims());
    let steepness_m = shape.steepness() * grid.spacing_m()[0];
    let mut count = 0;
    for row in 0..nj * nk {
        let (j, k, mut i) = (row % nj, row / nj, 0);
        while i < ni {
            let distance_m = shape.distance_m(&grid.world_m([i as f64, j as f64, k as f64]).into());
            count += usize::from(distance_m < 0.0 && volume.hu[row * ni + i] >= threshold_hu);
            // The surface is no nearer than that.
            i += ((distance_m / steepness_m) as usize).max(1);
        }
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ball as target in a block, and a nerve beside it: a rod of voxels along x is drilled.
    #[test]
    fn volumes_and_shares_are_those_of_the_voxels_inside() {
        let text = "name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[volume]\nphantom = \"block\"\n[tool]\n\
                    burr_start_mm = [0.0, 0.0, -40.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n\
                    [[structure]]\nname = \"tumour\"\nrole = \"target\"\n\
                    ball = { centre_mm = [10.0, 10.0, 10.0], radius_mm = 5.1 }\n\
                    [[structure]]\nname = \"nerve\"\n\
                    tube = { points_mm = [[3.0, 0.0, 10.0], [3.0, 20.0, 10.0]], radius_mm = 1.5 }\n";
        let scene = Scene::parse(text, std::path::Path::new("a.toml")).unwrap();
        let grid = VoxelGrid::axis_aligned([21; 3], [1e-3; 3], [0.0; 3]).unwrap();
        // Bone from x = 8 mm on.
        let hu = (0..grid.voxel_count()).map(|index| if index % 21 >= 8 { 1000 } else { 0 }).collect();
        let regions = Regions::of(&scene, Some(&Volume { grid, hu })).unwrap();
        let rod: Vec<u32> = (0..21).map(|i| i + 21 * (10 + 21 * 10)).collect();
        let found: Vec<Option<Removal>> = regions.removals(&rod).collect();
        let inside = |[x, y, z]: [i32; 3]| (x - 10).pow(2) + (y - 10).pow(2) + (z - 10).pow(2) <= 26;
        let all = (0..9261).map(|index| [index % 21, index / 21 % 21, index / 441]);
        let bone = all.filter(|voxel| voxel[0] >= 8 && inside(*voxel)).count();
        let target = Removal { volume_mm3: 11.0, share: Some(11.0 / bone as f64) };
        assert_eq!(found, [Some(target), Some(Removal { volume_mm3: 3.0, share: None })]);
        assert_eq!(regions.healthy_mm3(&rod), Some(10.0));
        assert!(Regions::of(&scene, None).is_none());
    }
}
