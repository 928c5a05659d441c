//! Chooses the cores of the two sides. A side started while this thread is bound inherits its core.

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

use super::super::failed;
use trabecula::failure::Failure;

/// Cores of the two sides.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cores {
    /// Each side has its own core.
    Two,
    /// Both sides share a core.
    One,
}

impl Cores {
    /// The arrangements that this machine allows.
    pub(super) fn available() -> Vec<Cores> {
        if allowed().len() > 1 { vec![Cores::Two, Cores::One] } else { vec![Cores::One] }
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Cores::Two => "on two cores",
            Cores::One => "on one core",
        }
    }

    /// Runs `start` bound to the other side's core, then binds this side to its own.
    pub(super) fn apart<T>(self, start: impl FnOnce() -> Result<T, Failure>) -> Result<T, Failure> {
        let all = allowed();
        let mine = all.first().copied().unwrap_or(0);
        let theirs = if self == Cores::Two { all.get(1).copied().unwrap_or(mine) } else { mine };
        bind(&[theirs])?;
        let started = start();
        bind(&[mine])?;
        started
    }
}

/// Returns the cores allowed when this process started.
fn allowed() -> Vec<usize> {
    static ALLOWED: std::sync::OnceLock<Vec<usize>> = std::sync::OnceLock::new();
    let read = || {
        let set = sched_getaffinity(None).unwrap_or_else(|_| CpuSet::new());
        (0..CpuSet::MAX_CPU).filter(|core| set.is_set(*core)).collect()
    };
    ALLOWED.get_or_init(read).clone()
}

fn bind(cores: &[usize]) -> Result<(), Failure> {
    let mut set = CpuSet::new();
    cores.iter().for_each(|core| set.set(*core));
    sched_setaffinity(None, &set).map_err(failed)
}

/// Restores this thread's original cores.
pub(super) fn release() {
    // It was allowed to run there before.
    let _ = bind(&allowed());
}
