//! The functions.

use std::ffi::{CStr, CString, c_char};
use std::sync::OnceLock;
use std::time::Duration;

use ipc_types::messages::{Command, Pose, RunControlReply, RunStatus, SensorReading, State, TipJacobian};

use super::outcome::{self, Failure, outcome};
use super::views::{EventPointers, FramePointers, RemovedPointers, SessionInfo, VolumePointers};
use super::{memory, table};
use crate::bindings;
use crate::client::{Client, Connection, event_text, limit_of};
use crate::error::ClientError;
use crate::frames::frame_view;

/// Result of a non-waiting call if nothing has arrived.
const NOTHING_YET: ClientError = ClientError::TimedOut(Duration::ZERO);

/// Writes a result to the caller's variable.
///
/// # Safety
/// `out` is null or valid for writing a `T`.
unsafe fn put<T>(out: *mut T, name: &'static str, value: T) -> Result<(), Failure> {
    if out.is_null() {
        return Err(Failure::Null(name));
    }
    // SAFETY: not null, and valid for writing by this function's own contract.
    unsafe { out.write(value) };
    Ok(())
}

/// Reads an optional text.
///
/// # Safety
/// `text` is null or points at a text with a final NUL.
unsafe fn text_of(text: *const c_char, name: &'static str) -> Result<Option<String>, Failure> {
    if text.is_null() {
        return Ok(None);
    }
    // SAFETY: not null, and NUL-terminated by this function's own contract.
    let text = unsafe { CStr::from_ptr(text) };
    text.to_str().map(|text| Some(text.to_owned())).map_err(|_| Failure::Text(name))
}

fn check_null<T>(pointer: *mut T, name: &'static str) -> Result<(), Failure> {
    if pointer.is_null() { Err(Failure::Null(name)) } else { Ok(()) }
}

/// Writes the address of what `find` returns from a client; [`NOTHING_YET`] if that is nothing.
///
/// # Safety
/// `out` is null, or can be written.
unsafe fn put_found<T>(
    client: u64,
    (out, name): (*mut *const T, &'static str),
    find: impl for<'c> FnOnce(&'c mut Client) -> Result<Option<&'c T>, ClientError>,
) -> Result<(), Failure> {
    check_null(out, name)?;
    let found =
        table::with(client, |open| find(&mut open.client)?.map(core::ptr::from_ref).ok_or(NOTHING_YET))?;
    // SAFETY: not null, and valid for writing by this function's own contract.
    unsafe { put(out, name, found) }
}

functions! {
    /// Version of the library. The text stays valid for the life of the process.
    fn trb_version() -> *const c_char {
        const { CStr::from_bytes_with_nul(concat!(env!("CARGO_PKG_VERSION"), "\0").as_bytes()) }
            .unwrap_or_default()
            .as_ptr()
    }

    /// The library's layouts of all messages and of this interface:
    /// "State=729b226247fc0784;Command=...;Abi=...". The text stays valid for the life of the process.
    fn trb_layouts() -> *const c_char {
        static LAYOUTS: OnceLock<CString> = OnceLock::new();
        LAYOUTS.get_or_init(|| CString::new(bindings::layouts()).unwrap_or_default()).as_ptr()
    }

    /// Text of this thread's last error: the session, the given and expected values, and what to do; after
    /// TRB_ENDED, why the run is over. It stays valid until this thread's next call that returns an error or
    /// TRB_ENDED, or until the thread ends.
    fn trb_last_error() -> *const c_char {
        outcome::last_error()
    }

    /// Connects to a session. `layouts` is TRB_LAYOUTS of the header that the program was compiled with; if
    /// the layout of a message in the library or the hub differs, or the version of these functions (Abi),
    /// the call fails and names it. `session` is a session's folder or name; null selects the folder in the
    /// environment variable TRABECULA_SESSION, or else this user's only running session. `controller` is a
    /// controller's name in the scene, or empty for an observer that sends no commands; null selects the name
    /// in TRABECULA_CONTROLLER, or else the scene's only external controller. Waits at most `timeout_s` for
    /// the session. `client` receives a handle, which belongs to the calling thread.
    fn trb_connect(
        layouts: *const c_char,
        session: *const c_char,
        controller: *const c_char,
        timeout_s: f64,
        client: *mut u64,
    ) -> i32 {
        outcome(|| {
            check_null(client, "client")?;
            // SAFETY: the caller's texts are null or NUL-terminated, as the header says.
            let (layouts, session, controller) = unsafe {
                let layouts = text_of(layouts, "layouts")?;
                (layouts, text_of(session, "session")?, text_of(controller, "controller")?)
            };
            bindings::check_layouts(&layouts.ok_or(Failure::Null("layouts"))?)?;
            let connection = Connection { session, controller, limit: limit_of(timeout_s)? };
            let handle = table::insert(Client::connect(&connection)?)?;
            // SAFETY: `client` is not null; the caller promises that it can be written.
            unsafe { put(client, "client", handle) }
        })
    }

    /// Leaves the session. All pointers from this client become invalid, unless trb_hold_memory keeps them.
    /// The library cleans up after a process that ends without this call. In a child of fork() the call is
    /// refused, and the parent stays connected.
    fn trb_disconnect(client: u64) -> i32 {
        outcome(|| table::remove(client))
    }

    /// Keeps this client's memory mapped beyond trb_disconnect and the end of its thread: all of its valid
    /// pointers stay valid, with their content, until trb_release_memory has been called equally often. For
    /// garbage-collected languages.
    fn trb_hold_memory(client: u64) -> i32 {
        outcome(|| {
            table::with(client, |_| {
                memory::hold(client);
                Ok(())
            })
        })
    }

    /// Undoes one trb_hold_memory; once the client has ended, the last one invalidates its pointers. Can be
    /// called from any thread.
    fn trb_release_memory(client: u64) -> i32 {
        outcome(|| memory::release(client))
    }

    /// Constant properties of the session.
    fn trb_get_info(client: u64, info: *mut SessionInfo) -> i32 {
        outcome(|| {
            let facts = table::with(client, |open| {
                let facts = open.client.info();
                Ok(SessionInfo {
                    folder: open.texts.folder.as_ptr(),
                    controller: open.texts.controller.as_ptr(),
                    scene_toml: open.texts.scene_toml.as_ptr(),
                    dt_s: facts.dt_s,
                    tick_count: facts.tick_count,
                    frame_period_ticks: facts.frame_period_ticks,
                    controller_index: facts.controller.as_ref().map_or(-1, |(_, index)| index.0 as i32),
                    controller_count: facts.controller_count as u32,
                    lockstep: u32::from(facts.lockstep),
                    frame_columns: facts.frame_columns,
                    frame_rows: facts.frame_rows,
                    has_volume: u32::from(facts.has_volume),
                })
            })?;
            // SAFETY: the caller promises that `info` is null or can be written.
            unsafe { put(info, "info", facts) }
        })
    }

    /// Returns the newest state if one has arrived since the last call; does not wait. Older states are
    /// skipped and counted (trb_states_missed). TRB_TIMEOUT: no state has arrived; TRB_ENDED: no more states
    /// will arrive. `*state` points into shared memory and stays valid and unchanged until this client's next
    /// call of trb_poll_state, trb_wait_state, trb_next_state or trb_disconnect that returns TRB_OK.
    fn trb_poll_state(client: u64, state: *mut *const State) -> i32 {
        // SAFETY: the caller promises that `state` is null or can be written.
        outcome(|| unsafe { put_found(client, (state, "state"), Client::poll_state) })
    }

    /// Waits for the newest state: yields for 20 microseconds, then sleeps until woken (an observer polls
    /// every 0.2 ms). Otherwise like trb_poll_state.
    fn trb_wait_state(client: u64, timeout_s: f64, state: *mut *const State) -> i32 {
        outcome(|| {
            check_null(state, "state")?;
            let limit = limit_of(timeout_s)?;
            let newest = table::with(client, |open| open.client.wait_state(limit).map(core::ptr::from_ref))?;
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(state, "state", newest) }
        })
    }

    /// Waits for the oldest unread state, for programs that need every state; 512 states are kept. Otherwise
    /// like trb_wait_state.
    fn trb_next_state(client: u64, timeout_s: f64, state: *mut *const State) -> i32 {
        outcome(|| {
            check_null(state, "state")?;
            let limit = limit_of(timeout_s)?;
            let oldest = table::with(client, |open| open.client.next_state(limit).map(core::ptr::from_ref))?;
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(state, "state", oldest) }
        })
    }

    /// Number of states skipped or overwritten before this client read them.
    fn trb_states_missed(client: u64, count: *mut u64) -> i32 {
        outcome(|| {
            let missed = table::with(client, |open| Ok(open.client.states_missed()))?;
            // SAFETY: the caller promises that `count` is null or can be written.
            unsafe { put(count, "count", missed) }
        })
    }

    /// Returns the next command to fill in: every mode is "none", `sequence` and `state_tick` are set for the
    /// last state read. Returns the same command until trb_send_command, trb_discard_command or
    /// trb_disconnect invalidates it. It is in the client's own memory: trb_send_command copies it, so later
    /// writes have no effect.
    fn trb_loan_command(client: u64, command: *mut *mut Command) -> i32 {
        outcome(|| {
            check_null(command, "command")?;
            let begun = table::with(client, |open| open.client.command().map(core::ptr::from_mut))?;
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(command, "command", begun) }
        })
    }

    /// Sends the current content of the loaned command and wakes the physics, which checks it. A refused
    /// command has no effect. If the tool cannot follow a part of an accepted command (an unreachable goal),
    /// that part has no effect but the others do. Both cases are counted in the status and reported as
    /// events.
    fn trb_send_command(client: u64) -> i32 {
        outcome(|| table::with(client, |open| open.client.send()))
    }

    /// Discards the loaned command. Does nothing if there is none.
    fn trb_discard_command(client: u64) -> i32 {
        outcome(|| {
            table::with(client, |open| {
                open.client.discard_command();
                Ok(())
            })
        })
    }

    /// Requests an X-ray frame. `t_world_c_arm` is the pose of the C-arm: origin in the isocentre, +x along
    /// the image rows to the right, +y along the columns down, +z to the source; distances, pixels and pitch
    /// are the scene's. Null selects the scene's C-arm pose. The frame shows the state of `tick`, or the
    /// newest one if that tick has passed. `request_id` receives the request's id.
    fn trb_request_frame(client: u64, t_world_c_arm: *const Pose, tick: u64, request_id: *mut u64) -> i32 {
        outcome(|| {
            check_null(request_id, "request_id")?;
            // SAFETY: null, or a pose as the header says; every bit pattern is one.
            let pose = unsafe { t_world_c_arm.as_ref() };
            let number = table::with(client, |open| open.client.request_frame(pose, tick))?;
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(request_id, "request_id", number) }
        })
    }

    /// Waits for the frame of a request, skipping earlier ones, or for the next frame of any kind if
    /// `request_id` is 0. Frames are queued from this client's first call of trb_request_frame or
    /// trb_wait_frame on, at most 64. TRB_ENDED: the run is over and no frame is being rendered. `view`
    /// points into shared memory, which stays valid and unchanged until this client's next call of
    /// trb_wait_frame that returns TRB_OK, or trb_disconnect.
    fn trb_wait_frame(client: u64, request_id: u64, timeout_s: f64, view: *mut FramePointers) -> i32 {
        outcome(|| {
            check_null(view, "view")?;
            let limit = limit_of(timeout_s)?;
            let pointers = table::with(client, |open| {
                open.client.wait_frame(request_id, limit)?;
                let frame = open.client.frame.as_ref().and_then(frame_view);
                let frame = frame.ok_or(ClientError::Misuse("the frame is missing"))?;
                Ok(FramePointers {
                    frame: frame.frame,
                    pixels: frame.pixels.as_ptr(),
                    pixel_count: frame.pixels.len() as u64,
                })
            })?;
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(view, "view", pointers) }
        })
    }

    /// Returns the CT volume at the start of the run. `view` points into shared memory, which stays valid
    /// until trb_disconnect.
    fn trb_get_volume(client: u64, timeout_s: f64, view: *mut VolumePointers) -> i32 {
        outcome(|| {
            check_null(view, "view")?;
            let limit = limit_of(timeout_s)?;
            let pointers = table::with(client, |open| {
                let volume = open.client.volume(limit)?;
                Ok(VolumePointers {
                    volume: volume.volume,
                    hu: volume.hu.as_ptr(),
                    voxel_count: volume.hu.len() as u64,
                })
            })?;
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(view, "view", pointers) }
        })
    }

    /// Sends an action to run control (TRB_CONTROL_PAUSE etc.; `ticks` applies to TRB_CONTROL_STEP) and waits
    /// for the reply. Action 0 sends nothing and continues to wait for the reply to a call that timed out.
    /// `reply` may be null.
    fn trb_control_run(
        client: u64,
        action: u32,
        ticks: u64,
        timeout_s: f64,
        reply: *mut RunControlReply,
    ) -> i32 {
        outcome(|| {
            let limit = limit_of(timeout_s)?;
            let answer = table::with(client, |open| match action {
                0 => open.client.await_control(limit),
                _ => open.client.run_control(action, ticks, limit),
            })?;
            if reply.is_null() {
                return Ok(());
            }
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(reply, "reply", answer) }
        })
    }

    /// Copies the newest status of the run. TRB_TIMEOUT if none has arrived yet.
    fn trb_get_status(client: u64, status: *mut RunStatus) -> i32 {
        outcome(|| {
            let newest = table::with(client, |open| {
                open.client.status()?.ok_or(NOTHING_YET)
            })?;
            // SAFETY: the caller promises that `status` is null or can be written.
            unsafe { put(status, "status", newest) }
        })
    }

    /// Returns the oldest unread event; TRB_TIMEOUT if there is none. Events are queued from this client's
    /// first call on, at most 256. The memory that `view` points to stays valid until this client's next call
    /// of trb_next_event that returns TRB_OK, or trb_disconnect.
    fn trb_next_event(client: u64, view: *mut EventPointers) -> i32 {
        outcome(|| {
            check_null(view, "view")?;
            let pointers = table::with(client, |open| {
                open.client.next_event()?.ok_or(NOTHING_YET)?;
                let event = open.client.event.as_ref().ok_or(NOTHING_YET)?;
                // C needs the final NUL; an event without one, from a faulty sender, is shown without text.
                let has_nul = event.tail().last() == Some(&0) && !event_text(event).is_empty();
                let text = if has_nul { event.tail().as_ptr().cast() } else { c"".as_ptr() };
                Ok(EventPointers { event: event.message(), text })
            })?;
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(view, "view", pointers) }
        })
    }

    /// Adds a text to the session's events, which are recorded in the log. `severity` is TRB_SEVERITY_INFO
    /// etc.
    fn trb_remark(client: u64, severity: u32, text: *const c_char) -> i32 {
        outcome(|| {
            // SAFETY: null, or a text with a final NUL, as the header says.
            let text = unsafe { text_of(text, "text")? }.ok_or(Failure::Null("text"))?;
            table::with(client, |open| open.client.remark(severity, &text))
        })
    }

    /// Returns the oldest unread message about removed voxels; TRB_TIMEOUT if there is none. They are queued
    /// from this client's first call on, at most 512. The memory that `view` points to stays valid until this
    /// client's next call of trb_next_removed that returns TRB_OK, or trb_disconnect.
    fn trb_next_removed(client: u64, view: *mut RemovedPointers) -> i32 {
        outcome(|| {
            check_null(view, "view")?;
            let pointers = table::with(client, |open| {
                let removed = open.client.next_removed()?.ok_or(NOTHING_YET)?;
                // `Removed` is 32 bytes long, so its tail is as aligned as the message itself.
                let voxel_index = removed.tail().as_ptr().cast();
                Ok(RemovedPointers { removed: removed.message(), voxel_index })
            })?;
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(view, "view", pointers) }
        })
    }

    /// Returns the oldest unread reading of any sensor in the scene; TRB_TIMEOUT if there is none. Readings
    /// are queued from trb_connect on, at most 1024; readings that arrive with a state are available when the
    /// state is. `*reading` points into shared memory and stays valid and unchanged until this client's next
    /// call of trb_next_reading that returns TRB_OK, or trb_disconnect.
    fn trb_next_reading(client: u64, reading: *mut *const SensorReading) -> i32 {
        // SAFETY: the caller promises that `reading` is null or can be written.
        outcome(|| unsafe { put_found(client, (reading, "reading"), Client::next_reading) })
    }

    /// Returns the newest Jacobian of the tip; TRB_TIMEOUT if the scene does not set
    /// `manipulator.tip_jacobian`. That of a state is available when the state is. `*jacobian` points into
    /// shared memory and stays valid and unchanged until this client's next call of
    /// trb_newest_tip_jacobian, or trb_disconnect.
    fn trb_newest_tip_jacobian(client: u64, jacobian: *mut *const TipJacobian) -> i32 {
        // SAFETY: the caller promises that `jacobian` is null or can be written.
        outcome(|| unsafe { put_found(client, (jacobian, "jacobian"), Client::tip_jacobian) })
    }
}
