"""Views of messages in shared memory: their attributes read the bytes in place."""

from __future__ import annotations

import struct
from typing import Any, Optional, Type, TypeVar, Union

import numpy as np

_V = TypeVar("_V", bound="View")


class View:
    """A message in shared memory or in its own memory. Attributes read it in place; nothing is copied.

    Numbers are returned as Python numbers, fixed arrays as NumPy views of the same memory. Writing to a read-only message
    raises a ValueError.
    """

    __slots__ = ("_buffer", "_array", "_parts", "_sealed")

    dtype: np.dtype[np.void]
    _sealed: str

    def __init__(self, buffer: Union[memoryview, bytes, bytearray, None] = None, parts: Optional[dict] = None) -> None:
        """A view of `buffer`; without one, a zeroed message in its own memory. With `parts` it can be sealed."""
        self._buffer = bytearray(self.dtype.itemsize) if buffer is None else buffer
        self._array: Optional[np.ndarray] = None
        #: Writable views of this message that the caller has, by name; None if it is never sealed.
        self._parts = parts

    @property
    def array(self) -> np.ndarray:
        """The whole message in place, as a zero-dimensional NumPy array with a structured dtype."""
        if self._array is None:
            self._array = np.frombuffer(self._buffer, self.dtype, count=1).reshape(())
        return self._array

    def copy(self: _V) -> _V:
        """A writable copy in its own memory."""
        return type(self)(bytearray(self._buffer))

    def _seal(self, content: bytes, why: str) -> None:
        """Freezes the message with this content: neither it nor the views it has returned can be written any more."""
        parts = self._parts
        if parts is None:
            return
        self._buffer, self._parts, self._sealed = content, None, why
        if self._array is not None:
            self._array.setflags(write=False)
            self._array = None
        for part in parts.values():
            if type(part) is np.ndarray:
                part.setflags(write=False)
            else:
                part._seal(bytes(part._buffer), why)

    def _is_read_only(self) -> bool:
        return memoryview(self._buffer).readonly

    def _refusal(self, name: str) -> ValueError:
        why = getattr(self, "_sealed", "it lies in memory for reading; copy() gives one that can be written")
        return ValueError(f"`{name}` of this {type(self).__name__} cannot be written: {why}")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}={getattr(self, name)!r}' for name in self.dtype.names or ())})"


class _Member:
    """A field of a message, which knows its name."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __set__(self, view: View, value: Any) -> None:
        if view._is_read_only():
            raise view._refusal(self._name)
        self._write(view, value)

    def _write(self, view: View, value: Any) -> None:
        raise NotImplementedError


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
            if view._is_read_only():
                raise view._refusal(self._name) from None
            raise


class _Array(_Member):
    """A fixed array of a message."""

    def __init__(self, doc: str) -> None:
        self.__doc__ = doc

    def __set_name__(self, owner: Type[View], name: str) -> None:
        self._name = name
        fields = owner.dtype.fields
        assert fields is not None  # every message has fields
        element, self._offset = fields[name][:2]
        assert element.subdtype is not None  # of a fixed array
        self._element, self._shape = element.subdtype

    def __get__(self, view: Optional[View], owner: type) -> Any:
        if view is None:
            return self
        parts = view._parts
        if parts is None:
            return view.array[self._name]
        part = parts.get(self._name)
        if part is None:
            part = parts[self._name] = np.ndarray(self._shape, self._element, view._buffer, self._offset)
        return part

    def _write(self, view: View, value: Any) -> None:
        view.array[self._name][...] = value


class _Nested(_Member):
    """A message in a message."""

    def __init__(self, message: Type[View], offset: int, doc: str) -> None:
        self._message, self._offset, self._end = message, offset, offset + message.dtype.itemsize
        self.__doc__ = doc

    def __get__(self, view: Optional[View], owner: type) -> Any:
        if view is None:
            return self
        parts = view._parts
        if parts is None:
            return self._message(memoryview(view._buffer)[self._offset : self._end])
        part = parts.get(self._name)
        if part is None:
            part = parts[self._name] = self._message(memoryview(view._buffer)[self._offset : self._end], {})
        return part

    def _write(self, view: View, value: View) -> None:
        memoryview(view._buffer)[self._offset : self._end] = bytes(value._buffer)


def field(code: Optional[str], offset: int, doc: str) -> Any:
    """The attribute of a number (`code` as in `struct`) or of a fixed array."""
    return _Array(doc) if code is None else _Number(code, offset, doc)


def nested(message: Type[View], offset: int, doc: str) -> Any:
    """The attribute of a message in a message."""
    return _Nested(message, offset, doc)
