"""Linear models of a tick."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import numpy.typing as npt

from ._errors import ArgumentError

_Matrix = npt.NDArray[np.float64]
#: What the native half returns: tick, seconds of a tick, names and units of states, inputs and outputs, bytes
#: of A, B, C, D, state, next state, input and output, and notes.
Native = tuple[int, float, list[list[tuple[str, str]]], list[bytes], list[str]]


@dataclass(frozen=True)
class LinearModel:
    """One tick about a state x0 and commands u0:

        x[k+1] - next_state = A (x[k] - state) + B (u[k] - input)
        y[k] - output = C (x[k] - state) + D (u[k] - input)

    `control.ss(model.A, model.B, model.C, model.D, model.dt_s)` is the system of the python-control package.
    """

    #: Tick of the state.
    tick: int
    #: Simulated time of a tick.
    dt_s: float
    #: Shape (states, states).
    A: _Matrix
    #: Shape (states, inputs).
    B: _Matrix
    #: Shape (outputs, states).
    C: _Matrix
    #: Shape (outputs, inputs).
    D: _Matrix
    #: x0.
    state: _Matrix
    #: State after the tick with commands u0.
    next_state: _Matrix
    #: u0.
    input: _Matrix
    #: Outputs at x0 and u0.
    output: _Matrix
    #: Names of the states.
    state_names: list[str]
    #: Names of the inputs: fields of a command.
    input_names: list[str]
    #: Names of the outputs: fields of a state.
    output_names: list[str]
    #: Unit of each state, `1` for a plain number.
    state_units: list[str]
    #: Unit of each input.
    input_units: list[str]
    #: Unit of each output, empty for a plain number.
    output_units: list[str]
    #: Where a contact, a stop or a tendon differs within a difference; inputs without effect.
    notes: list[str]

    @staticmethod
    def of(given: Native) -> LinearModel:
        """Converts what the native half returns."""
        tick, dt_s, signals, numbers, notes = given
        states, inputs, outputs = signals
        n, m, p = len(states), len(inputs), len(outputs)
        shapes = ((n, n), (n, m), (p, n), (p, m), (n,), (n,), (m,), (p,))
        arrays = [np.frombuffer(data, "<f8").reshape(shape) for data, shape in zip(numbers, shapes)]
        names = [[name for name, _ in group] for group in signals]
        units = [[unit for _, unit in group] for group in signals]
        a, b, c, d, state, next_state, at_input, output = arrays
        return LinearModel(
            tick=tick,
            dt_s=dt_s,
            A=a,
            B=b,
            C=c,
            D=d,
            state=state,
            next_state=next_state,
            input=at_input,
            output=output,
            state_names=names[0],
            input_names=names[1],
            output_names=names[2],
            state_units=units[0],
            input_units=units[1],
            output_units=units[2],
            notes=notes,
        )

    def select(self, *patterns: str) -> LinearModel:
        """Returns the model of the states whose names match a pattern, such as `"flexure_*"`; the others keep
        their values.

        Raises:
            ArgumentError: A pattern matches no state.
        """
        kept: list[int] = []
        for pattern in patterns:
            found = [i for i, name in enumerate(self.state_names) if fnmatchcase(name, pattern)]
            if not found:
                raise ArgumentError(f"no state matches {pattern!r}; states: {', '.join(self.state_names)}")
            kept.extend(found)
        kept = sorted(set(kept))
        return replace(
            self,
            A=self.A[np.ix_(kept, kept)],
            B=self.B[kept],
            C=self.C[:, kept],
            state=self.state[kept],
            next_state=self.next_state[kept],
            state_names=[self.state_names[i] for i in kept],
            state_units=[self.state_units[i] for i in kept],
        )

    def __repr__(self) -> str:
        sizes = f"{len(self.state_names)} states, {len(self.input_names)} inputs"
        return f"LinearModel(tick={self.tick}, {sizes}, {len(self.output_names)} outputs)"


def signals(name: str, given: Any) -> list[str]:
    """Returns names of signals as a list."""
    names = [given] if isinstance(given, str) else list(given)
    if not all(isinstance(one, str) for one in names):
        raise ArgumentError(f"`{name}` is {given!r}, expected names of fields")
    return names
