//! The bone at any time of a log.

use ipc_types::clock::now_ns;
use ipc_types::messages::Removed;
use voxel_grid::Volume;

use crate::board::Board;
use crate::slice::Slicer;
use crate::surface::Voxel;
use crate::surface::bone::Bone;

/// The bone, with removals applied up to some time.
pub(super) struct LogBone {
    bone: Bone,
    hu: Vec<i16>,
    removals: Vec<(u64, Removed, Vec<u32>)>,
    /// Number of removals applied, from the first.
    taken: usize,
}

impl LogBone {
    pub(super) fn new(volume: Volume, threshold_hu: i16, removals: Vec<(u64, Removed, Vec<u32>)>) -> LogBone {
        LogBone { bone: Bone::new(volume.grid, threshold_hu), hu: volume.hu, removals, taken: 0 }
    }

    /// Moves the bone to a time. Forward, applies the removals in between. Backward, restarts at the last
    /// reset before that time, because the log records what was removed but not what a reset restored.
    pub(super) fn go_to(&mut self, time_ns: u64) {
        let wanted = self.removals.partition_point(|(time, _, _)| *time <= time_ns);
        if wanted < self.taken {
            let restores = |(_, removed, _): &(u64, Removed, Vec<u32>)| removed.restore_first != 0;
            let crosses = self.removals[wanted..self.taken].iter().any(restores);
            if crosses {
                let from = self.removals[..wanted].iter().rposition(restores).unwrap_or(0);
                self.bone.restore();
                self.apply(from, wanted);
            } else {
                let gone = self.removals[wanted..self.taken].iter().flat_map(|(_, _, voxels)| voxels);
                gone.for_each(|index| self.bone.set(*index, Voxel::Present));
            }
        } else {
            self.apply(self.taken, wanted);
        }
        self.taken = wanted;
    }

    fn apply(&mut self, from: usize, to: usize) {
        self.removals[from..to].iter().for_each(|(_, removed, voxels)| self.bone.apply(removed, voxels));
    }

    /// Answers slice requests at the shown time.
    pub(super) fn answer(&self, slicer: &mut Slicer) {
        slicer.answer(self.bone.field(), &self.hu, now_ns());
    }

    /// Meshes the changed blocks; returns whether more are pending.
    pub(super) fn publish(&mut self, board: &Board) -> bool {
        self.bone.publish(&self.hu, board)
    }
}

#[cfg(test)]
mod tests {
    use voxel_grid::VoxelGrid;

    use super::*;

    fn removal(time_ns: u64, restore_first: u32, voxels: &[u32]) -> (u64, Removed, Vec<u32>) {
        let removed = Removed { tick: time_ns, restore_first, ..Removed::zeroed() };
        (time_ns, removed, voxels.to_vec())
    }

    /// Every path to a time must give the same bone as applying the removals in order.
    #[test]
    fn the_bone_of_a_time_does_not_depend_on_the_way_there() {
        let grid = VoxelGrid::axis_aligned([8; 3], [1e-3; 3], [0.0; 3]).unwrap();
        let volume = Volume { grid, hu: vec![1000; 512] };
        let removals = vec![
            removal(0, 0, &[1, 2]),
            removal(10, 0, &[3, 4]),
            removal(20, 0, &[5]),
            removal(30, 1, &[6]),
            removal(40, 0, &[3, 7]),
            removal(50, 1, &[]),
            removal(60, 0, &[8]),
        ];
        let expected: [&[u32]; 7] =
            [&[1, 2], &[1, 2, 3, 4], &[1, 2, 3, 4, 5], &[1, 2, 6], &[1, 2, 3, 6, 7], &[1, 2], &[1, 2, 8]];
        let mut bone = LogBone::new(volume, 150, removals);
        for to in [6, 0, 3, 2, 5, 4, 1, 6, 4, 3, 0, 5] {
            bone.go_to(to * 10 + 5);
            assert_eq!(bone.bone.field().removed(), expected[to as usize], "{to}");
        }
    }
}
