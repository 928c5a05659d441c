//! Spent cutting energy per voxel: sparse blocks of 8 x 8 x 8 voxels from a pool that grows.
//!
//! The pool grows by whole segments, which never move, so a place stays valid. [`SpentPool::make_room`] keeps
//! as many blocks free as one tick can take; when called between ticks, no tick has to allocate. A tick that
//! still finds none free allocates a segment itself. When the pool grows therefore affects only timing, never
//! results.

use super::BoneError;
use super::occupancy::VoxelBox;

/// Base-2 logarithm of the edge of a block in voxels.
const BLOCK_SHIFT: usize = 3;
pub(super) const BLOCK_EDGE: usize = 1 << BLOCK_SHIFT;
/// Number of voxels in a block.
pub(super) const BLOCK_VOXELS: usize = BLOCK_EDGE * BLOCK_EDGE * BLOCK_EDGE;
/// Number of rows along x in a block.
const BLOCK_ROWS: usize = BLOCK_EDGE * BLOCK_EDGE;

const _: () = assert!(BLOCK_EDGE == u8::BITS as usize, "one byte flags the cut voxels of a row of a block");

/// Number of blocks in a segment: 256 KiB of fractions.
const SEGMENT_BLOCKS: usize = 64;
/// Number of voxels in a segment.
const SEGMENT_VOXELS: usize = SEGMENT_BLOCKS * BLOCK_VOXELS;
const _: () =
    assert!(SEGMENT_VOXELS.is_power_of_two(), "a place within a segment is the low bits of a place");
/// Initial capacity of a pool in blocks, 16 MiB, unless the grid has fewer.
const FIRST_BLOCKS: usize = 4096;

/// Table entry of an untouched block.
const UNTOUCHED: u32 = u32::MAX;

/// Location of a voxel's spent fraction in the pool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct PoolIndex(usize);

impl PoolIndex {
    /// The place of any voxel in an untouched block.
    pub const NONE: Self = Self(usize::MAX);
}

/// The blocks in use around a small cube of voxels, at most two along each axis, looked up once.
#[derive(Debug, Clone, Copy)]
pub(super) struct BlocksAbout {
    /// First place of each block by z, y, x; [`PoolIndex::NONE`] if the block is untouched.
    place: [[[PoolIndex; 2]; 2]; 2],
}

/// The fractions of a block.
#[derive(Debug, Clone, Copy)]
pub(super) struct Block<'p> {
    spent: &'p [f64; BLOCK_VOXELS],
    partial: &'p [u8; BLOCK_ROWS],
}

impl<'p> Block<'p> {
    /// Returns the fractions of slice z, by y and x; z counts within the block or from the start of it and
    /// its neighbours.
    #[inline(always)]
    pub fn slice(&self, z: usize) -> &'p [[f64; BLOCK_EDGE]; BLOCK_EDGE] {
        let (rows, _) = self.spent.as_chunks::<BLOCK_EDGE>();
        let (slices, _) = rows.as_chunks::<BLOCK_EDGE>();
        &slices[z % BLOCK_EDGE]
    }

    /// Returns which voxels of slice z may have a spent fraction above 0: one byte per row, the first row
    /// lowest.
    #[inline(always)]
    pub fn partial_rows(&self, z: usize) -> u64 {
        let rows = self.partial[(z % BLOCK_EDGE) << BLOCK_SHIFT..].first_chunk();
        u64::from_le_bytes(*rows.unwrap_or(&[0; BLOCK_EDGE]))
    }
}

/// Memory of [`SEGMENT_BLOCKS`] blocks.
#[derive(Debug, Clone)]
struct Segment {
    /// `BLOCK_VOXELS` fractions per block.
    spent: Box<[f64; SEGMENT_VOXELS]>,
    /// One byte per row of 8 voxels: bits of the voxels that may have a spent fraction above 0.
    partial: Box<[u8; SEGMENT_VOXELS / BLOCK_EDGE]>,
}

impl Segment {
    /// Size of a segment in bytes.
    const BYTES: usize = SEGMENT_VOXELS * size_of::<f64>() + SEGMENT_VOXELS / BLOCK_EDGE;

    /// Creates a segment of whole voxels; `None` if memory runs out.
    fn new() -> Option<Self> {
        Some(Self { spent: zeroed(0.0)?, partial: zeroed(0)? })
    }
}

/// Returns an array of zeros; `None` if memory runs out.
fn zeroed<T: Copy, const N: usize>(zero: T) -> Option<Box<[T; N]>> {
    let mut numbers = Vec::new();
    numbers.try_reserve_exact(N).ok()?;
    numbers.resize(N, zero);
    numbers.into_boxed_slice().try_into().ok()
}

/// Number of words for one bit per voxel of a block.
pub(super) const BLOCK_WORDS: usize = BLOCK_VOXELS / 64;

/// Changes of a block since the start of the run.
#[derive(Debug, Clone, Copy)]
pub(super) struct BlockChange<'p> {
    /// Number of the block in the grid.
    pub number: u32,
    /// Bit b of word w is voxel 64 w + b; set where the fraction differs.
    pub changed: [u64; BLOCK_WORDS],
    /// The fractions of all its voxels.
    spent: &'p [f64],
}

impl BlockChange<'_> {
    /// Returns the fractions that differ, in order.
    pub fn fractions(&self) -> impl Iterator<Item = f64> + '_ {
        (0..BLOCK_VOXELS).filter(|voxel| bit(&self.changed, *voxel)).map(|voxel| self.spent[voxel])
    }

    /// Returns an owned copy.
    pub fn to_owned(self) -> ChangedBlock {
        ChangedBlock { number: self.number, changed: self.changed, spent: self.fractions().collect() }
    }
}

/// A [`BlockChange`] that owns its fractions: those that differ, in order.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ChangedBlock {
    pub number: u32,
    pub changed: [u64; BLOCK_WORDS],
    pub spent: Vec<f64>,
}

/// Returns the bit of a voxel of a block.
#[inline]
pub(super) fn bit(words: &[u64; BLOCK_WORDS], voxel: usize) -> bool {
    words[voxel / 64] >> (voxel % 64) & 1 == 1
}

/// The spent fraction of every touched voxel: 0 whole, 1 gone.
#[derive(Debug, Clone)]
pub(super) struct SpentPool {
    dims: [usize; 3],
    block_dims: [usize; 3],
    /// Slot of each block of the grid, or `UNTOUCHED`.
    table: Vec<u32>,
    /// Block of each slot in use, in the order of first touch.
    owners: Vec<u32>,
    /// The slots in use by their blocks' numbers, so that nothing depends on which block was touched first.
    by_block: Vec<u32>,
    segments: Vec<Segment>,
    /// Maximum number of blocks: those of the grid, or fewer if a test limits them.
    capacity: usize,
    /// Blocks that [`Self::make_room`] keeps free.
    reserve: usize,
}

impl SpentPool {
    /// Creates a pool of at most `most` blocks for a grid of `dims` voxels, of which one tick takes at most
    /// `per_tick`.
    ///
    /// # Errors
    /// [`BoneError::Memory`].
    pub fn new(dims: [usize; 3], most: usize, per_tick: usize) -> Result<Self, BoneError> {
        let mut pool = Self { reserve: FIRST_BLOCKS.max(per_tick), ..Self::empty(dims, most) };
        if !pool.make_room() {
            return Err(BoneError::Memory { bytes: pool.reserve * BLOCK_VOXELS * size_of::<f64>() });
        }
        pool.reserve = per_tick;
        Ok(pool)
    }

    /// Returns a pool of at most `most` blocks, without memory yet.
    pub fn empty(dims: [usize; 3], most: usize) -> Self {
        let block_dims = dims.map(|n| n.div_ceil(BLOCK_EDGE));
        let blocks = block_dims[0] * block_dims[1] * block_dims[2];
        // A grid never uses more slots than it has blocks.
        let capacity = most.min(blocks);
        Self {
            dims,
            block_dims,
            table: vec![UNTOUCHED; blocks],
            owners: Vec::with_capacity(capacity),
            by_block: Vec::with_capacity(capacity),
            segments: Vec::with_capacity(capacity.div_ceil(SEGMENT_BLOCKS)),
            capacity,
            reserve: 0,
        }
    }

    /// Allocates until as many blocks are free as a tick can take; returns false if memory runs out.
    pub fn make_room(&mut self) -> bool {
        let wanted = (self.owners.len() + self.reserve).min(self.capacity);
        while self.segments.len() * SEGMENT_BLOCKS < wanted {
            if !self.grow() {
                return false;
            }
        }
        true
    }

    /// Allocates a segment; the list of segments has room for it.
    fn grow(&mut self) -> bool {
        let segment = Segment::new();
        let grown = segment.is_some();
        self.segments.extend(segment);
        grown
    }

    /// Returns the size of all segments in bytes.
    pub fn bytes(&self) -> usize {
        self.segments.len() * Segment::BYTES
    }

    /// Returns the number of blocks in use.
    pub fn used(&self) -> usize {
        self.owners.len()
    }

    /// Returns the maximum number of blocks that the pool may use.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    #[inline]
    fn locate(&self, i: usize, j: usize, k: usize) -> (usize, usize) {
        let block = ((k >> BLOCK_SHIFT) * self.block_dims[1] + (j >> BLOCK_SHIFT)) * self.block_dims[0]
            + (i >> BLOCK_SHIFT);
        let mask = BLOCK_EDGE - 1;
        (block, (((k & mask) << BLOCK_SHIFT) + (j & mask)) * BLOCK_EDGE + (i & mask))
    }

    /// Returns the spent fraction of a voxel in [0, 1].
    #[inline]
    pub fn spent(&self, i: usize, j: usize, k: usize) -> f64 {
        let (block, offset) = self.locate(i, j, k);
        match self.table[block] {
            UNTOUCHED => 0.0,
            slot => self.spent_at(PoolIndex(slot as usize * BLOCK_VOXELS + offset)),
        }
    }

    /// Returns the present place of a voxel's fraction, for [`Self::spent_at`].
    #[inline]
    pub fn place(&self, [i, j, k]: [usize; 3]) -> PoolIndex {
        let (block, offset) = self.locate(i, j, k);
        match self.table[block] {
            UNTOUCHED => PoolIndex::NONE,
            slot => PoolIndex(slot as usize * BLOCK_VOXELS + offset),
        }
    }

    /// Returns the fraction at a place from [`Self::place`], valid until the next block is taken.
    #[inline]
    pub fn spent_at(&self, PoolIndex(place): PoolIndex) -> f64 {
        // A whole voxel has no place.
        self.segments.get(place / SEGMENT_VOXELS).map_or(0.0, |segment| segment.spent[place % SEGMENT_VOXELS])
    }

    /// Returns the place of the voxel's fraction, taking a block if needed; `None` if there are no more.
    pub fn claim(&mut self, [i, j, k]: [usize; 3]) -> Option<PoolIndex> {
        let (block, offset) = self.locate(i, j, k);
        self.claim_block(block).map(|slot| PoolIndex(slot * BLOCK_VOXELS + offset))
    }

    /// Returns the slot of a block, taking one if needed; `None` if there are no more.
    fn claim_block(&mut self, block: usize) -> Option<usize> {
        if self.table[block] == UNTOUCHED {
            let used = self.owners.len();
            if used == self.capacity || (used == self.segments.len() * SEGMENT_BLOCKS && !self.grow()) {
                return None;
            }
            let owners = &self.owners;
            let at = self.by_block.partition_point(|slot| owners[*slot as usize] < block as u32);
            self.by_block.insert(at, used as u32);
            self.table[block] = used as u32;
            self.owners.push(block as u32);
        }
        Some(self.table[block] as usize)
    }

    /// Sets the fraction at a place from [`Self::claim`]; returns true if the voxel was whole before.
    #[inline]
    pub fn set(&mut self, PoolIndex(place): PoolIndex, spent: f64) -> bool {
        let (segment, place) = (&mut self.segments[place / SEGMENT_VOXELS], place % SEGMENT_VOXELS);
        let kept = &mut segment.spent[place];
        let first = *kept == 0.0 && spent > 0.0;
        // A bit is never cleared once it is set.
        if first {
            segment.partial[place / BLOCK_EDGE] |= 1 << (place % BLOCK_EDGE);
        }
        *kept = spent;
        first
    }

    /// Returns the voxel whose fraction is stored at a place from [`Self::claim`].
    pub fn voxel_at(&self, PoolIndex(place): PoolIndex) -> Option<[usize; 3]> {
        self.voxel_of(place / BLOCK_VOXELS, place % BLOCK_VOXELS)
    }

    /// Returns bits of which bit b is set if voxel `start + b` of row (j, k), which lies in the grid, has a
    /// spent fraction above 0.
    #[inline]
    pub fn partial_window(&self, start: i64, j: usize, k: usize) -> u8 {
        if self.owners.is_empty() {
            return 0;
        }
        let row_of_blocks =
            ((k >> BLOCK_SHIFT) * self.block_dims[1] + (j >> BLOCK_SHIFT)) * self.block_dims[0];
        let row_in_block = ((k & (BLOCK_EDGE - 1)) << BLOCK_SHIFT) + (j & (BLOCK_EDGE - 1));
        let bits = |block: i64| {
            if block < 0 || block >= self.block_dims[0] as i64 {
                return 0;
            }
            match self.table[row_of_blocks + block as usize] {
                UNTOUCHED => 0,
                slot => {
                    let (segment, block) = (slot as usize / SEGMENT_BLOCKS, slot as usize % SEGMENT_BLOCKS);
                    u16::from(self.segments[segment].partial[block * BLOCK_ROWS + row_in_block])
                }
            }
        };
        let first = start >> BLOCK_SHIFT;
        ((bits(first) | bits(first + 1) << 8) >> (start & 7)) as u8
    }

    /// Returns the blocks around the cube of voxels `low` to `low + extent`, at most eight along an axis; it
    /// may extend beyond the grid. `None` if all blocks are untouched.
    #[inline]
    pub fn blocks_about(&self, low: [i64; 3], extent: i64) -> Option<BlocksAbout> {
        if self.owners.is_empty() {
            return None;
        }
        let first = low.map(|x| x >> BLOCK_SHIFT);
        let inside = |axis: usize, side: usize| {
            let block = first[axis] + side as i64;
            let reaches = block <= (low[axis] + extent) >> BLOCK_SHIFT;
            (reaches && block >= 0 && block < self.block_dims[axis] as i64).then_some(block as usize)
        };
        let mut place = [[[PoolIndex::NONE; 2]; 2]; 2];
        let mut any = false;
        for (z, slices) in place.iter_mut().enumerate() {
            let Some(k) = inside(2, z) else { continue };
            for (y, rows) in slices.iter_mut().enumerate() {
                let Some(j) = inside(1, y) else { continue };
                for (x, place) in rows.iter_mut().enumerate() {
                    let Some(i) = inside(0, x) else { continue };
                    let slot = self.table[(k * self.block_dims[1] + j) * self.block_dims[0] + i];
                    if slot != UNTOUCHED {
                        *place = PoolIndex(slot as usize * BLOCK_VOXELS);
                        any = true;
                    }
                }
            }
        }
        any.then_some(BlocksAbout { place })
    }

    /// Returns one of the blocks around a cube, by its side along x, y, z; `None` if it is untouched.
    #[inline(always)]
    pub fn block(&self, blocks: &BlocksAbout, [x, y, z]: [usize; 3]) -> Option<Block<'_>> {
        let PoolIndex(place) = blocks.place[z][y][x];
        let (segment, place) = (self.segments.get(place / SEGMENT_VOXELS)?, place % SEGMENT_VOXELS);
        let spent = segment.spent.get(place..)?.first_chunk()?;
        let partial = segment.partial.get(place / BLOCK_EDGE..)?.first_chunk()?;
        Some(Block { spent, partial })
    }

    /// Makes a voxel whole again.
    pub fn forget(&mut self, [i, j, k]: [usize; 3]) {
        let (block, offset) = self.locate(i, j, k);
        if self.table[block] != UNTOUCHED {
            self.set(PoolIndex(self.table[block] as usize * BLOCK_VOXELS + offset), 0.0);
        }
    }

    /// Returns the blocks in use by number: slot, number and fractions, `BLOCK_VOXELS` each.
    fn contents(&self) -> impl ExactSizeIterator<Item = (usize, u32, &[f64])> {
        self.by_block.iter().map(|slot| {
            let slot = *slot as usize;
            (slot, self.owners[slot], self.fractions(slot))
        })
    }

    /// Returns the fractions of a slot in use.
    fn fractions(&self, slot: usize) -> &[f64] {
        let first = slot % SEGMENT_BLOCKS * BLOCK_VOXELS;
        &self.segments[slot / SEGMENT_BLOCKS].spent[first..first + BLOCK_VOXELS]
    }

    /// Returns the changes since `start`, in the order of the blocks' numbers: every block that `start` did
    /// not use, and those of its blocks that differ.
    pub fn changes<'p>(&'p self, start: &'p Self) -> impl Iterator<Item = BlockChange<'p>> {
        self.contents().filter_map(|(_, number, spent)| {
            let before = match start.table[number as usize] {
                UNTOUCHED => None,
                slot => Some(start.fractions(slot as usize)),
            };
            let mut changed = [0; BLOCK_WORDS];
            for (voxel, spent) in spent.iter().enumerate() {
                let before = before.map_or(0.0, |before| before[voxel]);
                changed[voxel / 64] |= u64::from(*spent != before) << (voxel % 64);
            }
            let differs = before.is_none() || changed != [0; BLOCK_WORDS];
            differs.then_some(BlockChange { number, changed, spent })
        })
    }

    /// Calls `visit` with the spent fraction of every grid voxel in the blocks in use, block by block in the
    /// order of their numbers, x fastest within a block.
    pub fn for_each(&self, mut visit: impl FnMut([usize; 3], f64)) {
        for (slot, _, fractions) in self.contents() {
            for (offset, spent) in fractions.iter().enumerate() {
                if let Some(voxel) = self.voxel_of(slot, offset) {
                    visit(voxel, *spent);
                }
            }
        }
    }

    /// Returns the voxels of the blocks taken since only `before` were in use, including those beyond the
    /// grid.
    pub fn blocks_since(&self, before: usize) -> impl Iterator<Item = VoxelBox> + '_ {
        self.owners.get(before..).unwrap_or_default().iter().map(|block| {
            let low = self.corner_of(*block as usize).map(|x| x as i64);
            VoxelBox { low, high: low.map(|x| x + BLOCK_EDGE as i64 - 1) }
        })
    }

    /// Returns the first voxel of a block.
    fn corner_of(&self, block: usize) -> [usize; 3] {
        let [bx, by, _] = self.block_dims;
        [block % bx, (block / bx) % by, block / (bx * by)].map(|block| block * BLOCK_EDGE)
    }

    /// Returns the voxel `offset` of slot `slot`; `None` if that part of the block lies outside the grid.
    fn voxel_of(&self, slot: usize, offset: usize) -> Option<[usize; 3]> {
        let corner = self.corner_of(self.owners[slot] as usize);
        let mask = BLOCK_EDGE - 1;
        let inner = [offset & mask, (offset >> BLOCK_SHIFT) & mask, offset >> (2 * BLOCK_SHIFT)];
        let voxel = [0, 1, 2].map(|a| corner[a] + inner[a]);
        (0..3).all(|a| voxel[a] < self.dims[a]).then_some(voxel)
    }

    /// Makes every voxel whole again; keeps the memory.
    pub fn clear(&mut self) {
        let mut rest = self.owners.len();
        for segment in &mut self.segments {
            let used = rest.min(SEGMENT_BLOCKS);
            segment.spent[..used * BLOCK_VOXELS].fill(0.0);
            segment.partial[..used * BLOCK_ROWS].fill(0);
            rest -= used;
        }
        for block in &self.owners {
            self.table[*block as usize] = UNTOUCHED;
        }
        self.owners.clear();
        self.by_block.clear();
    }

    /// Applies the [`Self::changes`] of another pool to a pool with the same start; returns false if they do
    /// not fit.
    pub fn load(&mut self, blocks: &[ChangedBlock]) -> bool {
        for ChangedBlock { number, changed, spent } in blocks {
            let known = (*number as usize) < self.table.len();
            let Some(slot) = known.then(|| self.claim_block(*number as usize)).flatten() else {
                return false;
            };
            let mut rest = spent.iter();
            for voxel in (0..BLOCK_VOXELS).filter(|voxel| bit(changed, *voxel)) {
                let Some(spent) = rest.next() else { return false };
                self.set(PoolIndex(slot * BLOCK_VOXELS + voxel), *spent);
            }
        }
        true
    }
}
