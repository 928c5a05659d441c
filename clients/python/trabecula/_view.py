"""Messages where they lie in shared memory: attributes that read bytes in place."""

from __future__ import annotations

import struct
from typing import Any, Optional, TypeVar

import numpy as np

_V = TypeVar("_V", bound="View")


class View:
    """A message in shared memory, or in memory of its own. Attributes read it in place; nothing is copied.

    Numbers come as Python numbers, fixed arrays as NumPy views of the same memory. To write one that is read-only raises a
    ValueError.
    """

    __slots__ = ("_buffer", "_array", "_parts", "_why")

    dtype: np.dtype

    def __init__(self, buffer: Optional[memoryview] = None, parts: Optional[dict] = None) -> None:
        """A view of `buffer`; without one, a message of zeros in memory of its own. With `parts` it can be sealed."""
        self._buffer = memoryview(bytearray(self.dtype.itemsize)) if buffer is None else buffer
        self._array: Optional[np.ndarray] = None
        #: What has been handed out that writes into this message, by name; None where nobody seals it.
        self._parts = parts
        self._why = "it lies in shared memory for reading; copy() gives one that can be written"

    @property
    def array(self) -> np.ndarray:
        """The whole message as a NumPy array of no dimension with a structured dtype, in place."""
        if self._array is None:
            self._array = np.frombuffer(self._buffer, self.dtype, count=1).reshape(())
        return self._array

    def copy(self: _V) -> _V:
        """The same in memory of its own, which may be written."""
        return type(self)(memoryview(bytearray(self._buffer)))

    def _seal(self, why: str) -> None:
        """From now on it shows what it is now, and cannot be written: neither it nor what it has handed out."""
        self._buffer, self._why = memoryview(bytes(self._buffer)), why
        if self._array is not None:
            self._array.setflags(write=False)
            self._array = None
        parts, self._parts = self._parts or {}, None
        for part in parts.values():
            if isinstance(part, View):
                part._seal(why)
            else:
                part.setflags(write=False)

    def _part(self, name: str, made: Any) -> Any:
        """What has been handed out by this name, or is made now."""
        if self._parts is None:
            return made()
        part = self._parts.get(name)
        if part is None:
            part = self._parts[name] = made()
        return part

    def _refusal(self, name: str) -> ValueError:
        return ValueError(f"`{name}` of this {type(self).__name__} cannot be written: {self._why}")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}={getattr(self, name)!r}' for name in self.dtype.names)})"


class _Member:
    """A field of a message, which knows its name."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __set__(self, view: View, value: Any) -> None:
        if view._buffer.readonly:
            raise view._refusal(self._name)
        self._write(view, value)


class _Number(_Member):
    """A number of a message."""

    def __init__(self, code: str, offset: int, doc: str) -> None:
        packer = struct.Struct(code)
        self._unpack, self._pack, self._offset = packer.unpack_from, packer.pack_into, offset
        self.__doc__ = doc

    def __get__(self, view: Optional[View], owner: type) -> Any:
        return self if view is None else self._unpack(view._buffer, self._offset)[0]

    def __set__(self, view: View, value: Any) -> None:
        try:
            self._pack(view._buffer, self._offset, value)
        except TypeError:
            if view._buffer.readonly:
                raise view._refusal(self._name) from None
            raise


class _Array(_Member):
    """A fixed array of a message."""

    def __init__(self, doc: str) -> None:
        self.__doc__ = doc

    def __get__(self, view: Optional[View], owner: type) -> Any:
        if view is None:
            return self
        return view.array[self._name] if view._parts is None else view._part(self._name, lambda: view.array[self._name])

    def _write(self, view: View, value: Any) -> None:
        view.array[self._name][...] = value


class _Nested(_Member):
    """A message in a message."""

    def __init__(self, message: type, offset: int, doc: str) -> None:
        self._message, self._offset, self._end = message, offset, offset + message.dtype.itemsize
        self.__doc__ = doc

    def __get__(self, view: Optional[View], owner: type) -> Any:
        if view is None:
            return self
        buffer = view._buffer[self._offset : self._end]
        if view._parts is None:
            part = self._message(buffer)
            part._why = view._why
            return part
        return view._part(self._name, lambda: self._message(buffer, {}))

    def _write(self, view: View, value: View) -> None:
        view._buffer[self._offset : self._end] = bytes(value._buffer)


def field(code: Optional[str], offset: int, doc: str) -> Any:
    """The attribute of a number (`code` as in `struct`) or of a fixed array."""
    return _Array(doc) if code is None else _Number(code, offset, doc)


def nested(message: type, offset: int, doc: str) -> Any:
    """The attribute of a message in a message."""
    return _Nested(message, offset, doc)
