//! A large array in memory from the [`Machine`]. It is read end to end, many rows at a time, so address
//! translation costs time with ordinary pages but not with huge pages.

use std::marker::PhantomData;
use std::ops::{Deref, DerefMut};

use zerocopy::{FromBytes, Immutable, IntoBytes};

use crate::machine::{Machine, Memory};

/// A zero-initialised array.
pub(crate) struct Array<T> {
    memory: Box<dyn Memory>,
    bytes: usize,
    of: PhantomData<T>,
}

impl<T: FromBytes + IntoBytes + Immutable> Array<T> {
    /// `length` elements; `None` if the machine has too little memory.
    pub fn zeroed(machine: &dyn Machine, length: usize) -> Option<Self> {
        let bytes = length.checked_mul(size_of::<T>())?;
        let memory = machine.zeroed(bytes)?;
        // Without this check, memory that is too short or misaligned would later read as empty.
        let fits = memory.bytes().get(..bytes).is_some_and(|bytes| <[T]>::ref_from_bytes(bytes).is_ok());
        fits.then_some(Self { memory, bytes, of: PhantomData })
    }
}

impl<T: FromBytes + IntoBytes + Immutable> Deref for Array<T> {
    type Target = [T];

    #[inline(always)]
    fn deref(&self) -> &[T] {
        let bytes = self.memory.bytes().get(..self.bytes);
        bytes.and_then(|bytes| <[T]>::ref_from_bytes(bytes).ok()).unwrap_or(&[])
    }
}

impl<T: FromBytes + IntoBytes + Immutable> DerefMut for Array<T> {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut [T] {
        let bytes = self.memory.bytes_mut().get_mut(..self.bytes);
        bytes.and_then(|bytes| <[T]>::mut_from_bytes(bytes).ok()).unwrap_or(&mut [])
    }
}
