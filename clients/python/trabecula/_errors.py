"""What the package raises."""

from __future__ import annotations


class Error(RuntimeError):
    """A failed call. The text says what was given, what was expected and what to do."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        #: One of the `ERROR_` constants.
        self.status = status


class ArgumentError(Error, TypeError):
    """A value of a type, shape or range that its field or argument cannot hold."""

    def __init__(self, text: str) -> None:
        from ._generated import ERROR_ARGUMENT  # needs this module

        super().__init__(ERROR_ARGUMENT, text)


class ReadOnlyError(Error, ValueError):
    """A message that lies in memory for reading, or that has been sent, was to be written."""

    def __init__(self, text: str) -> None:
        from ._generated import ERROR_ARGUMENT  # needs this module

        super().__init__(ERROR_ARGUMENT, text)


class Ended(Exception):
    """The run is over."""
