//! Calls an FMU's library.

use core::ffi::{CStr, c_char, c_int, c_void};
use std::ffi::CString;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use libloading::Library;
use libloading::os::unix::{Library as UnixLibrary, RTLD_GLOBAL, RTLD_NOW};

use super::model::{ForeignModel, ForeignVariable, VariableType};
use super::{Archived, malformed};
use crate::error::FmuError;
use crate::ffi::Callbacks2;

/// Last message of an FMU of this process.
static LAST_MESSAGE: Mutex<String> = Mutex::new(String::new());

/// Keeps a message of an FMU.
///
/// # Safety
/// `text` is null or NUL-terminated.
unsafe fn keep_message(text: *const c_char) {
    if !text.is_null() {
        // SAFETY: not null, and NUL-terminated by this function's own contract.
        let text = unsafe { CStr::from_ptr(text) };
        *LAST_MESSAGE.lock().unwrap_or_else(PoisonError::into_inner) = text.to_string_lossy().into_owned();
    }
}

unsafe extern "C" fn log3(_: *mut c_void, _: c_int, _: *const c_char, text: *const c_char) {
    // SAFETY: the standard gives the message as a NUL-terminated text.
    unsafe { keep_message(text) };
}

/// Takes the format of a message, and its first further argument if the format is `%s`. Other formats are
/// shown as they are.
unsafe extern "C" fn log2(
    _: *mut c_void,
    _: *const c_char,
    _: c_int,
    _: *const c_char,
    format: *const c_char,
    first: *const c_char,
) {
    if format.is_null() {
        return;
    }
    // SAFETY: the standard gives the format as a NUL-terminated text.
    let is_text = unsafe { CStr::from_ptr(format) } == c"%s";
    // SAFETY: NUL-terminated: the format, or the text that `%s` says is given.
    unsafe { keep_message(if is_text { first } else { format }) };
}

unsafe extern "C" fn allocate(count: usize, size: usize) -> *mut c_void {
    // SAFETY: `calloc` takes any two numbers.
    unsafe { libc::calloc(count, size) }
}

unsafe extern "C" fn free(memory: *mut c_void) {
    // SAFETY: the standard lets an FMU free here only what it has allocated by `allocate`.
    unsafe { libc::free(memory) };
}

type Simple = unsafe extern "C" fn(*mut c_void) -> c_int;
type Instantiate2 = unsafe extern "C" fn(
    *const c_char,
    c_int,
    *const c_char,
    *const c_char,
    *const Callbacks2,
    c_int,
    c_int,
) -> *mut c_void;
type Instantiate3 = unsafe extern "C" fn(
    *const c_char,
    *const c_char,
    *const c_char,
    bool,
    bool,
    bool,
    bool,
    *const u32,
    usize,
    *mut c_void,
    unsafe extern "C" fn(*mut c_void, c_int, *const c_char, *const c_char),
    *const c_void,
) -> *mut c_void;
type Setup2 = unsafe extern "C" fn(*mut c_void, c_int, f64, f64, c_int, f64) -> c_int;
type Enter3 = unsafe extern "C" fn(*mut c_void, bool, f64, f64, bool, f64) -> c_int;
type Step2 = unsafe extern "C" fn(*mut c_void, f64, f64, c_int) -> c_int;
type Step3 =
    unsafe extern "C" fn(*mut c_void, f64, f64, bool, *mut bool, *mut bool, *mut bool, *mut f64) -> c_int;
type Get2<T> = unsafe extern "C" fn(*mut c_void, *const u32, usize, *mut T) -> c_int;
type Get3<T> = unsafe extern "C" fn(*mut c_void, *const u32, usize, *mut T, usize) -> c_int;
type Set2<T> = unsafe extern "C" fn(*mut c_void, *const u32, usize, *const T) -> c_int;
type Set3<T> = unsafe extern "C" fn(*mut c_void, *const u32, usize, *const T, usize) -> c_int;

/// Loads a shared library for the rest of the process, with its functions visible to the FMUs loaded after
/// it. `name` is a path, or a name that the loader searches.
///
/// # Errors
/// If it cannot be loaded.
pub fn preload(name: &str) -> Result<(), FmuError> {
    // SAFETY: runs the library's initialisers; the user has chosen to load it into this process.
    let loaded = unsafe { UnixLibrary::open(Some(name), RTLD_NOW | RTLD_GLOBAL) };
    let failed =
        |cause: libloading::Error| FmuError::File { path: name.to_owned(), reason: cause.to_string() };
    loaded.map(std::mem::forget).map_err(failed)
}

/// An instance of an FMU.
pub struct Master {
    model: ForeignModel,
    instance: *mut c_void,
    library: Library,
    /// Functions that the instance calls until it is freed.
    _callbacks: Box<Callbacks2>,
}

/// Converts a status; warnings pass.
fn checked(status: c_int, what: &str) -> Result<(), FmuError> {
    if (0..=1).contains(&status) {
        return Ok(());
    }
    let message = std::mem::take(&mut *LAST_MESSAGE.lock().unwrap_or_else(PoisonError::into_inner));
    let message = if message.is_empty() { "no message".to_owned() } else { message };
    Err(malformed(format!("{what}: status {status}: {message}")))
}

fn c_text(text: &str) -> Result<CString, FmuError> {
    CString::new(text).map_err(|_| malformed("a text contains NUL"))
}

impl Master {
    /// Loads an FMU that has been extracted into a folder, and creates an instance.
    ///
    /// # Errors
    /// If the library cannot be loaded or refuses.
    pub fn new(archived: &Archived, folder: &Path) -> Result<Master, FmuError> {
        let model = archived.model.clone();
        // SAFETY: runs code of the library, which the user has chosen to run in this process.
        let library = unsafe { Library::new(folder.join(model.library())) }.map_err(malformed)?;
        // SAFETY: on Linux on x86-64 and aarch64, a function takes its first six pointers and integers in the
        // same registers whether or not it is called as variadic, and `log2` uses the sixth only if it is
        // given.
        let logger = unsafe { core::mem::transmute::<*const (), Option<_>>(log2 as *const ()) };
        let callbacks = Box::new(Callbacks2 {
            logger,
            allocate_memory: allocate as *const c_void,
            free_memory: free as *const c_void,
            step_finished: core::ptr::null(),
            environment: core::ptr::null_mut(),
        });
        let (name, token) = (c_text("trabecula")?, c_text(&model.token)?);
        let resources = folder.join("resources");
        let resources = resources.to_str().ok_or_else(|| malformed("the folder's name is not UTF-8"))?;
        let instance = if model.three {
            let path = c_text(resources)?;
            // SAFETY: the standard's type; all texts and the function live through the call.
            unsafe {
                function::<Instantiate3>(&library, "fmi3InstantiateCoSimulation")?(
                    name.as_ptr(),
                    token.as_ptr(),
                    path.as_ptr(),
                    false,
                    false,
                    false,
                    false,
                    core::ptr::null(),
                    0,
                    core::ptr::null_mut(),
                    log3,
                    core::ptr::null(),
                )
            }
        } else {
            let uri = c_text(&format!("file://{resources}"))?;
            // SAFETY: the standard's type; texts live through the call, callbacks as long as the instance.
            unsafe {
                function::<Instantiate2>(&library, "fmi2Instantiate")?(
                    name.as_ptr(),
                    1,
                    token.as_ptr(),
                    uri.as_ptr(),
                    &raw const *callbacks,
                    0,
                    0,
                )
            }
        };
        if instance.is_null() {
            checked(3, "instantiation")?;
        }
        Ok(Master { model, instance, library, _callbacks: callbacks })
    }

    fn simple(&self, two: &str, three: &str) -> Result<(), FmuError> {
        let name = if self.model.three { three } else { two };
        // SAFETY: the standard's type of these functions; the instance is the library's.
        checked(unsafe { function::<Simple>(&self.library, name)?(self.instance) }, name)
    }

    /// Enters initialisation at time 0; parameters are set before, inputs after it.
    ///
    /// # Errors
    /// As the FMU says.
    pub fn enter_initialisation(&self) -> Result<(), FmuError> {
        if self.model.three {
            let name = "fmi3EnterInitializationMode";
            // SAFETY: the standard's type; the instance is the library's.
            let enter = unsafe { function::<Enter3>(&self.library, name)? };
            // SAFETY: as above.
            return checked(unsafe { enter(self.instance, false, 0.0, 0.0, false, 0.0) }, name);
        }
        let name = "fmi2SetupExperiment";
        // SAFETY: the standard's type; the instance is the library's.
        let setup = unsafe { function::<Setup2>(&self.library, name)? };
        // SAFETY: as above.
        checked(unsafe { setup(self.instance, 0, 0.0, 0.0, 0, 0.0) }, name)?;
        self.simple("fmi2EnterInitializationMode", "")
    }

    /// Ends initialisation.
    ///
    /// # Errors
    /// As the FMU says.
    pub fn exit_initialisation(&self) -> Result<(), FmuError> {
        self.simple("fmi2ExitInitializationMode", "fmi3ExitInitializationMode")
    }

    /// Steps from a time, s, by a step, s.
    ///
    /// # Errors
    /// As the FMU says.
    pub fn step(&self, from_s: f64, step_s: f64) -> Result<(), FmuError> {
        if !self.model.three {
            let name = "fmi2DoStep";
            // SAFETY: the standard's type; the instance is the library's.
            return checked(
                unsafe { function::<Step2>(&self.library, name)?(self.instance, from_s, step_s, 1) },
                name,
            );
        }
        let name = "fmi3DoStep";
        let (mut event, mut terminate, mut early, mut last_s) = (false, false, false, 0.0);
        // SAFETY: the standard's type; the instance is the library's, and the four results live through the
        // call.
        let status = unsafe {
            function::<Step3>(&self.library, name)?(
                self.instance,
                from_s,
                step_s,
                true,
                &raw mut event,
                &raw mut terminate,
                &raw mut early,
                &raw mut last_s,
            )
        };
        checked(status, name)?;
        if terminate { Err(malformed("the FMU asks to terminate")) } else { Ok(()) }
    }

    fn get_as<T: Copy>(&self, reference: u32, mut value: T, two: &str, three: &str) -> Result<T, FmuError> {
        let name = if self.model.three { three } else { two };
        // SAFETY: the standard's types for T; one reference and one value, which live through the call.
        let status = unsafe {
            match self.model.three {
                true => function::<Get3<T>>(&self.library, name)?(
                    self.instance,
                    &raw const reference,
                    1,
                    &raw mut value,
                    1,
                ),
                false => function::<Get2<T>>(&self.library, name)?(
                    self.instance,
                    &raw const reference,
                    1,
                    &raw mut value,
                ),
            }
        };
        checked(status, name).map(|()| value)
    }

    fn set_as<T: Copy>(&self, reference: u32, value: T, two: &str, three: &str) -> Result<(), FmuError> {
        let name = if self.model.three { three } else { two };
        // SAFETY: the standard's types for T; one reference and one value, which live through the call.
        let status = unsafe {
            match self.model.three {
                true => function::<Set3<T>>(&self.library, name)?(
                    self.instance,
                    &raw const reference,
                    1,
                    &raw const value,
                    1,
                ),
                false => function::<Set2<T>>(&self.library, name)?(
                    self.instance,
                    &raw const reference,
                    1,
                    &raw const value,
                ),
            }
        };
        checked(status, name)
    }

    /// Reads a variable.
    ///
    /// # Errors
    /// As the FMU says.
    pub fn get(&self, variable: &ForeignVariable) -> Result<f64, FmuError> {
        let reference = variable.reference;
        match (variable.kind, self.model.three) {
            (VariableType::Float, _) => self.get_as(reference, 0.0, "fmi2GetReal", "fmi3GetFloat64"),
            (VariableType::Int, _) => {
                self.get_as(reference, 0i32, "fmi2GetInteger", "fmi3GetInt32").map(f64::from)
            }
            (VariableType::UInt, _) => self.get_as(reference, 0u32, "", "fmi3GetUInt32").map(f64::from),
            (VariableType::Boolean, true) => self.get_as(reference, 0u8, "", "fmi3GetBoolean").map(f64::from),
            (VariableType::Boolean, false) => {
                self.get_as(reference, 0i32, "fmi2GetBoolean", "").map(f64::from)
            }
        }
    }

    /// Sets a variable; whole numbers are rounded, flags are true unless 0.
    ///
    /// # Errors
    /// As the FMU says.
    pub fn set(&self, variable: &ForeignVariable, value: f64) -> Result<(), FmuError> {
        let reference = variable.reference;
        // Conversions saturate.
        match (variable.kind, self.model.three) {
            (VariableType::Float, _) => self.set_as(reference, value, "fmi2SetReal", "fmi3SetFloat64"),
            (VariableType::Int, _) => {
                self.set_as(reference, value.round() as i32, "fmi2SetInteger", "fmi3SetInt32")
            }
            (VariableType::UInt, _) => self.set_as(reference, value.round() as u32, "", "fmi3SetUInt32"),
            (VariableType::Boolean, true) => {
                self.set_as(reference, u8::from(value != 0.0), "", "fmi3SetBoolean")
            }
            (VariableType::Boolean, false) => {
                self.set_as(reference, i32::from(value != 0.0), "fmi2SetBoolean", "")
            }
        }
    }
}

impl Drop for Master {
    fn drop(&mut self) {
        let name = if self.model.three { "fmi3FreeInstance" } else { "fmi2FreeInstance" };
        // SAFETY: the standard's type; the instance is freed once, before its library and callbacks.
        unsafe {
            if let Ok(free) = function::<unsafe extern "C" fn(*mut c_void)>(&self.library, name) {
                free(self.instance);
            }
        }
    }
}

/// Returns a function of a library.
///
/// # Safety
/// `F` is the type that the standard gives the function; it is called only while the library is loaded.
unsafe fn function<F: Copy>(library: &Library, name: &str) -> Result<F, FmuError> {
    // SAFETY: this function's own contract.
    let found = unsafe { library.get::<F>(name.as_bytes()) };
    found.map(|symbol| *symbol).map_err(|_| malformed(format!("its library has no `{name}`")))
}
