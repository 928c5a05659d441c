//! Ticks, ranges of ticks and controllers as types of their own, where one integer could be taken for
//! another.

use core::fmt::{self, Display, Formatter};
use core::ops::AddAssign;

/// A tick: the number of a state, x_k. Messages carry it as a plain `u64`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Tick(pub u64);

impl Tick {
    /// The initial state's.
    pub const START: Tick = Tick(0);

    /// The tick so many ticks before, but not before the start.
    pub const fn saturating_sub(self, ticks: u64) -> Tick {
        Tick(self.0.saturating_sub(ticks))
    }

    /// The tick so many ticks later, but not after the last number.
    pub const fn saturating_add(self, ticks: u64) -> Tick {
        Tick(self.0.saturating_add(ticks))
    }

    /// Ticks from `earlier` to this one; 0 if that one is later.
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
    /// The last tick; none if the range has no end.
    pub last: Option<Tick>,
}

impl TickRange {
    /// All ticks.
    pub const ALL: TickRange = TickRange { first: Tick::START, last: None };

    /// Whether a tick is one of them.
    pub fn contains(&self, tick: Tick) -> bool {
        tick >= self.first && self.last.is_none_or(|last| tick <= last)
    }
}

/// Index of a controller in the scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct ControllerIndex(pub u32);

impl ControllerIndex {
    /// As an index of arrays and lists of controllers.
    pub const fn slot(self) -> usize {
        self.0 as usize
    }

    /// The first `count` controllers, in the scene's order.
    pub fn first(count: usize) -> impl Iterator<Item = ControllerIndex> {
        (0..count as u32).map(ControllerIndex)
    }
}

impl Display for ControllerIndex {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}
