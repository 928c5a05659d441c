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
from ._results import Ct, Image, Info, Jacobian, Reading, Removal, SessionEvent, as_array
from ._view import Values, View

_byref = ctypes.byref
#: Maximum number of events kept for `events`: the length of the library's queue.
_MOST_UNREAD = 256

_V = TypeVar("_V", bound=View)


class Client:
    """A connection to a session: as a controller, or as an observer.

    A client belongs to the thread and process that created it. In a `fork` child every call fails, and the
    child's exit does not disconnect the client (start processes with `spawn`, or connect in the child).
    Returned messages and arrays are read-only views of shared memory. Each method documents how long its view
    stays unchanged; use `copy()` to keep the data. A view stays readable for as long as it is referenced, in
    any thread, even after the client is closed. A client can be used as a context manager.

    Args:
        session: Folder or name of the session. None: the folder in the environment variable
            `TRABECULA_SESSION`, or else this user's only session; if several are running, name one.
        controller: Name of the controller in the scene; "" joins as an observer, which sends no commands.
            None: the name in `TRABECULA_CONTROLLER`, or else the scene's only external controller.
        timeout_s: Time to wait for the session.

    Raises:
        Error: No session; several sessions and none named (raised at once, with a list); another version; an
            unknown controller; or one that is already connected.
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
        #: Events read while looking for resets, and the number of resets.
        self._unread: deque[SessionEvent] = deque(maxlen=_MOST_UNREAD)
        self._resets = 0
        #: Tick of the newest state taken.
        self._tick: Optional[int] = None
        self._answered = False
        #: The library's command buffer, and the command filled in by the caller.
        self._sending: Optional[memoryview] = None
        self._command: Optional[g.Command] = None

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leaves the session. Views obtained from it stay readable for as long as they are referenced.

        Raises:
            Error: The client belongs to another thread, which is still running.
        """
        if self._number:
            status = _library.trb_disconnect(self._number)
            # A thread's clients are closed when it ends; a parent's client stays connected.
            if status != g.ERROR_FORKED and self._is_of_a_running_thread():
                check(status)
        self._number, self._memory, self._views, self._sending = 0, None, {}, None
        self._end_command("its client has been closed")

    def __del__(self, disconnect: Callable[[int], int] = _library.trb_disconnect) -> None:
        if self._number:
            # Fails in a thread other than the client's own, whose end disconnects it.
            disconnect(self._number)

    #: The library's handle of this client; 0 before connecting and after closing.
    _number = 0

    @property
    def _handle(self) -> int:
        if self._number == 0:
            raise Error(g.ERROR_HANDLE, "this client is closed; create another one")
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
        # None raises a TypeError.
        memory = (ctypes.c_ubyte * size).from_address(address)  # type: ignore[arg-type]
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
        if not count:
            return np.empty(0, dtype)
        return as_array(self._bytes(address, size).toreadonly(), dtype, count).view(Values)

    def _await(self, function: Callable[..., int], timeout_s: float, *arguments: object) -> None:
        """Calls a blocking library function in slices, so that Ctrl-C gets through."""
        for slice_s, last in slices(timeout_s):
            status = function(*arguments[:-1], slice_s, arguments[-1])
            if status == g.OK:
                return
            if status != g.TIMEOUT or last:
                check(status)

    @property
    def info(self) -> Info:
        """Constant properties of the session."""
        info = g.trb_session_info()
        check(_library.trb_get_info(self._handle, _byref(info)))
        values = {name: getattr(info, name) for name, *_ in info._fields_}
        for name in ("folder", "controller", "scene_toml"):
            values[name] = values[name].decode()
        values.update(lockstep=bool(info.lockstep), has_volume=bool(info.has_volume))
        return Info(**values)

    def wait_state(self, timeout_s: float = 30.0) -> g.State:
        """Waits for the newest state: yields the core for 20 µs, then sleeps until woken. The state stays
        unchanged until the next one is taken.

        Raises:
            TimeoutError: No state arrived in time.
            Ended: The run is over.
        """
        self._await(_library.trb_wait_state, timeout_s, self._handle, self._state_reference)
        return self._state_taken()

    def next_state(self, timeout_s: float = 30.0) -> g.State:
        """Waits for the oldest state not yet taken, for programs that need every state. The queue holds 512
        states.
        """
        self._await(_library.trb_next_state, timeout_s, self._handle, self._state_reference)
        return self._state_taken()

    def poll_state(self) -> Optional[g.State]:
        """Returns the newest state if one has arrived since the last call, else None. Does not wait.

        Raises:
            Ended: The run is over.
        """
        status = _library.trb_poll_state(self._handle, self._state_reference)
        if status == g.TIMEOUT:
            return None
        check(status)
        return self._state_taken()

    def states(self, timeout_s: float = math.inf) -> Iterator[g.State]:
        """Yields the newest state repeatedly until the run is over. While the run is paused, it waits.

        Raises:
            TimeoutError: No state arrived within `timeout_s`.
        """
        while True:
            try:
                state = self.wait_state(timeout_s)
            except Ended:
                return
            yield state

    def step(self, ticks: int = 1, timeout_s: float = 30.0) -> g.State:
        """Takes part in the next `ticks` ticks and returns the state after them.

        A controller answers each state with the loaned command, if there is one, or else with a command
        without requests, so earlier requests stay in effect. An observer only waits. A paused run executes
        these ticks and is paused again.

        Raises:
            TimeoutError: A tick did not arrive in time, for example because another controller does not
                answer.
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
            # Another command for the same state would replace the first one.
            if is_controller and not self._answered:
                self.loan_command()
                self.send_command()
            for slice_s, last in slices(timeout_s):
                try:
                    state = self.next_state(slice_s)
                except TimeoutError:
                    if last:
                        raise
                    # The status `PAUSED` may arrive after the reply to the pause request.
                    asked = asked or self._step_if_paused(end - (self._tick or 0), timeout_s)
                    continue
                if state.tick >= end:
                    return state
                break

    def _step_if_paused(self, ticks: int, timeout_s: float) -> bool:
        """Requests ticks from a paused run; returns whether they were requested."""
        status = self.status
        if status is None or status.phase != g.Phase.PAUSED:
            return False
        try:
            self.run_control(g.ControlAction.STEP, ticks, timeout_s)
        except Error as error:
            # The run was resumed in the meantime.
            if error.status != g.ERROR_REFUSED:
                raise
        return True

    @property
    def states_missed(self) -> int:
        """Number of states skipped or overwritten before this client took them."""
        count = ctypes.c_uint64()
        check(_library.trb_states_missed(self._handle, _byref(count)))
        return count.value

    def loan_command(self) -> g.Command:
        """Returns the command that `send_command` will send: every mode is "none", `sequence` and
        `state_tick` are filled in. It can be written until it is sent; it has its own memory, so later
        changes have no effect.
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
        """Sends the loaned command; writing to it afterwards raises a ReadOnlyError.

        The physics checks the command: a refused command changes nothing. If the tool cannot follow a part of
        an accepted command (an unreachable goal), that part changes nothing and the other parts take effect.
        Both cases are counted and reported as events.
        """
        # Cleared first: a signal handler may begin another command.
        command, self._command = self._command, None
        if command is None:
            check(_library.trb_send_command(self._handle))
            self._answered = True
            return
        content = bytes(command._buffer)
        self._sending[:] = content  # type: ignore[index]  # set by the loan
        status = _library.trb_send_command(self._handle)
        if status:
            if status == g.ERROR_ARGUMENT:
                command._seal(content, "a signal handler has sent or discarded it")
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
        """Returns the command that answers the last state taken. It is sent at the end of the `with` block;
        an exception discards it.
        """
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
        """Requests an X-ray frame and returns the request's id.

        Args:
            tick: Tick whose state the frame shows; if it has passed, the newest one.
            position_m: Isocentre of the C-arm in the world frame; None uses the scene's C-arm unchanged.
            orientation_xyzw: Orientation of the C-arm in the world frame: +x along the image rows to the
                right, +y along the columns down, +z to the source.
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
        """Waits for the frame of a request, or for the next frame of any kind if `request_id` is 0.

        The frame's memory is reused after the next frame. Frames are queued from the first call of this
        method or `request_frame` on, at most 64.

        Raises:
            TimeoutError: No frame arrived in time.
            Ended: The run is over, and no frame is being rendered.
            Error: The request was refused, or the scene has no X-ray.
        """
        view = g.trb_frame_view()
        number = whole("request_id", request_id)
        self._await(_library.trb_wait_frame, timeout_s, self._handle, number, _byref(view))
        frame = self._view(g.Frame, view.frame)
        geometry = frame.geometry
        pixels = self._array(view.pixels, "<u2", view.pixel_count)
        return Image(frame, pixels.reshape(geometry.rows, geometry.columns))

    def volume(self, timeout_s: float = 30.0) -> Ct:
        """Returns the CT volume at the start of the run, in place; it never changes."""
        view = g.trb_volume_view()
        self._await(_library.trb_get_volume, timeout_s, self._handle, _byref(view))
        volume = self._view(g.Volume, view.volume)
        hu = self._array(view.hu, "<i2", view.voxel_count)
        return Ct(volume, hu.reshape(volume.dimensions[::-1]))

    def run_control(
        self, action: Union[g.ControlAction, int], ticks: int = 0, timeout_s: float = 10.0
    ) -> int:
        """Sends a run-control request (`ControlAction.PAUSE` etc.; `ticks` applies to `ControlAction.STEP`)
        and returns the tick at which it took effect.

        Raises:
            TimeoutError: No reply arrived in time.
            Ended: The run is over.
            Error: The action was refused.
        """
        if isinstance(action, bool) or not isinstance(action, int) or not 0 <= action < 2**32:
            known = ", ".join(f"{known.value} {known.name}" for known in g.ControlAction)
            raise ArgumentError(f"`action` is {action!r}, expected a ControlAction: {known}")
        if action == 0:
            raise Error(g.ERROR_REFUSED, "unknown run-control action 0; actions are 1 to 6")
        ticks = whole("ticks", ticks)
        reply = g.RunControlReply()
        address, status = reply.array.ctypes.data, g.TIMEOUT
        for slice_s, last in slices(timeout_s):
            status = _library.trb_control_run(self._handle, action, ticks, slice_s, address)
            # The request has been sent; from here on only its reply is awaited.
            action = 0
            if status != g.TIMEOUT or last:
                break
        check(status)
        return reply.tick

    @property
    def status(self) -> Optional[g.RunStatus]:
        """A copy of the run's newest status, or None if none has arrived."""
        status = g.RunStatus()
        code = _library.trb_get_status(self._handle, status.array.ctypes.data)
        if code == g.TIMEOUT:
            return None
        check(code)
        return status

    def events(self) -> list[SessionEvent]:
        """Returns copies of all events since the last call; queued from the first call of this method or
        `reset_count` on, at most 256.
        """
        self._read_events()
        events = list(self._unread)
        self._unread.clear()
        return events

    @property
    def reset_count(self) -> int:
        """Number of resets since this client first read this property or `events`. Ticks and simulated time
        continue after a reset; tool, bone and energies return to their initial state.
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
        """Adds a text to the session's events, which are recorded in the log."""
        if not isinstance(text, str):
            raise ArgumentError(f"`text` is {text!r}, expected a text")
        check(_library.trb_remark(self._handle, severity, text.encode()))

    def readings(self) -> list[Reading]:
        """Returns copies of the sensor readings since the last call; queued from the connection on, at most
        1024. Readings that arrive with a state are available when the state is.
        """
        readings: list[Reading] = []
        address = ctypes.c_void_p()
        while True:
            status = _library.trb_next_reading(self._handle, _byref(address))
            if status == g.TIMEOUT:
                return readings
            check(status)
            readings.append(Reading.of(self._view(g.SensorReading, address.value)))

    def tip_jacobian(self) -> Optional[Jacobian]:
        """Returns a copy of the newest Jacobian of the tip, or None if the scene does not set
        `manipulator.tip_jacobian`. That of a state is available when the state is.
        """
        address = ctypes.c_void_p()
        status = _library.trb_newest_tip_jacobian(self._handle, _byref(address))
        if status == g.TIMEOUT:
            return None
        check(status)
        return Jacobian.of(self._view(g.TipJacobian, address.value))

    def next_removed(self) -> Optional[Removal]:
        """Returns the oldest message about removed voxels not yet taken, or None; queued from the first call
        on, at most 512. Its memory is reused after the next one.
        """
        view = g.trb_removed_view()
        status = _library.trb_next_removed(self._handle, _byref(view))
        if status == g.TIMEOUT:
            return None
        check(status)
        removed = self._view(g.Removed, view.removed)
        return Removal(removed, self._array(view.voxel_index, "<u4", removed.voxel_index_length))
