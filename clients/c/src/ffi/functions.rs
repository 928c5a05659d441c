//! The functions.

use std::ffi::{CStr, CString, c_char};
use std::sync::OnceLock;

use ipc_types::messages::{Command, Pose, RunControlReply, RunStatus, State};

use super::outcome::{self, Failure, outcome};
use super::views::{EventPointers, FramePointers, RemovedPointers, SessionInfo, VolumePointers};
use super::{memory, table};
use crate::bindings;
use crate::client::{Client, Connection, event_text, limit_of};
use crate::error::ClientError;
use crate::frames::frame_view;

/// Writes a result to where the caller wants it.
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

/// A text that may be absent.
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

functions! {
    /// Version of the library. The text lives for ever.
    fn trb_version() -> *const c_char {
        const { CStr::from_bytes_with_nul(concat!(env!("CARGO_PKG_VERSION"), "\0").as_bytes()) }
            .unwrap_or_default()
            .as_ptr()
    }

    /// Layouts of all messages and of this interface as the library has them:
    /// "State=729b226247fc0784;Command=...;Abi=...". The text lives for ever.
    fn trb_layouts() -> *const c_char {
        static LAYOUTS: OnceLock<CString> = OnceLock::new();
        LAYOUTS.get_or_init(|| CString::new(bindings::layouts()).unwrap_or_default()).as_ptr()
    }

    /// What went wrong in this thread's last call that returned an error: what was given, what was expected, what to do.
    /// The text lives until this thread's next call that returns an error, or its end.
    fn trb_last_error() -> *const c_char {
        outcome::last_error()
    }

    /// Connects to a session. `layouts` is TRB_LAYOUTS of the header that the program was compiled with; a message that the
    /// library or the hub lays out otherwise, or another version of these functions (Abi), is refused by name. `session` is
    /// a session's folder or name; null takes the folder in the environment variable TRABECULA_SESSION, or else this
    /// user's session that was announced last.
    /// `controller` is a controller's name in the scene, or empty for an observer that commands nothing; null takes the name
    /// in TRABECULA_CONTROLLER, or else the scene's only external controller. Waits at most `timeout_s` for the session.
    /// `client` receives a handle, which belongs to the calling thread.
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
                (text_of(layouts, "layouts")?, text_of(session, "session")?, text_of(controller, "controller")?)
            };
            bindings::check_layouts(&layouts.ok_or(Failure::Null("layouts"))?)?;
            let connection = Connection { session, controller, limit: limit_of(timeout_s)? };
            let handle = table::insert(Client::connect(&connection)?)?;
            // SAFETY: `client` is not null; the caller promises that it can be written.
            unsafe { put(client, "client", handle) }
        })
    }

    /// Leaves the session. Every pointer that this client has given ends here, unless trb_hold_memory keeps it. A process
    /// that ends without it is cleaned up behind. In a child of fork() it is refused, and the parent stays connected.
    fn trb_disconnect(client: u64) -> i32 {
        outcome(|| table::remove(client))
    }

    /// Keeps what this client has handed out, and what is in it, beyond trb_disconnect and the end of its thread: all of its
    /// pointers that are good then stay so until trb_release_memory has been called as often. For languages in which memory
    /// lives as long as somebody looks at it.
    fn trb_hold_memory(client: u64) -> i32 {
        outcome(|| {
            table::with(client, |_| {
                memory::hold(client);
                Ok(())
            })
        })
    }

    /// Takes one trb_hold_memory back; the last one behind the client's end ends its pointers. Any thread may call it.
    fn trb_release_memory(client: u64) -> i32 {
        outcome(|| memory::release(client))
    }

    /// Facts that do not change during the session.
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
                    controller_index: facts.controller.as_ref().map_or(-1, |(_, index)| *index as i32),
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

    /// The newest state, if one has come since the last call; without waiting. Older ones are passed over and counted
    /// (trb_states_missed). TRB_TIMEOUT says that none has come, TRB_ENDED that none will. `*state` lies in shared memory
    /// and stays, unchanged, until this client's next call of trb_poll_state, trb_wait_state, trb_next_state or
    /// trb_disconnect that returns TRB_OK.
    fn trb_poll_state(client: u64, state: *mut *const State) -> i32 {
        outcome(|| {
            check_null(state, "state")?;
            let newest = table::with(client, |open| {
                let newest = open.client.poll_state()?;
                newest.map(core::ptr::from_ref).ok_or(ClientError::TimedOut(core::time::Duration::ZERO))
            })?;
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(state, "state", newest) }
        })
    }

    /// Waits for the newest state: yields for 20 microseconds, then sleeps until woken (an observer looks every 0.2 ms).
    /// Otherwise as trb_poll_state.
    fn trb_wait_state(client: u64, timeout_s: f64, state: *mut *const State) -> i32 {
        outcome(|| {
            check_null(state, "state")?;
            let limit = limit_of(timeout_s)?;
            let newest = table::with(client, |open| open.client.wait_state(limit).map(core::ptr::from_ref))?;
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(state, "state", newest) }
        })
    }

    /// Waits for the oldest state that has not been taken, for programs that want every one; 512 are kept. Otherwise as
    /// trb_wait_state.
    fn trb_next_state(client: u64, timeout_s: f64, state: *mut *const State) -> i32 {
        outcome(|| {
            check_null(state, "state")?;
            let limit = limit_of(timeout_s)?;
            let oldest = table::with(client, |open| open.client.next_state(limit).map(core::ptr::from_ref))?;
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(state, "state", oldest) }
        })
    }

    /// Number of states that were passed over or overwritten before this client took them.
    fn trb_states_missed(client: u64, count: *mut u64) -> i32 {
        outcome(|| {
            let missed = table::with(client, |open| Ok(open.client.states_missed()))?;
            // SAFETY: the caller promises that `count` is null or can be written.
            unsafe { put(count, "count", missed) }
        })
    }

    /// The command that will be sent next, to be filled in: every mode at "none", `sequence` and `state_tick` filled in for
    /// the state taken last. The same one until trb_send_command, trb_discard_command or trb_disconnect, where it ends. It
    /// lies in the client's own memory: trb_send_command copies it, and what is written later reaches nobody.
    fn trb_loan_command(client: u64, command: *mut *mut Command) -> i32 {
        outcome(|| {
            check_null(command, "command")?;
            let begun = table::with(client, |open| open.client.command().map(core::ptr::from_mut))?;
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(command, "command", begun) }
        })
    }

    /// Sends the loaned command as it is now and wakes the physics, which checks it: a command that it refuses changes nothing. Of one
    /// that it takes, a part that the tool cannot follow (a goal out of reach) changes nothing, the others act. Both are
    /// counted in the status and said in an event.
    fn trb_send_command(client: u64) -> i32 {
        outcome(|| table::with(client, |open| open.client.send()))
    }

    /// Forgets the loaned command unsent. Without one it does nothing.
    fn trb_discard_command(client: u64) -> i32 {
        outcome(|| {
            table::with(client, |open| {
                open.client.discard_command();
                Ok(())
            })
        })
    }

    /// Asks for an X-ray frame. `t_world_c_arm` is the pose of the C-arm: origin in the isocentre, +x along the picture's
    /// rows to the right, +y along its columns down, +z to the source; distances, pixels and pitch are the scene's. Null
    /// takes the scene's C-arm as it stands. The frame shows the state of `tick`, or the newest one when that has passed.
    /// `request_id` receives the request's number.
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

    /// Waits for a frame: that of a request, or with `request_id` 0 the next one of any kind; with a request, others that
    /// come before it are passed over. Frames are kept from this client's first call of trb_request_frame or
    /// trb_wait_frame on, 64 at most. TRB_ENDED says that the run is over and none is being rendered. What `view` points at
    /// lies in shared memory and stays, unchanged, until this client's next call of trb_wait_frame that returns TRB_OK, or
    /// trb_disconnect.
    fn trb_wait_frame(client: u64, request_id: u64, timeout_s: f64, view: *mut FramePointers) -> i32 {
        outcome(|| {
            check_null(view, "view")?;
            let limit = limit_of(timeout_s)?;
            let pointers = table::with(client, |open| {
                open.client.wait_frame(request_id, limit)?;
                let frame = open.client.frame.as_ref().and_then(frame_view);
                let frame = frame.ok_or(ClientError::Misuse("the frame is not there"))?;
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

    /// The CT volume as it was at the start. What `view` points at lies in shared memory and stays until trb_disconnect.
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

    /// Asks run control for an action (TRB_CONTROL_PAUSE and so on; `ticks` is for TRB_CONTROL_STEP) and waits for the
    /// answer. Action 0 asks for nothing and waits on for the answer of a call that timed out. `reply` may be null.
    fn trb_control_run(client: u64, action: u32, ticks: u64, timeout_s: f64, reply: *mut RunControlReply) -> i32 {
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

    /// Where the run stands: a copy of the newest status. TRB_TIMEOUT if none has come yet.
    fn trb_get_status(client: u64, status: *mut RunStatus) -> i32 {
        outcome(|| {
            let newest = table::with(client, |open| {
                open.client.status()?.ok_or(ClientError::TimedOut(core::time::Duration::ZERO))
            })?;
            // SAFETY: the caller promises that `status` is null or can be written.
            unsafe { put(status, "status", newest) }
        })
    }

    /// The oldest event that has not been taken; TRB_TIMEOUT if there is none. Events are kept from this client's first
    /// call on, 256 at most. What `view` points at stays until this client's next call of trb_next_event that returns TRB_OK,
    /// or trb_disconnect.
    fn trb_next_event(client: u64, view: *mut EventPointers) -> i32 {
        outcome(|| {
            check_null(view, "view")?;
            let pointers = table::with(client, |open| {
                let none = || ClientError::TimedOut(core::time::Duration::ZERO);
                open.client.next_event()?.ok_or_else(none)?;
                let event = open.client.event.as_ref().ok_or_else(none)?;
                // C needs the final NUL; a broken sender's event without one is shown without text.
                let has_nul = event.tail().last() == Some(&0) && !event_text(event).is_empty();
                let text = if has_nul { event.tail().as_ptr().cast() } else { c"".as_ptr() };
                Ok(EventPointers { event: event.message(), text })
            })?;
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(view, "view", pointers) }
        })
    }

    /// Writes a line to the session's events, and so into the log. `severity` is TRB_SEVERITY_INFO and so on.
    fn trb_remark(client: u64, severity: u32, text: *const c_char) -> i32 {
        outcome(|| {
            // SAFETY: null, or a text with a final NUL, as the header says.
            let text = unsafe { text_of(text, "text")? }.ok_or(Failure::Null("text"))?;
            table::with(client, |open| open.client.remark(severity, &text))
        })
    }

    /// The oldest message about removed voxels that has not been taken; TRB_TIMEOUT if there is none. They are kept from
    /// this client's first call on, 512 at most. What `view` points at stays until this client's next call of
    /// trb_next_removed that returns TRB_OK, or trb_disconnect.
    fn trb_next_removed(client: u64, view: *mut RemovedPointers) -> i32 {
        outcome(|| {
            check_null(view, "view")?;
            let pointers = table::with(client, |open| {
                let none = ClientError::TimedOut(core::time::Duration::ZERO);
                let removed = open.client.next_removed()?.ok_or(none)?;
                // `Removed` is 32 bytes long, so its tail is as aligned as the message itself.
                Ok(RemovedPointers { removed: removed.message(), voxel_index: removed.tail().as_ptr().cast() })
            })?;
            // SAFETY: not null; the caller promises that it can be written.
            unsafe { put(view, "view", pointers) }
        })
    }
}
