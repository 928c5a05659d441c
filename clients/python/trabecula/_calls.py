"""Calls to the library: errors, waits, arguments and mapped memory."""

from __future__ import annotations

import ctypes
import time
from typing import Callable, Iterator, Optional

import numpy as np

from . import _generated as g
from ._errors import ArgumentError, Ended, Error
from ._library import load

library = load()
byref = ctypes.byref
#: Longest uninterrupted wait inside the library, so that Ctrl-C gets through.
_SLICE_S = 0.1


def check(status: int) -> None:
    if status == g.OK:
        return
    if status == g.TIMEOUT:
        raise TimeoutError("timed out")
    if status == g.ENDED:
        raise Ended(library.trb_last_error().decode())
    raise Error(status, library.trb_last_error().decode())


def slices(timeout_s: float) -> Iterator[tuple[float, bool]]:
    """Splits a wait into short waits inside the library; yields each length and whether it is the last."""
    if not isinstance(timeout_s, (int, float)) or not timeout_s >= 0.0:
        raise ArgumentError(f"`timeout_s` is {timeout_s!r}, expected 0 or more seconds")
    deadline = time.monotonic() + timeout_s
    last = False
    while not last:
        left_s = deadline - time.monotonic()
        last = left_s <= _SLICE_S
        yield max(0.0, min(_SLICE_S, left_s)), last


def text_of(name: str, text: Optional[str]) -> Optional[bytes]:
    if text is not None and not isinstance(text, str):
        raise ArgumentError(f"`{name}` is {text!r}, expected a text or None")
    return None if text is None else text.encode()


def whole(name: str, value: int) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 0 <= value < 2**64:
        raise ArgumentError(f"`{name}` is {value!r}, expected a whole number, 0 or more")
    return int(value)


def connected(session: Optional[str], controller: Optional[str], timeout_s: float) -> int:
    """Connects a client and returns its handle."""
    handle = ctypes.c_uint64()
    layouts = g.LAYOUTS.encode()
    status = g.ERROR_NO_SESSION
    for slice_s, last in slices(timeout_s):
        given = (layouts, text_of("session", session), text_of("controller", controller), slice_s)
        status = library.trb_connect(*given, byref(handle))
        if status != g.ERROR_NO_SESSION or last:
            break
    check(status)
    return handle.value


class Memory:
    """Keeps the client's shared memory mapped while this object lives, in any thread, even after the client
    is closed.
    """

    def __init__(self, handle: int) -> None:
        self._handle = 0
        check(library.trb_hold_memory(handle))
        self._handle = handle

    def __del__(self, release: Callable[[int], int] = library.trb_release_memory) -> None:
        if self._handle:
            release(self._handle)
