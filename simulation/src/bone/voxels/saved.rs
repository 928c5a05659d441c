//! The field's snapshot as bytes: per block, which voxels are touched, which are spent, and the fractions of the rest; of a block that is
//! wholly spent, its number alone.

use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

use super::{BoneSnapshot, Voxels};
use crate::bone::grid::VoxelIndex;
use crate::bone::strength::BLOCK_VOXELS;

const WORDS: usize = BLOCK_VOXELS / 64;

/// A block: bit b of word w stands for voxel 64 w + b.
struct SavedBlock<'a> {
    number: u32,
    spent: &'a [f64],
}

impl Serialize for SavedBlock<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let (mut touched, mut gone) = ([0_u64; WORDS], [0_u64; WORDS]);
        for (voxel, spent) in self.spent.iter().enumerate() {
            touched[voxel / 64] |= u64::from(*spent != 0.0) << (voxel % 64);
            gone[voxel / 64] |= u64::from(*spent == 1.0) << (voxel % 64);
        }
        let partial = Partial { spent: self.spent, touched: &touched, gone: &gone };
        let cut = (gone != [u64::MAX; WORDS]).then_some((touched, gone, partial));
        (self.number, cut).serialize(serializer)
    }
}

/// The fractions of the touched voxels that are not fully spent.
struct Partial<'a> {
    spent: &'a [f64],
    touched: &'a [u64; WORDS],
    gone: &'a [u64; WORDS],
}

impl Serialize for Partial<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let words = self.touched.iter().zip(self.gone).map(|(touched, gone)| touched & !gone);
        let count: u32 = words.clone().map(u64::count_ones).sum();
        let mut out = serializer.serialize_seq(Some(count as usize))?;
        for (word, mut bits) in words.enumerate() {
            while bits != 0 {
                let voxel = word * 64 + bits.trailing_zeros() as usize;
                serde::ser::SerializeSeq::serialize_element(&mut out, &self.spent[voxel])?;
                bits &= bits - 1;
            }
        }
        serde::ser::SerializeSeq::end(out)
    }
}

struct Blocks<'a>(&'a Voxels);

impl Serialize for Blocks<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self.0.pool.contents().map(|(number, spent)| SavedBlock { number, spent }))
    }
}

impl Voxels {
    /// The contents of [`Voxels::snapshot`], serialisable without a copy; deserialises as a [`BoneSnapshot`].
    pub fn serialised(&self) -> impl Serialize + '_ {
        let voxels = self.geometry.voxel_count() as u64;
        let lists = (&self.removed, &self.waiting);
        (voxels, self.predrilled_count, Blocks(self), lists, self.removed_total)
    }
}

impl<'de> Deserialize<'de> for BoneSnapshot {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<BoneSnapshot, D::Error> {
        type Block = (u32, Option<([u64; WORDS], [u64; WORDS], Vec<f64>)>);
        type Whole = (u64, u64, Vec<Block>, (Vec<VoxelIndex>, Vec<VoxelIndex>), u64);
        let (voxels, predrilled_count, saved, (removed, waiting), removed_total) =
            Whole::deserialize(deserializer)?;
        let inside = |voxel: &VoxelIndex| u64::from(voxel.number()) < voxels;
        if !removed.iter().chain(&waiting).all(inside) {
            return Err(D::Error::custom("a removed voxel outside the grid"));
        }
        let mut blocks = Vec::new();
        let mut spent = Vec::new();
        for (number, cut) in &saved {
            blocks.push(*number);
            let Some((touched, gone, partial)) = cut else {
                spent.extend_from_slice(&[1.0; BLOCK_VOXELS]);
                continue;
            };
            let mut rest = partial.iter();
            for voxel in 0..BLOCK_VOXELS {
                let bit = |words: &[u64; WORDS]| words[voxel / 64] >> (voxel % 64) & 1 == 1;
                spent.push(match (bit(touched), bit(gone)) {
                    (_, true) => 1.0,
                    (false, false) => 0.0,
                    (true, false) => *rest.next().ok_or_else(|| D::Error::custom("a fraction is missing"))?,
                });
            }
        }
        let voxel_count = voxels as usize;
        Ok(BoneSnapshot { voxel_count, predrilled_count, blocks, spent, removed, waiting, removed_total })
    }
}
