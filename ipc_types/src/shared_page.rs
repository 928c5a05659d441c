//! The memory page that all processes of a session share besides the transport: the readers' wake flags, and
//! which node is which part.
//!
//! It is a file in the session's folder, mapped by every program that joins. Its content therefore lives as
//! long as anyone needs it, even if the folder's name is removed during the run.

use std::fs::File;
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};

use memmap2::MmapRaw;
use rustix::fs::{Mode, OFlags};

use crate::messages::Part;
use crate::session::{PAGE_FILE, create_file};

/// Bytes between two readers' flags: a cache line.
pub(crate) const FLAG_STRIDE: usize = 64;
/// Maximum number of readers in a session.
pub(crate) const FLAG_COUNT: usize = 32;
/// Value of a reader's flag before its first wait: raised.
pub(crate) const FLAG_NEW: u32 = 2;

/// The node numbers follow the flags: two words for each part, the lower and the upper 64 bits.
const NODES_OFFSET: usize = FLAG_STRIDE * FLAG_COUNT;
const WORD: usize = size_of::<u64>();
const PAGE_BYTES: usize = NODES_OFFSET + 2 * WORD * Part::ALL.len();

const _: () = assert!(NODES_OFFSET.is_multiple_of(WORD) && FLAG_STRIDE >= size_of::<u32>());

/// The mapped page.
#[derive(Debug, Clone)]
pub(crate) struct SharedPage {
    map: Arc<MmapRaw>,
}

impl SharedPage {
    /// Creates the file in the session's folder, with every flag raised and no part claimed.
    pub(crate) fn create(folder: impl AsFd) -> std::io::Result<SharedPage> {
        create_file(&folder, PAGE_FILE, &[0; PAGE_BYTES])?;
        let page = SharedPage::open(folder)?;
        (0..FLAG_COUNT).for_each(|reader| page.flag(reader).store(1, Ordering::SeqCst));
        Ok(page)
    }

    /// Maps the file that the host created.
    pub(crate) fn open(folder: impl AsFd) -> std::io::Result<SharedPage> {
        let flags = OFlags::RDWR | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let file = File::from(rustix::fs::openat(folder, PAGE_FILE, flags, Mode::empty())?);
        let map = MmapRaw::map_raw(&file)?;
        if map.len() != PAGE_BYTES {
            return Err(std::io::Error::other("the session's shared page has the wrong length"));
        }
        Ok(SharedPage { map: Arc::new(map) })
    }

    /// Raises the flag of a new reader, so that writers that gave up on its predecessor wake it.
    pub(crate) fn raise_for_new_reader(&self, reader: usize) {
        self.flag(reader).store(FLAG_NEW, Ordering::SeqCst);
    }

    pub(crate) fn flag(&self, reader: usize) -> &AtomicU32 {
        assert!(reader < FLAG_COUNT, "a session has {FLAG_COUNT} readers at most");
        // SAFETY: the mapping is page-aligned, PAGE_BYTES long (checked when mapped) and lives as long as
        // `self`; `reader` is in range, so the four bytes lie inside, before NODES_OFFSET, and are aligned.
        // Every process accesses them only through atomics of this size.
        unsafe { AtomicU32::from_ptr(self.map.as_mut_ptr().add(reader * FLAG_STRIDE).cast::<u32>()) }
    }

    /// Claims a part for a node unless another node has it. Returns whether the node now has it.
    ///
    /// A node's number is not 0 in either half: the upper one holds the process number, the lower one the
    /// node's creation time (iceoryx2-bb-posix 0.10, `UniqueSystemId`).
    pub(crate) fn claim(&self, part: Part, node: u128) -> bool {
        let [lower, upper] = self.node_words(part);
        // The upper half decides who has it; the lower one is written last and marks both as valid.
        let taken = upper.compare_exchange(0, (node >> 64) as u64, Ordering::Relaxed, Ordering::Relaxed);
        match taken {
            Ok(_) => {
                lower.store(node as u64, Ordering::Release);
                true
            }
            Err(_) => self.node_of(part) == Some(node),
        }
    }

    /// Returns a part's node; `None` before it is claimed.
    pub(crate) fn node_of(&self, part: Part) -> Option<u128> {
        let [lower, upper] = self.node_words(part);
        let below = lower.load(Ordering::Acquire);
        (below != 0).then(|| u128::from(upper.load(Ordering::Relaxed)) << 64 | u128::from(below))
    }

    fn node_words(&self, part: Part) -> [&AtomicU64; 2] {
        [0, 1].map(|word| {
            let offset = NODES_OFFSET + WORD * (2 * part as usize + word);
            // SAFETY: as for `flag`: `part as usize` is below the number of parts, so the eight bytes lie
            // inside the mapping, behind the flags, and are aligned. Every process accesses them only through
            // atomics of this size.
            unsafe { AtomicU64::from_ptr(self.map.as_mut_ptr().add(offset).cast::<u64>()) }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_is_claimed_once_and_known_to_all_though_the_folder_has_gone() {
        let folder = tempfile::tempdir().unwrap();
        let open =
            || rustix::fs::openat(rustix::fs::CWD, folder.path(), OFlags::DIRECTORY, Mode::empty()).unwrap();
        let host = SharedPage::create(open()).unwrap();
        let other = SharedPage::open(open()).unwrap();
        let (node, stranger) = ((7 << 64) | 11_u128, (8 << 64) | 12_u128);
        folder.close().unwrap();
        assert_eq!(other.node_of(Part::Physics), None);
        assert!(host.claim(Part::Physics, node) && host.claim(Part::Physics, node));
        assert!(!other.claim(Part::Physics, stranger));
        assert_eq!(Part::ALL.map(|part| other.node_of(part)).iter().flatten().collect::<Vec<_>>(), [&node]);
        assert!((0..FLAG_COUNT).all(|reader| other.flag(reader).load(Ordering::SeqCst) == 1));
    }

    /// If several programs claim a part at once, exactly one succeeds; reads are never torn.
    #[test]
    fn of_many_that_claim_a_part_one_gets_it() {
        let folder = tempfile::tempdir().unwrap();
        let page = SharedPage::create(
            rustix::fs::openat(rustix::fs::CWD, folder.path(), OFlags::DIRECTORY, Mode::empty()).unwrap(),
        )
        .unwrap();
        let nodes: Vec<u128> = (1..=8_u128).map(|number| (number << 64) | (number << 8)).collect();
        let winners: Vec<u128> = std::thread::scope(|scope| {
            let claims =
                nodes.iter().map(|node| scope.spawn(|| page.claim(Part::Drr, *node).then_some(*node)));
            let claims: Vec<_> = claims.collect();
            claims.into_iter().filter_map(|claim| claim.join().unwrap()).collect()
        });
        assert_eq!(winners.len(), 1);
        assert_eq!(page.node_of(Part::Drr), Some(winners[0]));
    }
}
