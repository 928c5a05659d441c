"""A controller as an FMU, built by PythonFMU3: `pythonfmu3 build -f pi.py`."""

from pythonfmu3 import Float64, Fmi3Causality, Fmi3Slave, Fmi3Variability


class Pi(Fmi3Slave):  # type: ignore[misc]
    """Proportional-integral control of the bend by the tension."""

    def __init__(self, **kwargs: object) -> None:
        super().__init__(**kwargs)
        self.time = 0.0
        self.goal = 0.3
        self.gain = 4.0
        self.y = 0.0
        self.u = 0.0
        self.sum = 0.0
        parameter, tunable = Fmi3Causality.parameter, Fmi3Variability.tunable
        self.register_variable(
            Float64("time", causality=Fmi3Causality.independent, variability=Fmi3Variability.continuous)
        )
        self.register_variable(Float64("goal", causality=parameter, variability=tunable))
        self.register_variable(Float64("gain", causality=parameter, variability=tunable))
        self.register_variable(Float64("y", causality=Fmi3Causality.input))
        self.register_variable(Float64("u", causality=Fmi3Causality.output))

    def do_step(self, current_time: float, step_size: float) -> bool:
        error = self.goal - self.y
        self.sum += error * step_size
        self.u = max(0.0, min(20.0, self.gain * error + 20.0 * self.sum))
        return True
