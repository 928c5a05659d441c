//! Large arrays in huge pages where the system grants them: they are read from one end to the other, many rows at a time, and
//! would otherwise wait for the tables of their pages.

use std::marker::PhantomData;
use std::ops::{Deref, DerefMut};

use memmap2::MmapMut;
use zerocopy::{FromBytes, Immutable, IntoBytes};

/// An array that begins as zeros.
pub(crate) struct Pages<T> {
    map: MmapMut,
    bytes: usize,
    of: PhantomData<T>,
}

impl<T: FromBytes + IntoBytes + Immutable> Pages<T> {
    /// As many elements as told.
    pub fn zeroed(length: usize) -> std::io::Result<Self> {
        let bytes = length * size_of::<T>();
        // An empty mapping is refused.
        let map = MmapMut::map_anon(bytes.max(1))?;
        // A kernel without huge pages refuses this, and all works as well with small ones.
        #[cfg(target_os = "linux")]
        map.advise(memmap2::Advice::HugePage).ok();
        Ok(Self { map, bytes, of: PhantomData })
    }
}

impl<T: FromBytes + IntoBytes + Immutable> Deref for Pages<T> {
    type Target = [T];

    #[inline(always)]
    fn deref(&self) -> &[T] {
        // A mapping begins at a page, so the alignment fits, and the bytes are a whole number of elements.
        self.map.get(..self.bytes).and_then(|bytes| <[T]>::ref_from_bytes(bytes).ok()).unwrap_or(&[])
    }
}

impl<T: FromBytes + IntoBytes + Immutable> DerefMut for Pages<T> {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut [T] {
        let bytes = self.map.get_mut(..self.bytes);
        bytes.and_then(|bytes| <[T]>::mut_from_bytes(bytes).ok()).unwrap_or(&mut [])
    }
}
