//! Status codes, and the text of the last error.

use std::cell::RefCell;
use std::ffi::{CString, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};

use ipc_types::session::SessionError;
use thiserror::Error;

use crate::error::ClientError;

macro_rules! statuses {
    ($($(#[doc = $doc:literal])* $name:ident = $value:literal;)*) => {
        $($(#[doc = $doc])* pub(super) const $name: i32 = $value;)*

        /// Every status code: name, value, meaning.
        pub const STATUSES: &[(&str, i32, &str)] = &[$((stringify!($name), $value, concat!($($doc),*))),*];
    };
}
statuses! {
    /// Success.
    OK = 0;
    /// Timed out; not an error.
    TIMEOUT = 1;
    /// The run is over; not an error.
    ENDED = 2;
    /// A required pointer is null.
    ERROR_NULL = -1;
    /// Not a client of this thread: never connected, disconnected, or connected by another thread.
    ERROR_HANDLE = -2;
    /// An invalid number or text.
    ERROR_ARGUMENT = -3;
    /// No running session found.
    ERROR_NO_SESSION = -4;
    /// Version mismatch of program, library and hub: a message's layout or the transport differs.
    ERROR_VERSION = -5;
    /// The scene has no such controller, or the choice of controller is ambiguous.
    ERROR_CONTROLLER = -6;
    /// A controller of this name is already connected.
    ERROR_TAKEN = -7;
    /// A frame request or a run-control action was refused.
    ERROR_REFUSED = -8;
    /// The scene has no X-ray or no volume, or the client is an observer.
    ERROR_ABSENT = -9;
    /// Shared memory or the transport failed.
    ERROR_TRANSPORT = -10;
    /// The hub is gone.
    ERROR_HUB_GONE = -11;
    /// A defect of this library.
    ERROR_DEFECT = -12;
    /// The client belongs to the process that this one was forked from.
    ERROR_FORKED = -13;
    /// This thread is already in a call: a call from a signal handler is refused, without a text.
    ERROR_BUSY = -14;
    /// Several sessions are running and none is named; the text lists them.
    ERROR_SEVERAL_SESSIONS = -15;
}

/// Why a call failed.
#[derive(Debug, Error)]
pub(super) enum Failure {
    #[error(transparent)]
    Client(#[from] ClientError),
    #[error("session {session}: {cause}")]
    Joined { session: String, cause: ClientError },
    /// The run is over, with the reason.
    #[error("{0}")]
    Ended(String),
    #[error("`{0}` is a null pointer")]
    Null(&'static str),
    #[error(
        "{0} is not a client of this thread: never connected, disconnected, or connected by another thread"
    )]
    Handle(u64),
    #[error("this thread is already inside a call of the library; do not call it from signal handlers")]
    Busy,
    #[error("the memory of client {0} is not held by this process")]
    NotHeld(u64),
    #[error("`{0}` is not UTF-8")]
    Text(&'static str),
}

impl Failure {
    fn status(&self) -> i32 {
        match self {
            Failure::Null(_) => ERROR_NULL,
            Failure::Handle(_) | Failure::NotHeld(_) => ERROR_HANDLE,
            Failure::Busy => ERROR_BUSY,
            Failure::Text(_) => ERROR_ARGUMENT,
            Failure::Ended(_) => ENDED,
            Failure::Client(cause) | Failure::Joined { cause, .. } => client_status(cause),
        }
    }
}

fn client_status(cause: &ClientError) -> i32 {
    match cause {
        ClientError::TimedOut(_) => TIMEOUT,
        ClientError::Ended => ENDED,
        ClientError::NoSession { .. } => ERROR_NO_SESSION,
        ClientError::Session(SessionError::SeveralSessions { .. }) => ERROR_SEVERAL_SESSIONS,
        ClientError::Joining { cause, .. } => client_status(cause),
        ClientError::Layout { .. }
        | ClientError::Session(
            SessionError::Layout { .. } | SessionError::Transport { .. } | SessionError::Version { .. },
        ) => ERROR_VERSION,
        ClientError::WhichController { .. }
        | ClientError::Session(SessionError::UnknownController { .. }) => ERROR_CONTROLLER,
        ClientError::Session(SessionError::ControllerTaken { .. }) => ERROR_TAKEN,
        ClientError::FrameRefused { .. } | ClientError::ControlRefused { .. } => ERROR_REFUSED,
        ClientError::Observer | ClientError::NoDrr | ClientError::NoVolume => ERROR_ABSENT,
        ClientError::Misuse(_)
        | ClientError::BadArgument { .. }
        | ClientError::Session(SessionError::NotASession { .. }) => ERROR_ARGUMENT,
        ClientError::HubGone { .. } => ERROR_HUB_GONE,
        ClientError::Forked => ERROR_FORKED,
        ClientError::Session(_) | ClientError::Scene(_) | ClientError::Port(_) => ERROR_TRANSPORT,
    }
}

thread_local! {
    static LAST_ERROR: RefCell<CString> = RefCell::default();
}

/// Runs a function's body; converts a failure to a status and this thread's last error.
pub(super) fn outcome(body: impl FnOnce() -> Result<(), Failure>) -> i32 {
    // Partial changes of a panic stay inside this library, because the client's fields are plain values and
    // ports.
    let (status, text) = match catch_unwind(AssertUnwindSafe(body)) {
        Ok(Ok(())) => return OK,
        // A signal handler must not allocate.
        Ok(Err(Failure::Busy)) => return ERROR_BUSY,
        // No text, because this occurs on every iteration of a loop.
        Ok(Err(Failure::Client(ClientError::TimedOut(_)))) => return TIMEOUT,
        Ok(Err(failure)) => (failure.status(), failure.to_string()),
        Err(_) => (ERROR_DEFECT, "internal error in libtrabecula_client; see standard error".to_owned()),
    };
    // An ending thread has no last error any more.
    let _ = LAST_ERROR.try_with(|last| {
        *last.borrow_mut() = CString::new(text.replace('\0', " ")).unwrap_or_default();
    });
    status
}

/// This thread's last error text.
pub(super) fn last_error() -> *const c_char {
    LAST_ERROR.try_with(|last| last.borrow().as_ptr()).unwrap_or(c"".as_ptr())
}
