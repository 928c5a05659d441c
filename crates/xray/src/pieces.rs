//! Splits rows of voxels into pieces, so that pieces in which nothing attenuates are skipped without lookups.

/// Voxels of a row compared at a time.
pub(crate) const PIECE: usize = 64;

/// The pieces of a row with a voxel of at least `least`, each with the index of its first voxel.
pub(crate) fn pieces_from<T: Copy + PartialOrd>(
    row: &[T],
    least: T,
) -> impl DoubleEndedIterator<Item = (usize, &[T])> {
    // Without an early exit, the compiler compares many voxels at a time.
    let may = move |voxels: &[T]| voxels.iter().fold(false, |may, voxel| may | (*voxel >= least));
    (0..row.len()).step_by(PIECE).zip(row.chunks(PIECE)).filter(move |(_, voxels)| may(voxels))
}

/// The lowest Hounsfield value that attenuates; `i16::MAX` if none does.
pub(crate) fn least_hu(attenuates: impl Fn(i16) -> bool) -> i16 {
    (i16::MIN..i16::MAX).find(|hu| attenuates(*hu)).unwrap_or(i16::MAX)
}
