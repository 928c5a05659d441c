//! Resources that belong to the process that created them and not to its `fork` children.
//!
//! A `fork` child has a copy of every port of its parent and would close them when it ends, freeing the
//! parent's slots in the services, its files and its shared memory. Each of these is therefore an
//! [`ProcessOwned`], which only its creator cleans up.
//!
//! A process recognises itself by a page that the kernel zeroes in every child (`MADV_WIPEONFORK`). Checking
//! it is one load, where `getpid` is a system call, and it works however the process forks.

use core::mem::ManuallyDrop;
use core::ops::{Deref, DerefMut};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

use memmap2::{MmapMut, MmapRaw};

/// Identifies a process: each child's number differs from all of its ancestors'.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Generation(u64);

impl Generation {
    /// Returns the calling process's number.
    pub fn current() -> Generation {
        static PAGE: OnceLock<Option<MmapRaw>> = OnceLock::new();
        // A child inherits it and continues from its parent's number.
        static NEWEST: AtomicU64 = AtomicU64::new(0);
        let Some(page) = PAGE.get_or_init(wiped_page) else {
            return Generation(u64::from(std::process::id()));
        };
        // SAFETY: the mapping is one page long, page-aligned, and lives as long as the program, which reads
        // and writes these eight bytes only through atomics.
        let mark = unsafe { AtomicU64::from_ptr(page.as_mut_ptr().cast::<u64>()) };
        match mark.load(Ordering::Relaxed) {
            0 => {
                let next = NEWEST.fetch_add(1, Ordering::Relaxed) + 1;
                // Another thread may have set it first.
                let set = mark.compare_exchange(0, next, Ordering::Relaxed, Ordering::Relaxed);
                Generation(set.err().unwrap_or(next))
            }
            known => Generation(known),
        }
    }
}

/// Maps a page that is zeroed in a child; `None` if the kernel cannot do that (before Linux 4.14).
fn wiped_page() -> Option<MmapRaw> {
    let page: MmapRaw = MmapMut::map_anon(size_of::<u64>()).ok()?.into();
    // SAFETY: the range is a live, private, anonymous mapping, and the advice changes nothing in this
    // process.
    let outcome = unsafe { libc::madvise(page.as_mut_ptr().cast(), page.len(), libc::MADV_WIPEONFORK) };
    (outcome == 0).then_some(page)
}

/// A value that only its creating process drops.
#[derive(Debug)]
pub struct ProcessOwned<T> {
    value: ManuallyDrop<T>,
    made_by: Generation,
    /// `ManuallyDrop::drop`. Called through a pointer, the code that drops a `T` is compiled once, where the
    /// value is created, and not in every crate that drops one: a port of the transport takes rustc seconds.
    drop: unsafe fn(&mut ManuallyDrop<T>),
}

impl<T> ProcessOwned<T> {
    /// Wraps a value; this process becomes its owner.
    pub fn new(value: T) -> ProcessOwned<T> {
        ProcessOwned {
            value: ManuallyDrop::new(value),
            made_by: Generation::current(),
            drop: ManuallyDrop::<T>::drop,
        }
    }

    /// Returns whether this process owns it; if not, its parent does.
    pub fn is_ours(&self) -> bool {
        self.made_by == Generation::current()
    }
}

impl<T> Deref for ProcessOwned<T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.value
    }
}

impl<T> DerefMut for ProcessOwned<T> {
    fn deref_mut(&mut self) -> &mut T {
        &mut self.value
    }
}

impl<T> Drop for ProcessOwned<T> {
    fn drop(&mut self) {
        if self.is_ours() {
            // SAFETY: nothing else drops the value, and nothing uses it after its owner's drop.
            unsafe { (self.drop)(&mut self.value) };
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
        let own = ProcessOwned::new(Bell(bell));
        assert!(own.is_ours());
        // SAFETY: the child allocates nothing, drops a value whose drop makes at most one system call, and
        // exits with `_exit`.
        let child = unsafe { libc::fork() };
        if child == 0 {
            let is_foreign = !own.is_ours() && Generation::current() != before;
            let of_its_own = ProcessOwned::new(0_u8).is_ours();
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
