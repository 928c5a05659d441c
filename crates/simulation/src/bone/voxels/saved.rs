//! Serialises the field's snapshot: per block, which voxels have changed since the start of the run, which
//! are spent, and the fractions of the rest; for a fully spent block, only its number.

use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error, ser::SerializeSeq};

use super::{BoneSnapshot, Voxels};
use crate::bone::grid::VoxelIndex;
use crate::bone::strength::{BLOCK_VOXELS, BLOCK_WORDS, BlockChange, ChangedBlock, bit};

/// A serialised block: bit b of word w is voxel 64 w + b.
struct SavedBlock<'a>(BlockChange<'a>);

impl Serialize for SavedBlock<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let BlockChange { number, changed, .. } = self.0;
        let mut gone = [0_u64; BLOCK_WORDS];
        let voxels = (0..BLOCK_VOXELS).filter(|voxel| bit(&changed, *voxel));
        for (voxel, spent) in voxels.zip(self.0.fractions()) {
            gone[voxel / 64] |= u64::from(spent == 1.0) << (voxel % 64);
        }
        let cut = (gone != [u64::MAX; BLOCK_WORDS]).then_some((changed, gone, Partial(&self.0)));
        (number, cut).serialize(serializer)
    }
}

/// The fractions of the changed voxels that are not fully spent.
struct Partial<'a>(&'a BlockChange<'a>);

impl Serialize for Partial<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let partial = || self.0.fractions().filter(|spent| *spent != 1.0);
        let mut out = serializer.serialize_seq(Some(partial().count()))?;
        partial().try_for_each(|spent| out.serialize_element(&spent))?;
        out.end()
    }
}

struct Blocks<'a>(&'a Voxels);

impl Serialize for Blocks<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let changes = || self.0.pool.changes(&self.0.pilot);
        let mut out = serializer.serialize_seq(Some(changes().count()))?;
        changes().try_for_each(|change| out.serialize_element(&SavedBlock(change)))?;
        out.end()
    }
}

impl Voxels {
    /// Returns the contents of [`Voxels::snapshot`], serialisable without a copy; deserialises as a
    /// [`BoneSnapshot`].
    pub fn serialised(&self) -> impl Serialize + '_ {
        let voxels = self.geometry.voxel_count() as u64;
        let lists = (&self.removed, &self.waiting);
        (voxels, self.pilot_count, Blocks(self), lists, self.removed_total)
    }
}

impl<'de> Deserialize<'de> for BoneSnapshot {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<BoneSnapshot, D::Error> {
        type Block = (u32, Option<([u64; BLOCK_WORDS], [u64; BLOCK_WORDS], Vec<f64>)>);
        type Whole = (u64, u64, Vec<Block>, (Vec<VoxelIndex>, Vec<VoxelIndex>), u64);
        let (voxels, pilot_count, saved, (removed, waiting), removed_total) =
            Whole::deserialize(deserializer)?;
        let inside = |voxel: &VoxelIndex| u64::from(voxel.number()) < voxels;
        if !removed.iter().chain(&waiting).all(inside) {
            return Err(D::Error::custom("removed voxel outside the grid"));
        }
        let mut blocks = Vec::new();
        for (number, cut) in saved {
            let Some((changed, gone, partial)) = cut else {
                let (changed, spent) = ([u64::MAX; BLOCK_WORDS], vec![1.0; BLOCK_VOXELS]);
                blocks.push(ChangedBlock { number, changed, spent });
                continue;
            };
            let mut rest = partial.into_iter();
            let mut spent = Vec::new();
            for voxel in (0..BLOCK_VOXELS).filter(|voxel| bit(&changed, *voxel)) {
                let mut partial =
                    || rest.next().ok_or_else(|| D::Error::custom("truncated: fraction missing"));
                spent.push(if bit(&gone, voxel) { 1.0 } else { partial()? });
            }
            blocks.push(ChangedBlock { number, changed, spent });
        }
        let voxel_count = voxels as usize;
        Ok(BoneSnapshot { voxel_count, pilot_count, blocks, removed, waiting, removed_total })
    }
}
