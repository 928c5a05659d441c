"""Exceptions of the package."""

from __future__ import annotations


class Error(RuntimeError):
    """A failed call. The text states the given value, what is expected, and what to do."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        #: One of the `ERROR_` constants.
        self.status = status


class ArgumentError(Error, TypeError):
    """A value of the wrong type, shape or range for its field or argument."""

    def __init__(self, text: str) -> None:
        from ._generated import ERROR_ARGUMENT  # needs this module

        super().__init__(ERROR_ARGUMENT, text)


class ReadOnlyError(Error, ValueError):
    """An attempt to write to a message that is in read-only memory or has been sent."""

    def __init__(self, text: str) -> None:
        from ._generated import ERROR_ARGUMENT  # needs this module

        super().__init__(ERROR_ARGUMENT, text)


class Ended(Exception):
    """The run is over."""
