"""Messages where they lie in shared memory: attributes that read bytes in place."""

from __future__ import annotations

import struct
from typing import Any, Optional, TypeVar

import numpy as np

_V = TypeVar("_V", bound="View")


class View:
    """A message in shared memory, or in memory of its own. Attributes read it in place; nothing is copied.

    Numbers come as Python numbers, fixed arrays as NumPy views of the same memory.
    """

    __slots__ = ("_buffer", "_array")

    dtype: np.dtype

    def __init__(self, buffer: Optional[memoryview] = None) -> None:
        """A view of `buffer`; without one, a message of zeros in memory of its own."""
        self._buffer = memoryview(bytearray(self.dtype.itemsize)) if buffer is None else buffer
        self._array: Optional[np.ndarray] = None

    @property
    def array(self) -> np.ndarray:
        """The whole message as a NumPy array of no dimension with a structured dtype, in place."""
        if self._array is None:
            self._array = np.frombuffer(self._buffer, self.dtype, count=1).reshape(())
        return self._array

    def copy(self: _V) -> _V:
        """The same in memory of its own, which stays after the connection is closed."""
        return type(self)(memoryview(bytearray(self._buffer)))

    def _release(self) -> None:
        self._array = None
        self._buffer = memoryview(b"")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}={getattr(self, name)!r}' for name in self.dtype.names)})"


class _Number:
    """A number of a message."""

    def __init__(self, code: str, offset: int, doc: str) -> None:
        packer = struct.Struct(code)
        self._unpack, self._pack, self._offset = packer.unpack_from, packer.pack_into, offset
        self.__doc__ = doc

    def __get__(self, view: Optional[View], owner: type) -> Any:
        return self if view is None else self._unpack(view._buffer, self._offset)[0]

    def __set__(self, view: View, value: Any) -> None:
        self._pack(view._buffer, self._offset, value)


class _Array:
    """A fixed array of a message."""

    def __init__(self, name: str, doc: str) -> None:
        self._name = name
        self.__doc__ = doc

    def __get__(self, view: Optional[View], owner: type) -> Any:
        return self if view is None else view.array[self._name]

    def __set__(self, view: View, value: Any) -> None:
        view.array[self._name][...] = value


class _Nested:
    """A message in a message."""

    def __init__(self, message: type, offset: int, doc: str) -> None:
        self._message, self._offset, self._end = message, offset, offset + message.dtype.itemsize
        self.__doc__ = doc

    def __get__(self, view: Optional[View], owner: type) -> Any:
        return self if view is None else self._message(view._buffer[self._offset : self._end])

    def __set__(self, view: View, value: View) -> None:
        view._buffer[self._offset : self._end] = bytes(value._buffer)


def field(name: str, code: Optional[str], offset: int, doc: str) -> Any:
    """The attribute of a number (`code` as in `struct`) or of a fixed array."""
    return _Array(name, doc) if code is None else _Number(code, offset, doc)


def nested(message: type, offset: int, doc: str) -> Any:
    """The attribute of a message in a message."""
    return _Nested(message, offset, doc)
