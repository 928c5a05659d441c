//! The part of docs/messages.md that explains how to join a session with iceoryx2 alone.

use crate::messages::PHASE_ENDED;
use crate::services::{self, SAMPLES_HELD};
use crate::session::{CONTROLLER_VARIABLE, ICEORYX2_VERSION, PAGE_FILE, Reader, SESSION_VARIABLE, prefix_of};
use crate::shared_page::FLAG_STRIDE;

/// The text, with names, numbers and offsets taken from the hub's own constants.
pub(crate) fn transport_reference() -> String {
    let prefix = prefix_of("<name of the folder>");
    let command = services::command_name("<controller>");
    let [state, status] = [services::STATE.name, services::RUN_STATUS.name];
    let [physics, drr] = [Reader::Physics, Reader::Drr].map(Reader::event_name);
    format!(
        "
## Joining with iceoryx2 alone

The client library does all of this ([clients.md](clients.md)). A program may also do it itself, in any language that has
iceoryx2 **{ICEORYX2_VERSION}**: another version of it finds nothing. `clients/python/tests/bare_iceoryx2.py` is a controller
written from this page, with the PyPI package (test `a_controller_written_from_the_page_alone_drives_a_run_to_its_end`).

1. **The session** is a folder: `{SESSION_VARIABLE}` holds its path in a program that the run starts, and `trabecula run`
   prints it. Its `session.json` appears when all services are there. Of its keys, `iceoryx2` is the transport's version,
   `layouts` the layout of each service's message (compare them with those of this page), `controllers` the names in the
   scene's order (a controller's index is its place there), `volume_bytes` and `frame_bytes` the most bytes of these messages.
2. **The node**: iceoryx2's default configuration, but for the root path (`global.root-path`), which is the session's folder,
   and the prefix (`global.prefix`), which is `{prefix}`. Let it handle no signals.
3. **Services**: the table below has their names. All are there: open them, create none. They are publish-subscribe with the
   payload `[u8]`, a slice of bytes of alignment 1 (in Python `iceoryx2.Slice[ctypes.c_uint8]`), and no user header; the
   attribute `layout` holds the layout. What is in a slice is one message, with its tail if it has one.
   - A subscriber asks for the buffer size in the column \"queue\", or less. It may hold {SAMPLES_HELD} samples at a time:
     give each back before the next but one. A sender that has gone takes its unread messages along.
   - A publisher's longest slice (`initial_max_slice_len`) is the column \"most bytes\". It loans exactly a message's bytes,
     writes all of them, those that mean nothing with 0, sends, and writes them no more.
4. **Waking.** Who waits for messages sleeps. So behind each message to one of these readers, send an event on its event
   service (the number of the event does not matter). Without `{physics}` the physics looks by itself every 10 ms only, and a
   lockstep tick takes that long.

{table}
   The flag is a `uint32` in the file `{PAGE_FILE}` of the session's folder, shared by all (map it, do not copy it): 0 while
   the reader is awake. A writer may spare itself the event then; it needs a sequentially consistent fence between its message
   and its look. A controller sets its own flag to 1 when it joins and leaves it so: then each state comes with an event, and
   the controller takes what is in its queues and waits for the next one, with a limit.
5. **A controller** is the publisher of `{command}`, of which there is one at a time; `{CONTROLLER_VARIABLE}` holds the name in
   a program that the run starts. It has joined when its first command has been accepted: until every controller that is not
   `optional` has answered the state of tick 0, no tick is made. It answers the newest state of `{state}`: `state_tick` is
   that state's `tick`, and `sequence` counts from 1 in each connection. In lockstep the next tick is made when the newest
   command of every controller that has joined answers the newest state. What is refused is said on `event`, with field and
   range, and is no answer.
6. **A frame** on request: a `DrrRequest` on `{drr_request}`, an event on `{drr}`, then a `DrrReply` and the `Frame`, both with
   the request's number.
7. **The end** is a `RunStatus` on `{status}` with `phase` {PHASE_ENDED}, behind the last state. The session's folder and its
   shared memory are removed soon after. A hub that was killed says nothing: no wait is without a limit.
",
        table = wake_table(),
        drr_request = services::DRR_REQUEST.name,
    )
}

fn wake_table() -> String {
    let row = |who: &str, reader: Reader, offset: String| {
        let event = reader.event_name().replace("/0", "/<index>");
        format!("   | {who} | `{event}` | {offset} |\n")
    };
    let at = |reader: Reader| (reader.slot() * FLAG_STRIDE).to_string();
    let controller = Reader::Controller(0);
    let offset = format!("{} + {FLAG_STRIDE} × index", at(controller));
    [
        "   | reader | event service | its flag is at byte |\n   |---|---|---|\n".to_owned(),
        row("physics (commands, run control)", Reader::Physics, at(Reader::Physics)),
        row("DRR (requests for frames)", Reader::Drr, at(Reader::Drr)),
        row("recorder (nobody need wake it)", Reader::Recorder, at(Reader::Recorder)),
        row("a controller (states)", controller, offset),
    ]
    .concat()
}
