"""A connection to a session."""

from __future__ import annotations

import ctypes
import math
import threading
from collections import deque
from contextlib import contextmanager
from typing import Any, Callable, Iterator, Optional, Sequence, Type, TypeVar, Union

import numpy as np
import numpy.typing as npt

from . import _generated as g
from ._calls import Memory, check, connected, slices, text_of, whole
from ._calls import library as _library
from ._errors import ArgumentError, Ended, Error
from ._geometry import numbers
from ._results import Ct, Image, Info, Reading, Removal, SessionEvent, as_array
from ._view import Values, View

_byref = ctypes.byref
#: Most events that are kept for `events`, as many as the library's queue holds.
_MOST_UNREAD = 256

_V = TypeVar("_V", bound=View)


class Client:
    """A connection to a session: as a controller, or as an observer.

    A client belongs to the thread and process that made it. In a `fork` child every call fails, and the child's exit
    disconnects nobody (start processes with `spawn`, or connect in the child). Returned messages and arrays are read-only
    views of shared memory. Each method says until when its view stays unchanged; use `copy()` to keep the data. A view stays
    readable for as long as it is referenced, in any thread, even after the client is closed or gone. Used as a context
    manager, a client closes itself.

    Args:
        session: The session's folder or name; None uses the folder in the environment variable `TRABECULA_SESSION`, or
            else this user's only session; with several running, one must be named.
        controller: Name of the controller in the scene; "" joins as an observer, which sends no commands; None uses
            the name in `TRABECULA_CONTROLLER`, or else the scene's only external controller.
        timeout_s: How long to wait for the session.

    Raises:
        Error: No session, several and none named (at once, with their list), another version, an unknown controller, or one
            that is already connected.
    """

    def __init__(
        self, session: Optional[str] = None, controller: Optional[str] = None, timeout_s: float = 10.0
    ) -> None:
        self._number = connected(session, controller, timeout_s)
        self._thread = threading.current_thread()
        self._memory: Optional[Memory] = Memory(self._number)
        # One per kind of message: a signal handler may call the library between a call and the use of its
        # result.
        self._state, self._begun = ctypes.c_void_p(), ctypes.c_void_p()
        self._state_reference, self._begun_reference = _byref(self._state), _byref(self._begun)
        self._views: dict[tuple[Type[View], Optional[int]], Any] = {}
        #: Events that were read while looking for resets; and how many resets there have been.
        self._unread: deque[SessionEvent] = deque(maxlen=_MOST_UNREAD)
        self._resets = 0
        #: Tick of the newest state taken.
        self._tick: Optional[int] = None
        self._answered = False
        #: The library's command buffer, and the command that the caller fills in.
        self._sending: Optional[memoryview] = None
        self._command: Optional[g.Command] = None

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leaves the session. Views from this client stay readable for as long as they are referenced.

        Raises:
            Error: Another thread made the client and is still running.
        """
        if self._number:
            status = _library.trb_disconnect(self._number)
            # A thread's clients end with it; a parent's client stays connected.
            if status != g.ERROR_FORKED and self._is_of_a_running_thread():
                check(status)
        self._number, self._memory, self._views, self._sending = 0, None, {}, None
        self._end_command("its client has been closed")

    def __del__(self, disconnect: Callable[[int], int] = _library.trb_disconnect) -> None:
        if self._number:
            # Fails in a thread other than the client's own, which disconnects it when it ends.
            disconnect(self._number)

    #: The library's number of this client; 0 until connected, and once closed.
    _number = 0

    @property
    def _handle(self) -> int:
        if self._number == 0:
            raise Error(g.ERROR_HANDLE, "this client is closed and has left the session; make another one")
        return self._number

    def __repr__(self) -> str:
        if self._number == 0:
            return "Client(closed)"
        info = self.info
        return f"Client({info.controller or 'observer'!r}, {info.folder!r})"

    def _is_of_a_running_thread(self) -> bool:
        return self._thread.is_alive()

    def _end_command(self, why: str) -> None:
        command, self._command = self._command, None
        if command is not None:
            command._seal(bytes(command._buffer), why)

    def _bytes(self, address: Optional[int], size: int) -> memoryview:
        memory = (ctypes.c_ubyte * size).from_address(address)  # type: ignore[arg-type]  # none is a TypeError
        setattr(memory, "held", self._memory)  # keeps it mapped
        return memoryview(memory).cast("B")

    def _view(self, message: Type[_V], address: Optional[int]) -> _V:
        # A queue reuses the addresses of its samples.
        view: Optional[_V] = self._views.get((message, address))
        if view is None:
            view = message(self._bytes(address, message.dtype.itemsize).toreadonly())
            self._views[(message, address)] = view
        return view

    def _state_taken(self) -> g.State:
        state = self._view(g.State, self._state.value)
        self._tick, self._answered = state.tick, False
        return state

    def _array(self, address: Optional[int], dtype: str, count: int) -> npt.NDArray[Any]:
        size = count * np.dtype(dtype).itemsize
        return as_array(self._bytes(address, size).toreadonly(), dtype, count).view(Values) if count else np.empty(0, dtype)

    def _await(self, function: Callable[..., int], timeout_s: float, *arguments: object) -> None:
        """Calls a blocking function of the library in slices."""
        for slice_s, last in slices(timeout_s):
            status = function(*arguments[:-1], slice_s, arguments[-1])
            if status == g.OK:
                return
            if status != g.TIMEOUT or last:
                check(status)

    @property
    def info(self) -> Info:
        """Facts that stay constant during the session."""
        info = g.trb_session_info()
        check(_library.trb_get_info(self._handle, _byref(info)))
        values = {name: getattr(info, name) for name, *_ in info._fields_}
        for name in ("folder", "controller", "scene_toml"):
            values[name] = values[name].decode()
        values.update(lockstep=bool(info.lockstep), has_volume=bool(info.has_volume))
        return Info(**values)

    def wait_state(self, timeout_s: float = 30.0) -> g.State:
        """Waits for the newest state: yields for 20 µs, then sleeps until woken. It stays unchanged until the next state
        is taken.

        Raises:
            TimeoutError: None arrived in time.
            Ended: The run is over.
        """
        self._await(_library.trb_wait_state, timeout_s, self._handle, self._state_reference)
        return self._state_taken()

    def next_state(self, timeout_s: float = 30.0) -> g.State:
        """Waits for the oldest state not yet taken, for programs that need every state; the queue holds 512."""
        self._await(_library.trb_next_state, timeout_s, self._handle, self._state_reference)
        return self._state_taken()

    def poll_state(self) -> Optional[g.State]:
        """The newest state if one has arrived since the last call; does not wait.

        Raises:
            Ended: The run is over.
        """
        status = _library.trb_poll_state(self._handle, self._state_reference)
        if status == g.TIMEOUT:
            return None
        check(status)
        return self._state_taken()

    def states(self, timeout_s: float = math.inf) -> Iterator[g.State]:
        """Yields the newest state repeatedly until the run is over. While the run is paused, no states come and this waits.

        Raises:
            TimeoutError: None arrived within `timeout_s`.
        """
        while True:
            try:
                state = self.wait_state(timeout_s)
            except Ended:
                return
            yield state

    def step(self, ticks: int = 1, timeout_s: float = 30.0) -> g.State:
        """Takes part in the next `ticks` ticks and returns the state after them.

        A controller answers the newest state, if it has not done so yet, with the loaned command, or else with one that changes
        nothing; so it answers every state on the way: what it has asked for goes on. An observer only waits. A paused run makes these ticks and
        is paused again.

        Raises:
            TimeoutError: A tick did not come in time, as when another controller does not answer.
            Ended: The run is over.
        """
        if whole("ticks", ticks) == 0:
            raise ArgumentError("`ticks` is 0, expected 1 or more")
        if self._tick is None:
            self.wait_state(timeout_s)
        end = (self._tick or 0) + ticks
        is_controller = self.info.controller_index >= 0
        asked = self._step_if_paused(ticks, timeout_s)
        while True:
            # Another command in answer to the same state would replace the first one.
            if is_controller and not self._answered:
                self.loan_command()
                self.send_command()
            for slice_s, last in slices(timeout_s):
                try:
                    state = self.next_state(slice_s)
                except TimeoutError:
                    if last:
                        raise
                    # The status that says so may come after the reply to the request to pause.
                    asked = asked or self._step_if_paused(end - (self._tick or 0), timeout_s)
                    continue
                if state.tick >= end:
                    return state
                break

    def _step_if_paused(self, ticks: int, timeout_s: float) -> bool:
        """Asks a paused run for ticks; returns whether it has been asked."""
        status = self.status
        if status is None or status.phase != g.Phase.PAUSED:
            return False
        try:
            self.run_control(g.ControlAction.STEP, ticks, timeout_s)
        except Error as error:
            # It was resumed meanwhile.
            if error.status != g.ERROR_REFUSED:
                raise
        return True

    @property
    def states_missed(self) -> int:
        """States that were skipped or overwritten before this client took them."""
        count = ctypes.c_uint64()
        check(_library.trb_states_missed(self._handle, _byref(count)))
        return count.value

    def loan_command(self) -> g.Command:
        """The command that `send_command` will send: every mode at "none", `sequence` and `state_tick` filled in. Writable
        until then, in its own memory, so later changes have no effect.
        """
        status = _library.trb_loan_command(self._handle, self._begun_reference)
        if status:
            check(status)
        command = self._command
        if command is None:
            if self._sending is None:
                self._sending = self._bytes(self._begun.value, g.Command.dtype.itemsize)
            command = self._command = g.Command(bytearray(self._sending), {})
        return command

    def send_command(self) -> None:
        """Sends the loaned command as it is now; writing to it afterwards raises a ReadOnlyError. The physics checks it: a
        refused command changes nothing. In an accepted command, a part that the tool cannot follow (a goal out of reach)
        changes nothing, and the other parts take effect. Both cases are counted and reported in an event.
        """
        # Cleared first: a signal handler may begin a command of its own.
        command, self._command = self._command, None
        if command is None:
            check(_library.trb_send_command(self._handle))
            self._answered = True
            return
        content = bytes(command._buffer)
        self._sending[:] = content  # type: ignore[index]  # the loan has set it
        status = _library.trb_send_command(self._handle)
        if status:
            if status == g.ERROR_ARGUMENT:
                command._seal(content, "a signal's handler has sent or discarded it")
            else:
                self._command = command
            check(status)
        self._answered = True
        command._seal(content, "it has been sent")

    def discard_command(self) -> None:
        """Discards the loaned command without sending it."""
        check(_library.trb_discard_command(self._handle))
        self._end_command("it has been discarded")

    @contextmanager
    def command(self) -> Iterator[g.Command]:
        """The command that answers the last state taken. Sent at the end of the `with` block; an exception discards it."""
        command = self.loan_command()
        try:
            yield command
        except BaseException:
            self.discard_command()
            raise
        self.send_command()

    def request_frame(
        self,
        tick: int = 0,
        position_m: Optional[Sequence[float]] = None,
        orientation_xyzw: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
    ) -> int:
        """Requests an X-ray frame and returns the request's number.

        Args:
            tick: The frame shows the state of this tick, or the newest one if that has passed.
            position_m: Isocentre of the C-arm in the world; None uses the scene's C-arm unchanged.
            orientation_xyzw: Orientation of the C-arm in the world: +x along the image rows to the right, +y along the
                columns down, +z to the source.
        """
        number = ctypes.c_uint64()
        pose = None
        if position_m is not None:
            pose = g.Pose()
            pose.position_m = numbers("position_m", position_m, 3)
            pose.orientation_xyzw = numbers("orientation_xyzw", orientation_xyzw, 4)
        address = None if pose is None else pose.array.ctypes.data
        check(_library.trb_request_frame(self._handle, address, whole("tick", tick), _byref(number)))
        return number.value

    def wait_frame(self, request_id: int = 0, timeout_s: float = 30.0) -> Image:
        """Waits for the frame of a request, or with 0 for the next one of any kind. Its memory is reused after the next
        frame. Frames are queued from the first call of this or `request_frame` on, at most 64.

        Raises:
            TimeoutError: None arrived in time.
            Ended: The run is over, and no frame is being rendered.
            Error: The request was refused, or the scene has no X-ray.
        """
        view = g.trb_frame_view()
        self._await(_library.trb_wait_frame, timeout_s, self._handle, whole("request_id", request_id), _byref(view))
        frame = self._view(g.Frame, view.frame)
        geometry = frame.geometry
        pixels = self._array(view.pixels, "<u2", view.pixel_count)
        return Image(frame, pixels.reshape(geometry.rows, geometry.columns))

    def volume(self, timeout_s: float = 30.0) -> Ct:
        """The CT volume as at the start of the run, in place; it never changes."""
        view = g.trb_volume_view()
        self._await(_library.trb_get_volume, timeout_s, self._handle, _byref(view))
        volume = self._view(g.Volume, view.volume)
        hu = self._array(view.hu, "<i2", view.voxel_count)
        return Ct(volume, hu.reshape(volume.dimensions[::-1]))

    def run_control(
        self, action: Union[g.ControlAction, int], ticks: int = 0, timeout_s: float = 10.0
    ) -> int:
        """Sends a run-control request (`ControlAction.PAUSE` …; `ticks` is for `ControlAction.STEP`) and returns the tick at
        which it took effect.

        Raises:
            TimeoutError: No reply arrived in time.
            Ended: The run is over.
            Error: The action was refused.
        """
        if isinstance(action, bool) or not isinstance(action, int) or not 0 <= action < 2**32:
            known = ", ".join(f"{known.value} {known.name}" for known in g.ControlAction)
            raise ArgumentError(f"`action` is {action!r}, expected a ControlAction: {known}")
        if action == 0:
            raise Error(g.ERROR_REFUSED, "run control knows no action 0; actions are 1 to 5")
        ticks = whole("ticks", ticks)
        reply = g.RunControlReply()
        address, status = reply.array.ctypes.data, g.TIMEOUT
        for slice_s, last in slices(timeout_s):
            status = _library.trb_control_run(self._handle, action, ticks, slice_s, address)
            # The request has been sent; from here on only wait for its reply.
            action = 0
            if status != g.TIMEOUT or last:
                break
        check(status)
        return reply.tick

    @property
    def status(self) -> Optional[g.RunStatus]:
        """A copy of the run's newest status, if one has arrived."""
        status = g.RunStatus()
        code = _library.trb_get_status(self._handle, status.array.ctypes.data)
        if code == g.TIMEOUT:
            return None
        check(code)
        return status

    def events(self) -> list[SessionEvent]:
        """Copies of all events since the last call; queued from the first call of this or `reset_count` on, at most 256."""
        self._read_events()
        events = list(self._unread)
        self._unread.clear()
        return events

    @property
    def reset_count(self) -> int:
        """How often the run was reset since this client first looked at this or at `events`. Ticks and simulated time go on after
        a reset; tool, bone and energies are those of the start.
        """
        self._read_events()
        return self._resets

    def _read_events(self) -> None:
        view = g.trb_event_view()
        while True:
            status = _library.trb_next_event(self._handle, _byref(view))
            if status == g.TIMEOUT:
                return
            check(status)
            event = self._view(g.Event, view.event)
            heard = SessionEvent(event.tick, event.severity, event.code, event.sender, view.text.decode())
            self._resets += heard.is_reset()
            self._unread.append(heard)

    def remark(self, text: str, severity: Union[g.Severity, int] = g.Severity.INFO) -> None:
        """Adds a line to the session's events, which the log records."""
        if not isinstance(text, str):
            raise ArgumentError(f"`text` is {text!r}, expected a text")
        check(_library.trb_remark(self._handle, severity, text.encode()))

    def readings(self) -> list[Reading]:
        """Copies of the sensors' readings since the last call; queued from the connection on, at most 1024. Those that arrive with
        a state are there when the state is.
        """
        readings: list[Reading] = []
        address = ctypes.c_void_p()
        while True:
            status = _library.trb_next_reading(self._handle, _byref(address))
            if status == g.TIMEOUT:
                return readings
            check(status)
            readings.append(Reading.of(self._view(g.SensorReading, address.value)))

    def next_removed(self) -> Optional[Removal]:
        """The oldest message about removed voxels not yet taken, if any; queued from the first call on, at most 512. Its
        memory is reused after the next one.
        """
        view = g.trb_removed_view()
        status = _library.trb_next_removed(self._handle, _byref(view))
        if status == g.TIMEOUT:
            return None
        check(status)
        removed = self._view(g.Removed, view.removed)
        return Removal(removed, self._array(view.voxel_index, "<u4", removed.voxel_index_length))
