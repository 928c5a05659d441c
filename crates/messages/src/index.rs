//! Newtypes for ticks, tick ranges and controllers, so that one integer cannot be mistaken for another.

use core::fmt::{self, Display, Formatter};
use core::ops::AddAssign;

/// A tick: the number of a state, x_k. Messages carry it as a plain `u64`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Tick(pub u64);

impl Tick {
    /// The tick of the initial state.
    pub const START: Tick = Tick(0);

    /// Returns the tick `ticks` earlier, at least [`Tick::START`].
    pub const fn saturating_sub(self, ticks: u64) -> Tick {
        Tick(self.0.saturating_sub(ticks))
    }

    /// Returns the tick `ticks` later, at most the largest number.
    pub const fn saturating_add(self, ticks: u64) -> Tick {
        Tick(self.0.saturating_add(ticks))
    }

    /// Returns the number of ticks from `earlier` to this one; 0 if `earlier` is later.
    pub const fn since(self, earlier: Tick) -> u64 {
        self.0.saturating_sub(earlier.0)
    }
}

impl AddAssign<u64> for Tick {
    fn add_assign(&mut self, ticks: u64) {
        self.0 += ticks;
    }
}

impl Display for Tick {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// Ticks from the first to the last, both inclusive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TickRange {
    /// The first tick.
    pub first: Tick,
    /// The last tick; `None` if the range is unbounded.
    pub last: Option<Tick>,
}

impl TickRange {
    /// All ticks.
    pub const ALL: TickRange = TickRange { first: Tick::START, last: None };

    /// Returns whether the range contains a tick.
    pub fn contains(&self, tick: Tick) -> bool {
        tick >= self.first && self.last.is_none_or(|last| tick <= last)
    }
}

/// Index of a controller in the scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct ControllerIndex(pub u32);

impl ControllerIndex {
    /// Returns it as an index into arrays and lists of controllers.
    pub const fn slot(self) -> usize {
        self.0 as usize
    }

    /// Returns the indices of the first `count` controllers, in the scene's order.
    pub fn first(count: usize) -> impl Iterator<Item = ControllerIndex> {
        (0..count as u32).map(ControllerIndex)
    }
}

impl Display for ControllerIndex {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}
