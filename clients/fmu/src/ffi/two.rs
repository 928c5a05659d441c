//! FMI 2.0.

use core::ffi::{c_char, c_int, c_void};
use std::ffi::CString;
use std::path::PathBuf;

use super::table::{self, Handle, LogMessage, with};
use super::{array, put, room, text};
use crate::description::kind_of_two;
use crate::error::FmuError;
use crate::instance::{Instance, Value};
use crate::variables::Kind;

type Log2 =
    Option<unsafe extern "C" fn(*mut c_void, *const c_char, c_int, *const c_char, *const c_char, ...)>;

/// Functions of the caller, `fmi2CallbackFunctions`; the others are never called.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct Callbacks2 {
    /// Takes messages.
    pub logger: Log2,
    /// Unused.
    pub allocate_memory: *const c_void,
    /// Unused.
    pub free_memory: *const c_void,
    /// Unused.
    pub step_finished: *const c_void,
    /// Handed back to the logger.
    pub environment: *mut c_void,
}

/// `fmi2CoSimulation`.
const CO_SIMULATION: c_int = 1;

fn logger(log: Log2, name: String) -> LogMessage {
    Box::new(move |environment, status, text| {
        let Some(log) = log else { return };
        let text = CString::new(text.replace('\0', " ")).unwrap_or_default();
        let name = CString::new(name.replace('\0', " ")).unwrap_or_default();
        // SAFETY: the caller's own function, with its own environment and texts that live through the call;
        // the format takes the one further argument that is given.
        unsafe {
            log(
                environment,
                name.as_ptr(),
                status,
                c"logStatusError".as_ptr(),
                c"%s".as_ptr(),
                text.as_ptr(),
            );
        }
    })
}

/// Returns the path of a `file:` URI, percent-decoded.
fn path_of(uri: &str) -> Result<PathBuf, FmuError> {
    let refused = || FmuError::File { path: uri.to_owned(), reason: "not a `file:` URI".to_owned() };
    let rest = uri.strip_prefix("file:").ok_or_else(refused)?;
    let path = match rest.strip_prefix("//") {
        // An authority, empty or `localhost`, ends at the path.
        Some(rest) => &rest[rest.find('/').ok_or_else(refused)?..],
        None => rest,
    };
    let (mut bytes, mut rest) = (Vec::new(), path.as_bytes());
    while let Some((first, after)) = rest.split_first() {
        let code = after.get(..2).and_then(|code| std::str::from_utf8(code).ok());
        match code.and_then(|code| u8::from_str_radix(code, 16).ok()).filter(|_| *first == b'%') {
            Some(byte) => {
                bytes.push(byte);
                rest = &after[2..];
            }
            None => {
                bytes.push(*first);
                rest = after;
            }
        }
    }
    String::from_utf8(bytes).map(PathBuf::from).map_err(|_| FmuError::Text("fmuResourceLocation"))
}

/// Sizes of types: the default.
#[unsafe(no_mangle)]
pub extern "C" fn fmi2GetTypesPlatform() -> *const c_char {
    c"default".as_ptr()
}

/// Version of the interface.
#[unsafe(no_mangle)]
pub extern "C" fn fmi2GetVersion() -> *const c_char {
    c"2.0".as_ptr()
}

/// Creates an instance; null on failure.
///
/// # Safety
/// The texts are null or NUL-terminated; `callbacks` is null or points at functions of the standard's types.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi2Instantiate(
    name: *const c_char,
    kind: c_int,
    token: *const c_char,
    resources: *const c_char,
    callbacks: *const Callbacks2,
    _visible: c_int,
    _logging: c_int,
) -> Handle {
    // SAFETY: null or one structure, and null or NUL-terminated, as the standard says.
    let (callbacks, name) = unsafe { (array(callbacks, 1, "functions"), text(name, "instanceName")) };
    let Ok([callbacks]) = callbacks else { return core::ptr::null_mut() };
    table::create(logger(callbacks.logger, name.unwrap_or_default()), callbacks.environment, || {
        if kind != CO_SIMULATION {
            return Err(FmuError::Unsupported("model exchange"));
        }
        // SAFETY: null or NUL-terminated, as the standard says.
        let (token, resources) =
            unsafe { (text(token, "fmuGUID")?, text(resources, "fmuResourceLocation")?) };
        Instance::new(&path_of(&resources)?, &token)
    })
}

/// Frees an instance with its FMU states.
#[unsafe(no_mangle)]
pub extern "C" fn fmi2FreeInstance(instance: Handle) {
    table::free(instance);
}

/// Accepted; errors are always logged.
#[unsafe(no_mangle)]
pub extern "C" fn fmi2SetDebugLogging(
    instance: Handle,
    _on: c_int,
    _count: usize,
    _categories: *const *const c_char,
) -> c_int {
    with(instance, |_| Ok(()))
}

/// Sets the start time.
#[unsafe(no_mangle)]
pub extern "C" fn fmi2SetupExperiment(
    instance: Handle,
    _tolerance_defined: c_int,
    _tolerance: f64,
    start_s: f64,
    _stop_defined: c_int,
    _stop_s: f64,
) -> c_int {
    with(instance, |it| {
        it.start_s = start_s;
        Ok(())
    })
}

/// Begins initialisation.
#[unsafe(no_mangle)]
pub extern "C" fn fmi2EnterInitializationMode(instance: Handle) -> c_int {
    with(instance, |it| it.initialise(it.start_s))
}

/// Ends initialisation.
#[unsafe(no_mangle)]
pub extern "C" fn fmi2ExitInitializationMode(instance: Handle) -> c_int {
    with(instance, Instance::begin)
}

/// Ends the simulation.
#[unsafe(no_mangle)]
pub extern "C" fn fmi2Terminate(instance: Handle) -> c_int {
    with(instance, Instance::terminate)
}

/// Returns to the state after instantiation.
#[unsafe(no_mangle)]
pub extern "C" fn fmi2Reset(instance: Handle) -> c_int {
    with(instance, Instance::reset)
}

/// Runs the ticks of a step.
#[unsafe(no_mangle)]
pub extern "C" fn fmi2DoStep(instance: Handle, from_s: f64, step_s: f64, _no_earlier_state: c_int) -> c_int {
    with(instance, |it| it.step(from_s, step_s).map(|_| ()))
}

macro_rules! numbers {
    ($($get:ident $set:ident $type:ty, $kind:literal, $out:expr, $in:expr;)*) => {$(
        /// Reads variables of this type.
        ///
        /// # Safety
        /// The arrays are null or have the stated length.
        #[unsafe(no_mangle)]
        pub unsafe extern "C" fn $get(
            instance: Handle,
            references: *const u32,
            count: usize,
            values: *mut $type,
        ) -> c_int {
            with(instance, |it| {
                // SAFETY: null or of the stated length, as the standard says.
                let references = unsafe { array(references, count, "vr")? };
                // SAFETY: as above.
                let values = unsafe { room(values, count, "value")? };
                for (reference, value) in references.iter().zip(values) {
                    check(it, *reference, $kind)?;
                    let (_, found) = it.get(*reference, false)?;
                    *value = $out(*found.first().ok_or(FmuError::Defect)?)?;
                }
                Ok(())
            })
        }

        /// Sets variables of this type.
        ///
        /// # Safety
        /// The arrays are null or have the stated length.
        #[unsafe(no_mangle)]
        pub unsafe extern "C" fn $set(
            instance: Handle,
            references: *const u32,
            count: usize,
            values: *const $type,
        ) -> c_int {
            with(instance, |it| {
                // SAFETY: null or of the stated length, as the standard says.
                let references = unsafe { array(references, count, "vr")? };
                // SAFETY: as above.
                let values = unsafe { array(values, count, "value")? };
                for (reference, value) in references.iter().zip(values) {
                    let kind = check(it, *reference, $kind)?;
                    it.set(*reference, false, &[$in(*value, kind)?])?;
                }
                Ok(())
            })
        }
    )*};
}

/// Checks that a variable has a type of FMI 2.0; returns its own type.
fn check(it: &Instance, reference: u32, kind: &'static str) -> Result<Kind, FmuError> {
    let (variable, _, _) = it.find(reference, false)?;
    match kind_of_two(variable) == Some(kind) {
        true => Ok(variable.kind),
        false => Err(FmuError::NoVariable { kind, reference }),
    }
}

fn integer(value: Value) -> Result<c_int, FmuError> {
    let wide = FmuError::Count { given: 64, expected: 32 };
    match value {
        Value::Whole(value) => c_int::try_from(value).map_err(|_| wide),
        Value::Signed(value) => c_int::try_from(value).map_err(|_| wide),
        Value::Float(_) | Value::Flag(_) => Err(FmuError::Defect),
    }
}

fn of_integer(value: c_int, kind: Kind) -> Result<Value, FmuError> {
    match kind {
        Kind::Int64 => Ok(Value::Signed(value.into())),
        _ => match u64::try_from(value) {
            Ok(value) => Ok(Value::Whole(value)),
            Err(_) => Err(FmuError::NotSettable { name: "an unsigned variable".to_owned(), when: "below 0" }),
        },
    }
}

numbers! {
    fmi2GetReal fmi2SetReal f64, "Real", |value: Value| Ok::<_, FmuError>(value.as_f64()),
        |value, _| Ok::<_, FmuError>(Value::Float(value));
    fmi2GetInteger fmi2SetInteger c_int, "Integer", integer, of_integer;
    fmi2GetBoolean fmi2SetBoolean c_int, "Boolean",
        |value| Ok::<_, FmuError>(c_int::from(value == Value::Flag(true))),
        |value: c_int, _| Ok::<_, FmuError>(Value::Flag(value != 0));
}

/// Reads texts, which stay valid until the next call with this instance.
///
/// # Safety
/// The arrays are null or have the stated length.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi2GetString(
    instance: Handle,
    references: *const u32,
    count: usize,
    values: *mut *const c_char,
) -> c_int {
    // SAFETY: this function's own contract, with as many values as references.
    unsafe { super::three::fmi3GetString(instance, references, count, values, count) }
}

/// Saves the state; `state` receives it, and an earlier one in it is overwritten.
///
/// # Safety
/// `state` is null or valid for reading and writing.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi2GetFMUstate(instance: Handle, state: *mut Handle) -> c_int {
    // SAFETY: this function's own contract.
    unsafe { super::three::fmi3GetFMUState(instance, state) }
}

/// Returns to a saved state.
#[unsafe(no_mangle)]
pub extern "C" fn fmi2SetFMUstate(instance: Handle, state: Handle) -> c_int {
    super::three::fmi3SetFMUState(instance, state)
}

/// Frees a saved state; null is ignored.
///
/// # Safety
/// `state` is null or valid for reading and writing.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi2FreeFMUstate(instance: Handle, state: *mut Handle) -> c_int {
    // SAFETY: this function's own contract.
    unsafe { super::three::fmi3FreeFMUState(instance, state) }
}

/// Returns the size of a saved state as bytes.
///
/// # Safety
/// `size` is null or valid for writing.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi2SerializedFMUstateSize(
    instance: Handle,
    state: Handle,
    size: *mut usize,
) -> c_int {
    // SAFETY: this function's own contract.
    unsafe { super::three::fmi3SerializedFMUStateSize(instance, state, size) }
}

/// Writes a saved state as bytes.
///
/// # Safety
/// `bytes` is null or has `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi2SerializeFMUstate(
    instance: Handle,
    state: Handle,
    bytes: *mut u8,
    size: usize,
) -> c_int {
    // SAFETY: this function's own contract.
    unsafe { super::three::fmi3SerializeFMUState(instance, state, bytes, size) }
}

/// Saves the state that bytes describe.
///
/// # Safety
/// `bytes` is null or has `size` bytes; `state` is null or valid for writing.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi2DeSerializeFMUstate(
    instance: Handle,
    bytes: *const u8,
    size: usize,
    state: *mut Handle,
) -> c_int {
    // SAFETY: this function's own contract.
    unsafe { super::three::fmi3DeserializeFMUState(instance, bytes, size, state) }
}

/// Returns the derivative of outputs at the end of a tick by inputs held during it, times a seed.
///
/// # Safety
/// The arrays are null or have the stated lengths.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi2GetDirectionalDerivative(
    instance: Handle,
    unknowns: *const u32,
    unknown_count: usize,
    knowns: *const u32,
    known_count: usize,
    seed: *const f64,
    sensitivity: *mut f64,
) -> c_int {
    with(instance, |it| {
        // SAFETY: null or of the stated lengths, as the standard says.
        let (unknowns, knowns, seed, sensitivity) = unsafe {
            (
                array(unknowns, unknown_count, "vUnknown_ref")?,
                array(knowns, known_count, "vKnown_ref")?,
                array(seed, known_count, "dvKnown")?,
                room(sensitivity, unknown_count, "dvUnknown")?,
            )
        };
        sensitivity.copy_from_slice(&it.derivative(unknowns, knowns, seed, false)?);
        Ok(())
    })
}

/// Answers that the last step is done, which is all there is to know of a step that returns when it is done.
///
/// # Safety
/// `value` is null or valid for writing.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi2GetStatus(instance: Handle, _kind: c_int, value: *mut c_int) -> c_int {
    with(instance, |_| {
        // SAFETY: null or valid for writing, as the standard says.
        unsafe { put(value, super::status::OK) };
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
    fmi2SetString(*const u32, usize, *const *const c_char);
    fmi2SetRealInputDerivatives(*const u32, usize, *const c_int, *const f64);
    fmi2GetRealOutputDerivatives(*const u32, usize, *const c_int, *mut f64);
    fmi2CancelStep();
    fmi2GetRealStatus(c_int, *mut f64);
    fmi2GetIntegerStatus(c_int, *mut c_int);
    fmi2GetBooleanStatus(c_int, *mut c_int);
    fmi2GetStringStatus(c_int, *mut *const c_char);
}
