"""Views of messages in shared memory, whose attributes read the bytes in place."""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import (
    TYPE_CHECKING,
    Any,
    Callable,
    Generic,
    Iterator,
    Mapping,
    Optional,
    Sequence,
    Type,
    TypeVar,
    Union,
    cast,
    overload,
)

import numpy as np
import numpy.typing as npt

from ._errors import ArgumentError, ReadOnlyError

_V = TypeVar("_V", bound="View")
_S = TypeVar("_S", bound=np.generic)

Buffer = Union[memoryview, bytes, bytearray]
#: Length of a message's `repr` after which the remaining fields are omitted.
_SHOWN = 150
_FOR_READING = "it is in read-only memory; copy() returns a writable one"
#: Ranges of the `struct` codes.
_WHOLE = {"B": (0, 2**8), "H": (0, 2**16), "I": (0, 2**32), "Q": (0, 2**64)}
_WHOLE.update({"b": (-(2**7), 2**7), "h": (-(2**15), 2**15), "i": (-(2**31), 2**31), "q": (-(2**63), 2**63)})


class View:
    """A message, in shared memory or its own. Attributes read it in place; nothing is copied.

    Numbers are returned as Python numbers, codes as enum members, and fixed arrays as NumPy views of the same
    memory, limited to the used part. Writing to a read-only message raises a ReadOnlyError; a value that a
    field cannot hold raises an ArgumentError.
    """

    __slots__ = ("_buffer", "_array", "_parts", "_sealed")

    dtype: np.dtype[np.void]
    _sealed: str

    def __init__(self, buffer: Optional[Buffer] = None, parts: Optional[dict[str, Any]] = None) -> None:
        """Creates a view of `buffer`, or a zeroed message in its own memory if None. With `parts` it can be
        sealed.
        """
        self._buffer: Buffer = bytearray(self.dtype.itemsize) if buffer is None else buffer
        self._array: Optional[npt.NDArray[np.void]] = None
        #: Writable views of this message held by the caller, by name; None if it is never sealed.
        self._parts = parts

    @property
    def array(self) -> npt.NDArray[np.void]:
        """The whole message in place, as a zero-dimensional NumPy array with a structured dtype; arrays at
        full length.
        """
        if self._array is None:
            self._array = np.frombuffer(self._buffer, self.dtype, count=1).reshape(())
        return self._array

    def copy(self: _V) -> _V:
        """Returns a writable copy in its own memory."""
        return type(self)(bytearray(self._buffer))

    def _seal(self, content: bytes, why: str) -> None:
        """Freezes the message with this content: neither it nor the views it has returned can be written any
        longer.
        """
        parts = self._parts
        if parts is None:
            return
        self._buffer, self._parts, self._sealed = content, None, why
        if self._array is not None:
            self._array.setflags(write=False)
            self._array = None
        for part in parts.values():
            if isinstance(part, np.ndarray):
                part.setflags(write=False)
            else:
                part._seal(bytes(part._buffer), why)

    def _is_read_only(self) -> bool:
        return memoryview(self._buffer).readonly

    def _refusal(self, name: str) -> ReadOnlyError:
        why = getattr(self, "_sealed", _FOR_READING)
        return ReadOnlyError(f"`{name}` of this {type(self).__name__} cannot be written: {why}")

    def __repr__(self) -> str:
        """Returns the first fields in one line."""
        shown: list[str] = []
        for name in self.dtype.names or ():
            if sum(map(len, shown)) > _SHOWN:
                shown.append("…")
                break
            if not name.startswith("reserved"):
                shown.append(f"{name}={_short(getattr(self, name))}")
        return f"{type(self).__name__}({', '.join(shown)})"


def _short(value: Any) -> str:
    if isinstance(value, IntEnum):
        return value.name
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, np.ndarray):
        return f"[{', '.join(f'{x:.6g}' for x in value)}]" if len(value) <= 4 else f"[{len(value)} numbers]"
    if isinstance(value, Elements):
        return f"[{len(value)} messages]"
    return repr(value)


class Values(np.ndarray[Any, Any]):
    """Numbers of a message in place. Results of computations are ordinary arrays."""

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        return array[()] if return_scalar or np.ndim(array) == 0 else np.asarray(array)

    def __setitem__(self, key: Any, value: Any) -> None:
        try:
            super().__setitem__(key, value)
        except (TypeError, ValueError) as cause:
            if not self.flags.writeable:
                raise ReadOnlyError(f"these numbers cannot be written: {_FOR_READING}") from None
            text = f"{value!r} does not fit in {self.size} numbers ({self.dtype}): {cause}"
            raise ArgumentError(text) from None

    def __repr__(self) -> str:
        return repr(np.asarray(self))


class Elements(Sequence[_V]):
    """The messages of an array, in place: `state.contacts[0].gap_m`. Use `array` for columns over all of
    them.
    """

    __slots__ = ("_message", "_buffer", "_offset", "_count")

    def __init__(self, message: Type[_V], buffer: Buffer, offset: int, count: int) -> None:
        self._message, self._buffer, self._offset, self._count = message, buffer, offset, count

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> _V: ...
    @overload
    def __getitem__(self, index: slice) -> list[_V]: ...
    def __getitem__(self, index: Union[int, slice]) -> Union[_V, list[_V]]:
        if isinstance(index, slice):
            return [self._at(i) for i in range(*index.indices(self._count))]
        if isinstance(index, str):
            raise ArgumentError(f"elements are indexed by number; use `.array[{index!r}]` for the column")
        at = index + self._count if index < 0 else index
        if not 0 <= at < self._count:
            raise IndexError(f"element {index} of {self._count}")
        return self._at(at)

    def __iter__(self) -> Iterator[_V]:
        return (self._at(index) for index in range(self._count))

    def _at(self, index: int) -> _V:
        size = self._message.dtype.itemsize
        begin = self._offset + index * size
        return self._message(memoryview(self._buffer)[begin : begin + size])

    @property
    def array(self) -> npt.NDArray[np.void]:
        """All elements as one array with a structured dtype: `state.contacts.array["gap_m"]`."""
        return np.ndarray((self._count,), self._message.dtype, self._buffer, self._offset)

    def __repr__(self) -> str:
        return f"[{', '.join(repr(element) for element in self[:3])}{', …' if self._count > 3 else ''}]"


class _Member:
    """A field of a message that stores its name."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def _refuse_if_read_only(self, view: View) -> None:
        if view._is_read_only():
            raise view._refusal(self._name)

    def _of(self, view: View) -> str:
        return f"`{self._name}` of this {type(view).__name__}"


class _Number(_Member):
    """A number field, or an enum code."""

    def __init__(self, code: str, offset: int, doc: str, codes: Optional[Type[IntEnum]] = None) -> None:
        packer = struct.Struct(code)
        self._code, self._offset = code, offset
        self._unpack, self._pack = packer.unpack_from, packer.pack_into
        #: An unknown code stays a number.
        self._members = None if codes is None else {member.value: member for member in codes}
        self._codes = codes
        self.__doc__ = doc

    def __get__(self, view: Optional[View], owner: type) -> Any:
        if view is None:
            return self
        value = self._unpack(view._buffer, self._offset)[0]
        return value if self._members is None else self._members.get(value, value)

    def __set__(self, view: View, value: Any) -> None:
        try:
            self._pack(view._buffer, self._offset, value)
        except (TypeError, struct.error):
            self._refuse_if_read_only(view)
            raise ArgumentError(f"{self._of(view)} is {value!r}, expected {self._expected()}") from None

    def _expected(self) -> str:
        if self._codes is not None:
            return f"a {self._codes.__name__}: {', '.join(member.name for member in self._codes)}"
        if self._code[-1] in "fd":
            return "a number"
        least, beyond = _WHOLE[self._code[-1]]
        return f"a whole number, {least} to {beyond - 1}"


def _fields(owner: Type[View]) -> Mapping[str, Any]:
    """Returns type and offset of each field."""
    return cast(Mapping[str, Any], owner.dtype.fields)


def _counter(owner: Type[View], name: Optional[str], most: int) -> Callable[[Buffer], int]:
    """Returns a function of a message's bytes: the used length of an array of `most` entries, from the field
    of this name.
    """
    if name is None:
        return lambda buffer: most
    unpack, offset = struct.Struct("<I").unpack_from, _fields(owner)[name][1]
    return lambda buffer: min(unpack(buffer, offset)[0], most)


def _array_of(owner: Type[View], name: str) -> tuple[np.dtype[Any], int, int]:
    """Returns element type, length and offset of an array."""
    whole, offset = _fields(owner)[name][:2]
    element, (length,) = whole.subdtype
    return element, length, offset


class ArrayField(_Member, Generic[_S]):
    """Attribute for a fixed array of numbers. `count` names the field with the used length. With `fewer_fit`,
    fewer numbers can be set than a tool or arm can have; the remaining ones become 0.
    """

    def __init__(
        self, element: Type[_S], doc: str, count: Optional[str] = None, fewer_fit: bool = False
    ) -> None:
        self._count = count
        self._fewer_fit = fewer_fit
        self.__doc__ = doc

    def __set_name__(self, owner: Type[View], name: str) -> None:
        super().__set_name__(owner, name)
        self._element, self._length, self._offset = _array_of(owner, name)
        self._used = _counter(owner, self._count, self._length)

    @overload
    def __get__(self, view: None, owner: type) -> ArrayField[_S]: ...
    @overload
    def __get__(self, view: View, owner: type) -> npt.NDArray[_S]: ...
    def __get__(self, view: Optional[View], owner: type) -> Union[ArrayField[_S], npt.NDArray[_S]]:
        if view is None:
            return self
        parts, buffer = view._parts, view._buffer
        if parts is None:
            return Values((self._used(buffer),), self._element, buffer, self._offset)
        part: Optional[Values] = parts.get(self._name)
        if part is None:
            part = parts[self._name] = Values((self._used(buffer),), self._element, buffer, self._offset)
        return part

    def __set__(self, view: View, value: Union[Sequence[float], npt.NDArray[Any]]) -> None:
        self._refuse_if_read_only(view)
        own = self.__get__(view, type(view))
        try:
            given = np.asarray(value, self._element)
        except (TypeError, ValueError, OverflowError):
            given = np.empty(0, self._element)
        count = own.shape[0]
        fits = given.shape == own.shape or (self._fewer_fit and given.ndim == 1 and 0 < len(given) < count)
        if not fits:
            fewer = " or fewer" if self._fewer_fit else ""
            text = (
                f"{self._of(view)} is {value!r}, expected {count} numbers{fewer}; "
                f"set a single one with `{self._name}[0] = …`"
            )
            raise ArgumentError(text)
        own[: len(given)] = given
        own[len(given) :] = 0


class ElementsField(_Member, Generic[_V]):
    """Attribute for a fixed array of messages. `count` names the field with the used length."""

    def __init__(self, message: Type[_V], doc: str, count: Optional[str] = None) -> None:
        self._message, self._count = message, count
        self.__doc__ = doc

    def __set_name__(self, owner: Type[View], name: str) -> None:
        super().__set_name__(owner, name)
        _, length, self._offset = _array_of(owner, name)
        self._used = _counter(owner, self._count, length)

    @overload
    def __get__(self, view: None, owner: type) -> ElementsField[_V]: ...
    @overload
    def __get__(self, view: View, owner: type) -> Elements[_V]: ...
    def __get__(self, view: Optional[View], owner: type) -> Union[ElementsField[_V], Elements[_V]]:
        if view is None:
            return self
        return Elements(self._message, view._buffer, self._offset, self._used(view._buffer))

    if not TYPE_CHECKING:

        def __set__(self, view: View, value: Any) -> None:
            self._refuse_if_read_only(view)
            raise ArgumentError(f"{self._of(view)} is an array of messages; set the fields of its elements")


class _Nested(_Member):
    """A nested message."""

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

    def __set__(self, view: View, value: Any) -> None:
        self._refuse_if_read_only(view)
        if not isinstance(value, self._message):
            raise ArgumentError(f"{self._of(view)} is {value!r}, expected a {self._message.__name__}")
        memoryview(view._buffer)[self._offset : self._end] = bytes(value._buffer)


def field(code: str, offset: int, doc: str, codes: Optional[Type[IntEnum]] = None) -> Any:
    """Creates the attribute for a number (`code` as in `struct`) or an enum code."""
    return _Number(code, offset, doc, codes)


def nested(message: Type[View], offset: int, doc: str) -> Any:
    """Creates the attribute for a nested message."""
    return _Nested(message, offset, doc)
