//! The part of docs/messages.md that explains how to join a session with iceoryx2 alone.

use crate::messages::services::{self, SAMPLES_HELD};
use crate::messages::{ControllerIndex, PHASE_ENDED};
use crate::session::{CONTROLLER_VARIABLE, ICEORYX2_VERSION, PAGE_FILE, Reader, SESSION_VARIABLE, prefix_of};
use crate::shared_page::FLAG_STRIDE;

/// Returns the text, with names, numbers and offsets taken from the hub's own constants.
pub(crate) fn transport_reference() -> String {
    let prefix = prefix_of("<name of the folder>");
    let command = services::command_name("<controller>");
    let [state, status] = [services::STATE.name, services::RUN_STATUS.name];
    let [physics, drr] = [Reader::Physics, Reader::Drr].map(Reader::event_name);
    format!(
        "
## Joining with iceoryx2 alone

The client library does all of this ([clients.md](clients.md)). A program can also do it itself, in any language that has
iceoryx2 **{ICEORYX2_VERSION}**; other versions do not find the services. `clients/python/tests/test_bare_iceoryx2.py` has a
controller written from this page, with the PyPI package.

1. **The session** is a folder. `trabecula run` prints its path, and passes it to the programs that it starts in
   `{SESSION_VARIABLE}`. The file `session.json` appears there once all services exist. Its keys: `iceoryx2` is the
   transport's version, `layouts` the layout of each service's message (compare them with this page), `controllers` the
   controllers' names in the scene's order (the position is the controller's index), `volume_bytes` and `frame_bytes` the
   maximum sizes of these two messages.
2. **The node** uses iceoryx2's default configuration, except for the root path (`global.root-path`), which is the session's
   folder, and the prefix (`global.prefix`), which is `{prefix}`. Disable its signal handling.
3. **Services**: the table below lists their names. All of them exist already: open them, and never create one. They are
   publish-subscribe with the payload `[u8]`, a slice of bytes with alignment 1 (in Python `iceoryx2.Slice[ctypes.c_uint8]`),
   and no user header; the attribute `layout` holds the layout. Each slice contains one message, including its tail if any.
   - A subscriber requests at most the buffer size in the column \"queue\". It may hold {SAMPLES_HELD} samples at a time, so
     release each one before receiving the next but one. When a sender disconnects, its unread messages are lost.
   - A publisher's longest slice (`initial_max_slice_len`) is in the column \"max. bytes\". The publisher loans exactly the
     size of the message, writes every byte (0 where unused), sends, and does not touch the slice again.
4. **Waking.** Readers sleep while they wait. So after each message to one of the readers below, send an event on its event
   service (the event number does not matter). Without an event on `{physics}`, the physics polls only every 10 ms, and a
   lockstep tick takes that long.

{table}
   The flag is a `uint32` in the file `{PAGE_FILE}` in the session's folder. All processes share it, so map the file and do
   not copy it. The flag is 0 while the reader is awake; a writer may then skip the event, but needs a sequentially
   consistent fence between sending the message and reading the flag. The simplest controller sets its own flag to 1 when it
   joins and never clears it: every state then comes with an event, and the controller empties its queues and waits for the
   next event, with a time limit.
5. **A controller** is the publisher of `{command}`; only one may exist at a time. In a program that the run starts,
   `{CONTROLLER_VARIABLE}` holds the name. The controller has joined once its first command is accepted; the first tick
   waits until every controller that is not `optional` has answered the state of tick 0. A command answers the newest state
   of `{state}`: `state_tick` is that state's `tick`, and `sequence` counts from 1 in each connection. In lockstep, the next
   tick starts when every joined controller has answered the newest state. A refused command does not count as an answer; an
   `event` names the field and its range.
6. **A requested frame**: send a `DrrRequest` on `{drr_request}` and an event on `{drr}`; a `DrrReply` and the `Frame` follow,
   both with the request's number. Until the reply has come, call the publisher's `update_connections` regularly: the DRR
   process may begin to listen only after the request.
7. **The end** is a `RunStatus` on `{status}` with `phase` {PHASE_ENDED}, after the last state. The session's folder and its
   shared memory are removed soon after. A killed hub sends nothing, so give every wait a time limit.
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
    let controller = Reader::Controller(ControllerIndex(0));
    let offset = format!("{} + {FLAG_STRIDE} × index", at(controller));
    [
        "   | reader | event service | byte offset of its flag |\n   |---|---|---|\n".to_owned(),
        row("physics (commands, run control)", Reader::Physics, at(Reader::Physics)),
        row("DRR (frame requests)", Reader::Drr, at(Reader::Drr)),
        row("recorder (needs no waking)", Reader::Recorder, at(Reader::Recorder)),
        row("a controller (states)", controller, offset),
    ]
    .concat()
}
