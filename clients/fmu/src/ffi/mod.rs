//! The C interfaces, by hand from the headers of FMI 2.0.4 and 3.0.2.
//!
//! An instance is a number in a table and passed as a pointer that is never followed; so is an FMU state in
//! its instance. The only memory of the caller's that is touched are arrays and texts that it passes, in the
//! call that passes them, and the environment of its log function, which is only handed back.

mod table;
mod three;
mod two;

pub use three::*;
pub use two::*;

use core::ffi::{CStr, c_char};

use crate::error::FmuError;

/// Status codes, the same in both versions.
mod status {
    pub const OK: i32 = 0;
    pub const ERROR: i32 = 3;
    pub const FATAL: i32 = 4;
}

/// Returns an array of the caller's.
///
/// # Safety
/// `first` is null or points at `count` values that are not written while the result is in use.
unsafe fn array<'a, T>(first: *const T, count: usize, name: &'static str) -> Result<&'a [T], FmuError> {
    match (count, first.is_null()) {
        (0, _) => Ok(&[]),
        (_, true) => Err(FmuError::Null(name)),
        // SAFETY: not null, and valid for `count` reads by this function's own contract.
        (_, false) => Ok(unsafe { core::slice::from_raw_parts(first, count) }),
    }
}

/// Returns an array of the caller's to write.
///
/// # Safety
/// `first` is null or points at `count` initialised values, used by nothing else while the result is in use.
unsafe fn room<'a, T>(first: *mut T, count: usize, name: &'static str) -> Result<&'a mut [T], FmuError> {
    match (count, first.is_null()) {
        (0, _) => Ok(&mut []),
        (_, true) => Err(FmuError::Null(name)),
        // SAFETY: not null, and valid for `count` reads and writes by this function's own contract.
        (_, false) => Ok(unsafe { core::slice::from_raw_parts_mut(first, count) }),
    }
}

/// Writes a result to the caller's variable, if it has given one.
///
/// # Safety
/// `out` is null or valid for writing a `T`.
unsafe fn put<T>(out: *mut T, value: T) {
    if !out.is_null() {
        // SAFETY: not null, and valid for writing by this function's own contract.
        unsafe { out.write(value) };
    }
}

/// Reads a text of the caller's.
///
/// # Safety
/// `text` is null or points at a text with a final NUL.
unsafe fn text(text: *const c_char, name: &'static str) -> Result<String, FmuError> {
    if text.is_null() {
        return Err(FmuError::Null(name));
    }
    // SAFETY: not null, and NUL-terminated by this function's own contract.
    let text = unsafe { CStr::from_ptr(text) };
    text.to_str().map(str::to_owned).map_err(|_| FmuError::Text(name))
}
