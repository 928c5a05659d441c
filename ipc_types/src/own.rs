//! What belongs to the process that made it, and not to a child that `fork` copies it into.
//!
//! A child of `fork` has every port of its parent in its memory, and would close them where it ends: the parent's places in
//! the services, its files and its shared memory would go. So each of them is an [`Own`], which only its maker cleans up.
//!
//! A process knows itself by a page that the kernel wipes in every child (`MADV_WIPEONFORK`): a look at it is one load,
//! where asking for the process number is a system call, and no way of forking goes past it.

use core::mem::ManuallyDrop;
use core::ops::{Deref, DerefMut};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

use memmap2::{MmapMut, MmapRaw};

/// Which process this is: another number in every child than in any of its ancestors.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Generation(u64);

impl Generation {
    /// That of the calling process.
    pub fn current() -> Generation {
        static PAGE: OnceLock<Option<MmapRaw>> = OnceLock::new();
        // Copied into a child as it is, so that the child counts on from its parent's number.
        static NEWEST: AtomicU64 = AtomicU64::new(0);
        let Some(page) = PAGE.get_or_init(wiped_page) else {
            return Generation(u64::from(std::process::id()));
        };
        // SAFETY: the mapping is a page long, aligned to it, and lives as long as the program, which reads and writes these
        // eight bytes through atomics only.
        let mark = unsafe { AtomicU64::from_ptr(page.as_mut_ptr().cast::<u64>()) };
        match mark.load(Ordering::Relaxed) {
            0 => {
                let next = NEWEST.fetch_add(1, Ordering::Relaxed) + 1;
                // Another thread may have been first.
                let set = mark.compare_exchange(0, next, Ordering::Relaxed, Ordering::Relaxed);
                Generation(set.err().unwrap_or(next))
            }
            known => Generation(known),
        }
    }
}

/// A page that is all zeros in a child; none where the kernel has no such pages (before Linux 4.14).
fn wiped_page() -> Option<MmapRaw> {
    let page: MmapRaw = MmapMut::map_anon(size_of::<u64>()).ok()?.into();
    // SAFETY: the range is that of a mapping which is private, anonymous and alive, and the advice changes nothing in this
    // process.
    let outcome = unsafe { libc::madvise(page.as_mut_ptr().cast(), page.len(), libc::MADV_WIPEONFORK) };
    (outcome == 0).then_some(page)
}

/// A value that is dropped only by the process that made it.
#[derive(Debug)]
pub struct Own<T> {
    value: ManuallyDrop<T>,
    made_by: Generation,
}

impl<T> Own<T> {
    /// Takes a value of this process.
    pub fn new(value: T) -> Own<T> {
        Own { value: ManuallyDrop::new(value), made_by: Generation::current() }
    }

    /// Whether this process has made it; if not, it is its parent's.
    pub fn is_ours(&self) -> bool {
        self.made_by == Generation::current()
    }
}

impl<T> Deref for Own<T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.value
    }
}

impl<T> DerefMut for Own<T> {
    fn deref_mut(&mut self) -> &mut T {
        &mut self.value
    }
}

impl<T> Drop for Own<T> {
    fn drop(&mut self) {
        if self.is_ours() {
            // SAFETY: this is the only place that drops the value, and nothing uses it behind the drop of its owner.
            unsafe { ManuallyDrop::drop(&mut self.value) };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Writes a byte to a pipe when it is dropped.
    #[derive(Debug)]
    struct Bell(std::io::PipeWriter);

    impl Drop for Bell {
        fn drop(&mut self) {
            use std::io::Write;
            let _ = self.0.write_all(b"x");
        }
    }

    #[test]
    fn a_child_of_fork_drops_nothing_of_its_parent() {
        use std::io::Read;
        let (mut heard, bell) = std::io::pipe().unwrap();
        let before = Generation::current();
        let own = Own::new(Bell(bell));
        assert!(own.is_ours());
        // SAFETY: the child allocates nothing, drops a value whose drop makes at most one system call, and ends with `_exit`.
        let child = unsafe { libc::fork() };
        if child == 0 {
            let is_foreign = !own.is_ours() && Generation::current() != before;
            let of_its_own = Own::new(0_u8).is_ours();
            drop(own);
            // SAFETY: as above.
            unsafe { libc::_exit(i32::from(!(is_foreign && of_its_own))) };
        }
        let mut status = -1;
        // SAFETY: the pointer is to an integer that outlives the call.
        unsafe { libc::waitpid(child, &raw mut status, 0) };
        assert_eq!(status, 0, "the child took its parent's value for its own");
        assert!(own.is_ours() && Generation::current() == before);
        drop(own);
        let mut rings = Vec::new();
        heard.read_to_end(&mut rings).unwrap();
        assert_eq!(rings, b"x", "dropped once, by its maker");
    }
}
