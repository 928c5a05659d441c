"""A connection to a session."""

from __future__ import annotations

import ctypes
import math
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Iterator, NamedTuple, Optional, Sequence, Type, TypeVar

import numpy as np

from . import _generated as g
from ._library import load
from ._view import View

_library = load()
_byref = ctypes.byref
#: Longest uninterrupted wait inside the library, so that Ctrl-C gets through.
_SLICE_S = 0.1

_V = TypeVar("_V", bound=View)


class Error(RuntimeError):
    """A failed call. The text says what was given, what was expected and what to do."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        #: One of the `ERROR_` constants.
        self.status = status


class Ended(Exception):
    """The run is over."""


def _check(status: int) -> None:
    if status == g.OK:
        return
    if status == g.TIMEOUT:
        raise TimeoutError("nothing came in time")
    if status == g.ENDED:
        raise Ended("the run has ended")
    raise Error(status, _library.trb_last_error().decode())


def _slices(timeout_s: float) -> Iterator[tuple[float, bool]]:
    """Splits a wait into short waits inside the library: their lengths, and whether each is the last."""
    if not timeout_s >= 0.0:
        raise Error(g.ERROR_ARGUMENT, f"`timeout_s` is {timeout_s}, expected 0 or more seconds")
    deadline = time.monotonic() + timeout_s
    last = False
    while not last:
        left_s = deadline - time.monotonic()
        last = left_s <= _SLICE_S
        yield max(0.0, min(_SLICE_S, left_s)), last


def _text(text: Optional[str]) -> Optional[bytes]:
    return None if text is None else text.encode()


def _connected(session: Optional[str], controller: Optional[str], timeout_s: float) -> int:
    """Connects a client and returns its handle."""
    handle = ctypes.c_uint64()
    layouts = g.LAYOUTS.encode()
    for slice_s, last in _slices(timeout_s):
        given = (layouts, _text(session), _text(controller), slice_s)
        status = _library.trb_connect(*given, _byref(handle))
        if status != g.ERROR_NO_SESSION or last:
            break
    _check(status)
    return handle.value


class _Memory:
    """Keeps the client's shared memory mapped while this object lives, in any thread and past the client's end."""

    def __init__(self, handle: int) -> None:
        self._handle = 0
        _check(_library.trb_hold_memory(handle))
        self._handle = handle

    def __del__(self, release=_library.trb_release_memory) -> None:
        if self._handle:
            release(self._handle)


@dataclass(frozen=True)
class Info:
    """Facts that stay constant during a session."""

    #: Folder of the session.
    folder: str
    #: Name of this client's controller; empty for an observer.
    controller: str
    #: The whole scene as TOML.
    scene_toml: str
    #: Simulated time of a tick.
    dt_s: float
    #: Ticks of the whole run.
    tick_count: int
    #: Ticks between two scheduled frames; 0 if there are none.
    frame_period_ticks: int
    #: Index of the controller in the scene; -1 for an observer.
    controller_index: int
    #: Number of controllers in the scene.
    controller_count: int
    #: Whether a tick waits for every controller.
    lockstep: bool
    #: Pixel columns of a frame; 0 without X-ray.
    frame_columns: int
    #: Pixel rows of a frame; 0 without X-ray.
    frame_rows: int
    #: Whether there is a CT volume.
    has_volume: bool


class Image(NamedTuple):
    """An X-ray frame in shared memory."""

    #: Tick, C-arm and size.
    frame: g.Frame
    #: Intensities as uint16, shape (rows, columns), row 0 at the top; 0 is black.
    pixels: np.ndarray


class Ct(NamedTuple):
    """The CT volume in shared memory."""

    #: Geometry.
    volume: g.Volume
    #: Hounsfield units as int16, shape (z, y, x).
    hu: np.ndarray


class Removal(NamedTuple):
    """Voxels removed at a tick, in shared memory."""

    #: The message.
    removed: g.Removed
    #: Flat indices as uint32, x fastest: `ct.hu.reshape(-1)[voxel_index]`.
    voxel_index: np.ndarray


class SessionEvent(NamedTuple):
    """An event of the session."""

    #: Tick at which the sender noticed it.
    tick: int
    #: 0 information, 1 warning, 2 error.
    severity: int
    #: Kind of event: one of the `EVENT_` constants.
    code: int
    #: Sender: one of the `SENDER_` constants.
    sender: int
    #: What happened.
    text: str


class Client:
    """A connection to a session: as a controller, or as an observer.

    A client belongs to the thread and process that made it. In a `fork` child every call fails, and the child's exit
    disconnects nobody (start processes with `spawn`, or connect in the child). Returned messages and arrays are read-only
    views of shared memory. Each method says until when its view stays unchanged; use `copy()` to keep the data. A view stays
    readable for as long as it is referenced, in any thread, even after the client is closed or gone. Used as a context
    manager, a client closes itself.

    Args:
        session: The session's folder or name; None uses the folder in the environment variable `TRABECULA_SESSION`, or
            else this user's session that was announced last.
        controller: Name of the controller in the scene; "" joins as an observer, which sends no commands; None uses
            the name in `TRABECULA_CONTROLLER`, or else the scene's only external controller.
        timeout_s: How long to wait for the session.

    Raises:
        Error: No session, another version, an unknown controller, or one that is already connected.
    """

    def __init__(
        self, session: Optional[str] = None, controller: Optional[str] = None, timeout_s: float = 10.0
    ) -> None:
        self._handle = _connected(session, controller, timeout_s)
        self._thread = threading.current_thread()
        self._memory: Optional[_Memory] = _Memory(self._handle)
        # One per kind of message: a signal handler may call the library between a call and the use of its result.
        self._state, self._begun = ctypes.c_void_p(), ctypes.c_void_p()
        self._state_reference, self._begun_reference = _byref(self._state), _byref(self._begun)
        self._views: dict = {}
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
        if self._handle:
            status = _library.trb_disconnect(self._handle)
            # A thread's clients end with it; a parent's client stays connected.
            if status != g.ERROR_FORKED and self._is_of_a_running_thread():
                _check(status)
        self._handle, self._memory, self._views, self._sending = 0, None, {}, None
        self._end_command("its client has been closed")

    def __del__(self, disconnect=_library.trb_disconnect) -> None:
        if self._handle:
            # Fails in a thread other than the client's own, which disconnects it when it ends.
            disconnect(self._handle)

    #: 0 until connected.
    _handle = 0

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
        view = self._views.get((message, address))
        if view is None:
            view = message(self._bytes(address, message.dtype.itemsize).toreadonly())
            self._views[(message, address)] = view
        return view

    def _array(self, address: Optional[int], dtype: str, count: int) -> np.ndarray:
        size = count * np.dtype(dtype).itemsize
        return np.frombuffer(self._bytes(address, size).toreadonly(), dtype) if count else np.empty(0, dtype)

    def _await(self, function, timeout_s: float, *arguments: object) -> None:
        """Calls a blocking function of the library in slices."""
        for slice_s, last in _slices(timeout_s):
            status = function(*arguments[:-1], slice_s, arguments[-1])
            if status == g.OK:
                return
            if status != g.TIMEOUT or last:
                _check(status)

    @property
    def info(self) -> Info:
        """Facts that stay constant during the session."""
        info = g.trb_session_info()
        _check(_library.trb_get_info(self._handle, _byref(info)))
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
        return self._view(g.State, self._state.value)

    def next_state(self, timeout_s: float = 30.0) -> g.State:
        """Waits for the oldest state not yet taken, for programs that need every state; the queue holds 512."""
        self._await(_library.trb_next_state, timeout_s, self._handle, self._state_reference)
        return self._view(g.State, self._state.value)

    def poll_state(self) -> Optional[g.State]:
        """The newest state if one has arrived since the last call; does not wait.

        Raises:
            Ended: The run is over.
        """
        status = _library.trb_poll_state(self._handle, self._state_reference)
        if status == g.TIMEOUT:
            return None
        _check(status)
        return self._view(g.State, self._state.value)

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

    @property
    def states_missed(self) -> int:
        """States that were skipped or overwritten before this client took them."""
        count = ctypes.c_uint64()
        _check(_library.trb_states_missed(self._handle, _byref(count)))
        return count.value

    def loan_command(self) -> g.Command:
        """The command that `send_command` will send: every mode at "none", `sequence` and `state_tick` filled in. Writable
        until then, in its own memory, so later changes have no effect.
        """
        status = _library.trb_loan_command(self._handle, self._begun_reference)
        if status:
            _check(status)
        command = self._command
        if command is None:
            if self._sending is None:
                self._sending = self._bytes(self._begun.value, g.Command.dtype.itemsize)
            command = self._command = g.Command(bytearray(self._sending), {})
        return command

    def send_command(self) -> None:
        """Sends the loaned command as it is now; writing to it afterwards raises a ValueError. The physics checks it: a
        refused command changes nothing. In an accepted command, a part that the tool cannot follow (a goal out of reach)
        changes nothing, and the other parts take effect. Both cases are counted and reported in an event.
        """
        # Cleared first: a signal handler may begin a command of its own.
        command, self._command = self._command, None
        if command is None:
            return _check(_library.trb_send_command(self._handle))
        content = bytes(command._buffer)
        self._sending[:] = content  # type: ignore[index]  # the loan has set it
        status = _library.trb_send_command(self._handle)
        if status:
            if status == g.ERROR_ARGUMENT:
                command._seal(content, "a signal's handler has sent or discarded it")
            else:
                self._command = command
            _check(status)
        command._seal(content, "it has been sent")

    def discard_command(self) -> None:
        """Discards the loaned command without sending it."""
        _check(_library.trb_discard_command(self._handle))
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
            pose.position_m[:], pose.orientation_xyzw[:] = position_m, orientation_xyzw
        address = None if pose is None else pose.array.ctypes.data
        _check(_library.trb_request_frame(self._handle, address, tick, _byref(number)))
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
        self._await(_library.trb_wait_frame, timeout_s, self._handle, request_id, _byref(view))
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

    def run_control(self, action: int, ticks: int = 0, timeout_s: float = 10.0) -> int:
        """Sends a run-control request (`CONTROL_PAUSE` …; `ticks` is for `CONTROL_STEP`) and returns the tick at which it
        took effect.

        Raises:
            TimeoutError: No reply arrived in time.
            Ended: The run is over.
            Error: The action was refused.
        """
        if action == 0:
            raise Error(g.ERROR_REFUSED, "run control knows no action 0; actions are 1 to 5")
        reply = g.RunControlReply()
        address = reply.array.ctypes.data
        for slice_s, last in _slices(timeout_s):
            status = _library.trb_control_run(self._handle, action, ticks, slice_s, address)
            # The request has been sent; from here on only wait for its reply.
            action = 0
            if status != g.TIMEOUT or last:
                break
        _check(status)
        return reply.tick

    @property
    def status(self) -> Optional[g.RunStatus]:
        """A copy of the run's newest status, if one has arrived."""
        status = g.RunStatus()
        code = _library.trb_get_status(self._handle, status.array.ctypes.data)
        if code == g.TIMEOUT:
            return None
        _check(code)
        return status

    def events(self) -> list[SessionEvent]:
        """Copies of all events since the last call; queued from the first call on, at most 256."""
        events: list[SessionEvent] = []
        view = g.trb_event_view()
        while True:
            status = _library.trb_next_event(self._handle, _byref(view))
            if status == g.TIMEOUT:
                return events
            _check(status)
            event = self._view(g.Event, view.event)
            text = view.text.decode()
            events.append(SessionEvent(event.tick, event.severity, event.code, event.sender, text))

    def remark(self, text: str, severity: int = g.SEVERITY_INFO) -> None:
        """Adds a line to the session's events, which the log records."""
        _check(_library.trb_remark(self._handle, severity, text.encode()))

    def next_removed(self) -> Optional[Removal]:
        """The oldest message about removed voxels not yet taken, if any; queued from the first call on, at most 512. Its
        memory is reused after the next one.
        """
        view = g.trb_removed_view()
        status = _library.trb_next_removed(self._handle, _byref(view))
        if status == g.TIMEOUT:
            return None
        _check(status)
        removed = self._view(g.Removed, view.removed)
        return Removal(removed, self._array(view.voxel_index, "<u4", removed.voxel_index_length))
