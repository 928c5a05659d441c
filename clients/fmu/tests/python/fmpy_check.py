"""Imports an FMU of ours by FMPy. Prints one JSON object with what was found."""

import hashlib
import json
import sys
from collections.abc import Callable
from typing import Any

from fmpy import extract, read_model_description, simulate_fmu
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

file, ticks = sys.argv[1], int(sys.argv[2])
#: Inputs by name, for all ticks; and parameters.
inputs: dict[str, Any] = json.loads(sys.argv[3])
parameters: dict[str, float] = json.loads(sys.argv[4])
description = read_model_description(file)
is_three = description.fmiVersion.startswith("3")
folder = extract(file)
by_name = {variable.name: variable for variable in description.modelVariables}
dt_s = description.defaultExperiment.stepSize
dt_s = float(dt_s)


def reference(name: str) -> int:
    return by_name[name].valueReference


def created() -> Any:
    kind = FMU3Slave if is_three else FMU2Slave
    token = description.instantiationToken if is_three else description.guid
    fmu = kind(
        guid=token,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="test",
    )
    fmu.instantiate()
    return fmu


def set_all(fmu: Any, values: dict[str, Any]) -> None:
    for name, value in values.items():
        several = value if isinstance(value, list) else [value]
        kind = by_name[name if name in by_name else f"{name}[0]"].type
        if is_three:
            setters = {
                "Float64": fmu.setFloat64,
                "UInt32": fmu.setUInt32,
                "Int64": fmu.setInt64,
                "Boolean": fmu.setBoolean,
            }
            setters[kind]([reference(name)], several)
        else:
            names = [f"{name}[{i}]" for i in range(len(several))] if isinstance(value, list) else [name]
            setters = {"Real": fmu.setReal, "Integer": fmu.setInteger, "Boolean": fmu.setBoolean}
            setters[kind]([reference(one) for one in names], several)


def begun() -> Any:
    fmu = created()
    set_all(fmu, parameters)
    if not is_three:
        fmu.setupExperiment(startTime=0.0)
        fmu.enterInitializationMode()
    else:
        fmu.enterInitializationMode(startTime=0.0)
    set_all(fmu, inputs)
    fmu.exitInitializationMode()
    return fmu


def hash_of(fmu: Any) -> str:
    [text] = fmu.getString([reference("hash")])
    return text if isinstance(text, str) else text.decode()


def run(fmu: Any, first: int, last: int) -> None:
    for tick in range(first, last):
        fmu.doStep(tick * dt_s, dt_s)


def refused(call: Callable[[], object]) -> bool:
    try:
        call()
    except FMICallException:
        return True
    return False


found: dict[str, Any] = {"problems": validate_fmu(file)}
fmu = begun()
half = ticks // 2
run(fmu, 0, half)
state = fmu.getFMUState() if is_three else fmu.getFMUstate()
run(fmu, half, ticks)
found["hash"] = hash_of(fmu)
found["refuses_half_a_tick"] = refused(lambda: fmu.doStep(ticks * dt_s, 0.5 * dt_s))
found["refuses_another_time"] = refused(lambda: fmu.doStep((ticks + 7) * dt_s, dt_s))
get = fmu.getFloat64 if is_three else fmu.getReal
found["refuses_unknown"] = refused(lambda: get([4_000_000_000]))
found["hash_after_refusals"] = hash_of(fmu)
(fmu.setFMUState if is_three else fmu.setFMUstate)(state)
found["time_back"] = get([0])[0] if is_three else None
run(fmu, half, ticks)
found["hash_after_rollback"] = hash_of(fmu)
if description.coSimulation.canSerializeFMUstate:
    saved = fmu.serializeFMUState(state) if is_three else fmu.serializeFMUstate(state)
    other = begun()
    restored = other.deserializeFMUState(saved) if is_three else other.deSerializeFMUstate(saved)
    (other.setFMUState if is_three else other.setFMUstate)(restored)
    run(other, half, ticks)
    found["hash_after_serialisation"] = hash_of(other)
    found["refuses_damage"] = refused(
        lambda: (other.deserializeFMUState if is_three else other.deSerializeFMUstate)(saved[:200])
    )
    other.terminate()
    other.freeInstance()
bend = reference("state.bend_rad")
found["bend_rad"] = get([bend])[0]
if inputs:
    tendon = next(name for name in by_name if name.endswith("tendon_force_n" if is_three else "tendon_force_n[0]"))
    seed = [1.0, 0.0, 0.0, 0.0][: len(inputs[tendon.removesuffix("[0]")])] if is_three else [1.0]
    found["derivative"] = fmu.getDirectionalDerivative([bend], [reference(tendon)], seed)[0]
if "x_ray" in by_name:
    [pixels] = fmu.getBinary([reference("x_ray")])
    found["x_ray"] = [len(pixels), hashlib.sha256(bytes(pixels)).hexdigest()]
(fmu.freeFMUState if is_three else fmu.freeFMUstate)(state)
fmu.reset()
set_all(fmu, parameters)
if not is_three:
    fmu.setupExperiment(startTime=0.0)
    fmu.enterInitializationMode()
else:
    fmu.enterInitializationMode(startTime=0.0)
set_all(fmu, inputs)
fmu.exitInitializationMode()
fmu.doStep(0.0, ticks * dt_s)
found["hash_after_reset_in_one_step"] = hash_of(fmu)
fmu.terminate()
fmu.freeInstance()
start = {**parameters, **inputs}
if not is_three:
    start = {
        (f"{name}[{i}]" if isinstance(value, list) else name): one
        for name, value in start.items()
        for i, one in enumerate(value if isinstance(value, list) else [value])
    }
course = simulate_fmu(
    file,
    stop_time=ticks * dt_s,
    step_size=dt_s,
    output_interval=dt_s,
    start_values=start,
    output=["state.bend_rad"],
)
found["simulated_bend_rad"] = float(course["state.bend_rad"][-1])
print(json.dumps(found))
