//! FMI 3.0.

use core::ffi::{c_char, c_int, c_void};
use std::ffi::CString;
use std::path::Path;

use super::table::{self, Handle, LogMessage, with};
use super::{array, put, room, text};
use crate::error::FmuError;
use crate::instance::{Instance, Value};
use crate::variables::Kind;

type Log3 = Option<unsafe extern "C" fn(*mut c_void, c_int, *const c_char, *const c_char)>;

/// Name of the category of all messages, from the model description.
const CATEGORY: &core::ffi::CStr = c"logStatusError";

fn logger(log: Log3) -> LogMessage {
    Box::new(move |environment, status, text| {
        let Some(log) = log else { return };
        let text = CString::new(text.replace('\0', " ")).unwrap_or_default();
        // SAFETY: the caller's own function, with its own environment and texts that live through the call.
        unsafe { log(environment, status, CATEGORY.as_ptr(), text.as_ptr()) };
    })
}

/// Version of the interface.
#[unsafe(no_mangle)]
pub extern "C" fn fmi3GetVersion() -> *const c_char {
    c"3.0".as_ptr()
}

/// Creates an instance for co-simulation; null on failure.
///
/// # Safety
/// The texts are null or NUL-terminated; `log` is null or a function of the standard's type.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3InstantiateCoSimulation(
    _name: *const c_char,
    token: *const c_char,
    resources: *const c_char,
    _visible: bool,
    _logging: bool,
    _event_mode: bool,
    _early_return: bool,
    _intermediate: *const u32,
    _intermediate_count: usize,
    environment: *mut c_void,
    log: Log3,
    _update: *const c_void,
) -> Handle {
    table::create(logger(log), environment, || {
        // SAFETY: null or NUL-terminated, as the standard says.
        let (token, resources) =
            unsafe { (text(token, "instantiationToken")?, text(resources, "resourcePath")?) };
        Instance::new(Path::new(&resources), &token)
    })
}

/// Not offered: null.
#[unsafe(no_mangle)]
pub extern "C" fn fmi3InstantiateModelExchange(
    _name: *const c_char,
    _token: *const c_char,
    _resources: *const c_char,
    _visible: bool,
    _logging: bool,
    _environment: *mut c_void,
    _log: *const c_void,
) -> Handle {
    core::ptr::null_mut()
}

/// Not offered: null.
#[unsafe(no_mangle)]
pub extern "C" fn fmi3InstantiateScheduledExecution(
    _name: *const c_char,
    _token: *const c_char,
    _resources: *const c_char,
    _visible: bool,
    _logging: bool,
    _environment: *mut c_void,
    _log: *const c_void,
    _clock_update: *const c_void,
    _lock: *const c_void,
    _unlock: *const c_void,
) -> Handle {
    core::ptr::null_mut()
}

/// Frees an instance with its FMU states.
#[unsafe(no_mangle)]
pub extern "C" fn fmi3FreeInstance(instance: Handle) {
    table::free(instance);
}

/// Accepted; errors are always logged.
#[unsafe(no_mangle)]
pub extern "C" fn fmi3SetDebugLogging(
    instance: Handle,
    _on: bool,
    _count: usize,
    _categories: *const *const c_char,
) -> c_int {
    with(instance, |_| Ok(()))
}

/// Begins initialisation at a start time.
#[unsafe(no_mangle)]
pub extern "C" fn fmi3EnterInitializationMode(
    instance: Handle,
    _tolerance_defined: bool,
    _tolerance: f64,
    start_s: f64,
    _stop_defined: bool,
    _stop_s: f64,
) -> c_int {
    with(instance, |it| it.initialise(start_s))
}

/// Ends initialisation.
#[unsafe(no_mangle)]
pub extern "C" fn fmi3ExitInitializationMode(instance: Handle) -> c_int {
    with(instance, Instance::begin)
}

/// Ends the simulation.
#[unsafe(no_mangle)]
pub extern "C" fn fmi3Terminate(instance: Handle) -> c_int {
    with(instance, Instance::terminate)
}

/// Returns to the state after instantiation.
#[unsafe(no_mangle)]
pub extern "C" fn fmi3Reset(instance: Handle) -> c_int {
    with(instance, Instance::reset)
}

/// Runs the ticks of a step.
///
/// # Safety
/// The last four are null or valid for writing.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3DoStep(
    instance: Handle,
    from_s: f64,
    step_s: f64,
    _no_earlier_state: bool,
    event_needed: *mut bool,
    terminate: *mut bool,
    early_return: *mut bool,
    last_s: *mut f64,
) -> c_int {
    with(instance, |it| {
        let now_s = it.step(from_s, step_s)?;
        // SAFETY: null or valid for writing, as the standard says.
        unsafe {
            put(event_needed, false);
            put(terminate, false);
            put(early_return, false);
            put(last_s, now_s);
        }
        Ok(())
    })
}

macro_rules! numbers {
    ($($get:ident $set:ident $type:ty, $kind:ident, $out:expr, $in:expr;)*) => {$(
        /// Reads variables of this type.
        ///
        /// # Safety
        /// The arrays are null or have the stated lengths.
        #[unsafe(no_mangle)]
        pub unsafe extern "C" fn $get(
            instance: Handle,
            references: *const u32,
            count: usize,
            values: *mut $type,
            value_count: usize,
        ) -> c_int {
            with(instance, |it| {
                // SAFETY: null or of the stated lengths, as the standard says.
                let (references, values) = unsafe {
                    (array(references, count, "valueReferences")?, room(values, value_count, "values")?)
                };
                let mut next = 0;
                for reference in references {
                    let (kind, found) = it.get(*reference, true)?;
                    if kind != Kind::$kind {
                        return Err(FmuError::NoVariable { kind: stringify!($kind), reference: *reference });
                    }
                    for value in found {
                        let short = FmuError::Count { given: value_count, expected: next + 1 };
                        *values.get_mut(next).ok_or(short)? = $out(value);
                        next += 1;
                    }
                }
                match next == value_count {
                    true => Ok(()),
                    false => Err(FmuError::Count { given: value_count, expected: next }),
                }
            })
        }

        /// Sets variables of this type.
        ///
        /// # Safety
        /// The arrays are null or have the stated lengths.
        #[unsafe(no_mangle)]
        pub unsafe extern "C" fn $set(
            instance: Handle,
            references: *const u32,
            count: usize,
            values: *const $type,
            value_count: usize,
        ) -> c_int {
            with(instance, |it| {
                // SAFETY: null or of the stated lengths, as the standard says.
                let (references, mut values) = unsafe {
                    (array(references, count, "valueReferences")?, array(values, value_count, "values")?)
                };
                for reference in references {
                    let (variable, _, elements) = it.find(*reference, true)?;
                    if variable.kind != Kind::$kind {
                        return Err(FmuError::NoVariable { kind: stringify!($kind), reference: *reference });
                    }
                    let short = FmuError::Count { given: value_count, expected: elements };
                    let (own, rest) = values.split_at_checked(elements).ok_or(short)?;
                    values = rest;
                    let own: Vec<Value> = own.iter().map(|value| $in(*value)).collect();
                    it.set(*reference, true, &own)?;
                }
                match values.is_empty() {
                    true => Ok(()),
                    false => Err(FmuError::Count { given: value_count, expected: value_count - values.len() }),
                }
            })
        }
    )*};
}

fn whole(value: Value) -> u64 {
    if let Value::Whole(value) = value { value } else { 0 }
}

numbers! {
    fmi3GetFloat64 fmi3SetFloat64 f64, Float64, Value::as_f64, Value::Float;
    fmi3GetUInt32 fmi3SetUInt32 u32, UInt32, |value| whole(value) as u32, |value: u32| Value::Whole(value.into());
    fmi3GetUInt64 fmi3SetUInt64 u64, UInt64, whole, Value::Whole;
    fmi3GetInt64 fmi3SetInt64 i64, Int64,
        |value| if let Value::Signed(value) = value { value } else { 0 }, Value::Signed;
    fmi3GetBoolean fmi3SetBoolean u8, Boolean,
        |value| u8::from(value == Value::Flag(true)), |value: u8| Value::Flag(value != 0);
}

/// Reads texts, which stay valid until the next call with this instance.
///
/// # Safety
/// The arrays are null or have the stated lengths.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3GetString(
    instance: Handle,
    references: *const u32,
    count: usize,
    values: *mut *const c_char,
    value_count: usize,
) -> c_int {
    with(instance, |it| {
        // SAFETY: null or of the stated lengths, as the standard says.
        let (references, values) =
            unsafe { (array(references, count, "valueReferences")?, room(values, value_count, "values")?) };
        if count != value_count {
            return Err(FmuError::Count { given: value_count, expected: count });
        }
        let texts: Result<Vec<String>, FmuError> =
            references.iter().map(|reference| it.text(*reference)).collect();
        it.texts = texts?.into_iter().map(|text| CString::new(text).unwrap_or_default()).collect();
        values.iter_mut().zip(&it.texts).for_each(|(value, text)| *value = text.as_ptr());
        Ok(())
    })
}

/// Renders frames; they stay valid until the next call with this instance.
///
/// # Safety
/// The arrays are null or have the stated lengths.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3GetBinary(
    instance: Handle,
    references: *const u32,
    count: usize,
    sizes: *mut usize,
    values: *mut *const u8,
    value_count: usize,
) -> c_int {
    with(instance, |it| {
        // SAFETY: null or of the stated lengths, as the standard says.
        let (references, sizes, values) = unsafe {
            (
                array(references, count, "valueReferences")?,
                room(sizes, value_count, "valueSizes")?,
                room(values, value_count, "values")?,
            )
        };
        let ([reference], [size], [value]) = (references, sizes, values) else {
            return Err(FmuError::Count { given: count.max(value_count), expected: 1 });
        };
        it.frame = it.binary(*reference)?;
        (*size, *value) = (it.frame.len(), it.frame.as_ptr());
        Ok(())
    })
}

/// Saves the state; `state` receives it, and an earlier one in it is overwritten.
///
/// # Safety
/// `state` is null or valid for reading and writing.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3GetFMUState(instance: Handle, state: *mut Handle) -> c_int {
    with(instance, |it| {
        // SAFETY: null or one initialised value, as the standard says.
        let state = unsafe { room(state, 1, "FMUState")? };
        state[0] = table::handle(it.save(table::number(state[0]))?);
        Ok(())
    })
}

/// Returns to a saved state.
#[unsafe(no_mangle)]
pub extern "C" fn fmi3SetFMUState(instance: Handle, state: Handle) -> c_int {
    with(instance, |it| it.restore(table::number(state)))
}

/// Frees a saved state; null is ignored.
///
/// # Safety
/// `state` is null or valid for reading and writing.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3FreeFMUState(instance: Handle, state: *mut Handle) -> c_int {
    with(instance, |it| {
        if state.is_null() {
            return Ok(());
        }
        // SAFETY: one initialised value, as the standard says.
        let state = unsafe { room(state, 1, "FMUState")? };
        if !state[0].is_null() {
            it.free(table::number(state[0]))?;
            state[0] = core::ptr::null_mut();
        }
        Ok(())
    })
}

/// Returns the size of a saved state as bytes.
///
/// # Safety
/// `size` is null or valid for writing.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3SerializedFMUStateSize(
    instance: Handle,
    state: Handle,
    size: *mut usize,
) -> c_int {
    with(instance, |it| {
        let length = it.serialise(table::number(state))?.len();
        // SAFETY: null or valid for writing, as the standard says.
        unsafe { put(size, length) };
        Ok(())
    })
}

/// Writes a saved state as bytes.
///
/// # Safety
/// `bytes` is null or has `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3SerializeFMUState(
    instance: Handle,
    state: Handle,
    bytes: *mut u8,
    size: usize,
) -> c_int {
    with(instance, |it| {
        let content = it.serialise(table::number(state))?;
        // SAFETY: null or of the stated length, as the standard says.
        let bytes = unsafe { room(bytes, size, "serializedState")? };
        let short = FmuError::Count { given: size, expected: content.len() };
        bytes.get_mut(..content.len()).ok_or(short)?.copy_from_slice(&content);
        Ok(())
    })
}

/// Saves the state that bytes describe.
///
/// # Safety
/// `bytes` is null or has `size` bytes; `state` is null or valid for writing.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3DeserializeFMUState(
    instance: Handle,
    bytes: *const u8,
    size: usize,
    state: *mut Handle,
) -> c_int {
    with(instance, |it| {
        // SAFETY: null or of the stated length, as the standard says.
        let bytes = unsafe { array(bytes, size, "serializedState")? };
        let number = it.deserialise(bytes)?;
        // SAFETY: null or valid for writing, as the standard says.
        unsafe { put(state, table::handle(number)) };
        Ok(())
    })
}

/// Returns the derivative of outputs at the end of a tick by inputs held during it, times a seed.
///
/// # Safety
/// The arrays are null or have the stated lengths.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3GetDirectionalDerivative(
    instance: Handle,
    unknowns: *const u32,
    unknown_count: usize,
    knowns: *const u32,
    known_count: usize,
    seed: *const f64,
    seed_count: usize,
    sensitivity: *mut f64,
    sensitivity_count: usize,
) -> c_int {
    with(instance, |it| {
        // SAFETY: null or of the stated lengths, as the standard says.
        let (unknowns, knowns, seed, sensitivity) = unsafe {
            (
                array(unknowns, unknown_count, "unknowns")?,
                array(knowns, known_count, "knowns")?,
                array(seed, seed_count, "seed")?,
                room(sensitivity, sensitivity_count, "sensitivity")?,
            )
        };
        let found = it.derivative(unknowns, knowns, seed, true)?;
        if found.len() != sensitivity.len() {
            return Err(FmuError::Count { given: sensitivity.len(), expected: found.len() });
        }
        sensitivity.copy_from_slice(&found);
        Ok(())
    })
}

macro_rules! unsupported {
    ($($name:ident($($type:ty),*);)*) => {$(
        /// Not offered: an error.
        #[unsafe(no_mangle)]
        pub extern "C" fn $name(instance: Handle $(, _: $type)*) -> c_int {
            with(instance, |_| Err(FmuError::Unsupported(stringify!($name))))
        }
    )*};
}

unsupported! {
    fmi3EnterEventMode();
    fmi3GetFloat32(*const u32, usize, *mut f32, usize);
    fmi3GetInt8(*const u32, usize, *mut i8, usize);
    fmi3GetUInt8(*const u32, usize, *mut u8, usize);
    fmi3GetInt16(*const u32, usize, *mut i16, usize);
    fmi3GetUInt16(*const u32, usize, *mut u16, usize);
    fmi3GetInt32(*const u32, usize, *mut i32, usize);
    fmi3GetClock(*const u32, usize, *mut bool);
    fmi3SetFloat32(*const u32, usize, *const f32, usize);
    fmi3SetInt8(*const u32, usize, *const i8, usize);
    fmi3SetUInt8(*const u32, usize, *const u8, usize);
    fmi3SetInt16(*const u32, usize, *const i16, usize);
    fmi3SetUInt16(*const u32, usize, *const u16, usize);
    fmi3SetInt32(*const u32, usize, *const i32, usize);
    fmi3SetString(*const u32, usize, *const *const c_char, usize);
    fmi3SetBinary(*const u32, usize, *const usize, *const *const u8, usize);
    fmi3SetClock(*const u32, usize, *const bool);
    fmi3GetNumberOfVariableDependencies(u32, *mut usize);
    fmi3GetVariableDependencies(u32, *mut usize, *mut u32, *mut usize, *mut c_int, usize);
    fmi3GetAdjointDerivative(*const u32, usize, *const u32, usize, *const f64, usize, *mut f64, usize);
    fmi3EnterConfigurationMode();
    fmi3ExitConfigurationMode();
    fmi3GetIntervalDecimal(*const u32, usize, *mut f64, *mut c_int);
    fmi3GetIntervalFraction(*const u32, usize, *mut u64, *mut u64, *mut c_int);
    fmi3GetShiftDecimal(*const u32, usize, *mut f64);
    fmi3GetShiftFraction(*const u32, usize, *mut u64, *mut u64);
    fmi3SetIntervalDecimal(*const u32, usize, *const f64);
    fmi3SetIntervalFraction(*const u32, usize, *const u64, *const u64);
    fmi3SetShiftDecimal(*const u32, usize, *const f64);
    fmi3SetShiftFraction(*const u32, usize, *const u64, *const u64);
    fmi3EvaluateDiscreteStates();
    fmi3UpdateDiscreteStates(*mut bool, *mut bool, *mut bool, *mut bool, *mut bool, *mut f64);
    fmi3EnterContinuousTimeMode();
    fmi3CompletedIntegratorStep(bool, *mut bool, *mut bool);
    fmi3SetTime(f64);
    fmi3SetContinuousStates(*const f64, usize);
    fmi3GetContinuousStateDerivatives(*mut f64, usize);
    fmi3GetEventIndicators(*mut f64, usize);
    fmi3GetContinuousStates(*mut f64, usize);
    fmi3GetNominalsOfContinuousStates(*mut f64, usize);
    fmi3GetNumberOfEventIndicators(*mut usize);
    fmi3GetNumberOfContinuousStates(*mut usize);
    fmi3EnterStepMode();
    fmi3GetOutputDerivatives(*const u32, usize, *const i32, *mut f64, usize);
    fmi3ActivateModelPartition(u32, f64);
}
