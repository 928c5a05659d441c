//! Instruction sets for the sum, selected at run time; all give the same bits.

use super::copies::{Copy3, Voxel};
use super::kernel::{Scalar, Work, sum_tiles};
use super::plan::ImagePlan;

/// An instruction set that this CPU supports.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Instructions(Set);

#[derive(Debug, Clone, Copy)]
enum Set {
    Scalar,
    #[cfg(target_arch = "x86_64")]
    Avx2(pulp::x86::V3),
    #[cfg(target_arch = "x86_64")]
    Avx512(pulp::x86::V4),
}

impl PartialEq for Set {
    fn eq(&self, other: &Self) -> bool {
        core::mem::discriminant(self) == core::mem::discriminant(other)
    }
}

impl Eq for Set {}

impl Instructions {
    /// No special instructions.
    pub const SCALAR: Self = Self(Set::Scalar);

    /// All instruction sets that this CPU supports, fastest first.
    pub fn available() -> Vec<Self> {
        let mut all = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            all.extend(pulp::x86::V4::try_new().map(|v4| Self(Set::Avx512(v4))));
            all.extend(pulp::x86::V3::try_new().map(|v3| Self(Set::Avx2(v3))));
        }
        all.push(Self::SCALAR);
        all
    }

    /// The fastest supported instruction set.
    pub fn best() -> Self {
        Self::available().first().copied().unwrap_or(Self::SCALAR)
    }

    /// `avx512`, `avx2` or `scalar`.
    pub fn name(self) -> &'static str {
        match self.0 {
            Set::Scalar => "scalar",
            #[cfg(target_arch = "x86_64")]
            Set::Avx2(_) => "avx2",
            #[cfg(target_arch = "x86_64")]
            Set::Avx512(_) => "avx512",
        }
    }

    /// Runs plain code that the compiler vectorises for this instruction set.
    pub(super) fn run<C: Plain>(self, code: C) {
        match self.0 {
            Set::Scalar => code.run(),
            #[cfg(target_arch = "x86_64")]
            Set::Avx2(v3) => v3.vectorize(Call(code)),
            #[cfg(target_arch = "x86_64")]
            Set::Avx512(v4) => v4.vectorize(Call(code)),
        }
    }

    /// Sums a group of tiles.
    pub(super) fn sum_tiles<T: Voxel>(
        self,
        copy: &Copy3<T>,
        plan: &ImagePlan,
        flush_after: usize,
        first_row: usize,
        work: &mut Work,
        out: &mut [i64],
    ) {
        let tiles = Tiles { copy, plan, flush_after, first_row, work, out };
        match self.0 {
            Set::Scalar => tiles.sum(Scalar),
            #[cfg(target_arch = "x86_64")]
            Set::Avx2(v3) => v3.vectorize(With(super::x86::Avx2(v3), tiles)),
            #[cfg(target_arch = "x86_64")]
            Set::Avx512(v4) => v4.vectorize(With(super::x86::Avx512(v4), tiles)),
        }
    }
}

/// Code for [`Instructions::run`]. A closure would not be inlined into the function that enables the
/// instruction set.
pub(super) trait Plain {
    /// Implementations must be `#[inline(always)]`.
    fn run(self);
}

#[cfg(target_arch = "x86_64")]
struct Call<C>(C);

#[cfg(target_arch = "x86_64")]
impl<C: Plain> pulp::NullaryFnOnce for Call<C> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.0.run();
    }
}

struct Tiles<'a, T: Voxel> {
    copy: &'a Copy3<T>,
    plan: &'a ImagePlan,
    flush_after: usize,
    first_row: usize,
    work: &'a mut Work,
    out: &'a mut [i64],
}

impl<T: Voxel> Tiles<'_, T> {
    #[inline(always)]
    fn sum<L: super::kernel::Lanes>(self, lanes: L) {
        sum_tiles(lanes, self.copy, self.plan, self.flush_after, self.first_row, self.work, self.out);
    }
}

/// A call that must be inlined into the function that enables the instruction set.
#[cfg(target_arch = "x86_64")]
struct With<'a, L, T: Voxel>(L, Tiles<'a, T>);

#[cfg(target_arch = "x86_64")]
impl<L: super::kernel::Lanes, T: Voxel> pulp::NullaryFnOnce for With<'_, L, T> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.1.sum(self.0);
    }
}
