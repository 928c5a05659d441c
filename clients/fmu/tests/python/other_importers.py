"""Steps an FMU of ours in another importer: `libcosim` or `ecos`, or `fmuloader` for FMI 3.0.

Prints one JSON object: the bits of a number of the FMU after every step, and its text `hash` after the last.
"""

from __future__ import annotations

import ctypes
import json
import struct
import sys
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

importer, file, steps = sys.argv[1], sys.argv[2], int(sys.argv[3])
reals: dict[str, float | list[float]] = json.loads(sys.argv[4])
whole_numbers: dict[str, int] = json.loads(sys.argv[5])
output = sys.argv[6]


def by_libcosim() -> tuple[list[float], str]:
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimManipulator import CosimManipulator
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    execution = CosimExecution.from_step_size(step_size=1_000_000)  # ns
    index = execution.add_local_slave(local_slave=CosimLocalSlave(fmu_path=file, instance_name="a"))
    manipulator, observer = CosimManipulator.create_override(), CosimObserver.create_last_value()
    execution.add_manipulator(manipulator=manipulator)
    execution.add_observer(observer=observer)
    names = {variable.name.decode(): variable.reference for variable in execution.slave_variables(slave_index=index)}

    def of(wanted: dict[str, Any]) -> list[int]:
        return [names[name] for name in wanted]

    manipulator.slave_real_values(index, of(reals), list(reals.values()))
    manipulator.slave_integer_values(index, of(whole_numbers), list(whole_numbers.values()))
    course = []
    for _ in range(steps):
        execution.step()
        course += observer.last_real_values(index, [names[output]])
    [text] = observer.last_string_values(index, [names["hash"]])
    return course, text.decode()


def by_ecos() -> tuple[list[float], str]:
    # Its library needs TBB, which PyPI has in a package of its own.
    for library in Path(sys.prefix, "lib").glob("libtbb.so.12"):
        ctypes.CDLL(str(library), ctypes.RTLD_GLOBAL)
    from ecospy import EcosSimulation, EcosSimulationStructure

    structure = EcosSimulationStructure()
    structure.add_model("a", file)
    simulation = EcosSimulation(step_size=1e-3, structure=structure)
    simulation.init()
    for name, value in reals.items():
        simulation.set_real(f"a::{name}", value)
    for name, number in whole_numbers.items():
        simulation.set_integer(f"a::{name}", number)
    course = []
    for _ in range(steps):
        simulation.step()
        course.append(simulation.get_real(f"a::{output}"))
    text = simulation.get_string("a::hash")
    simulation.terminate()
    simulation.free()
    return course, text


def by_fmuloader() -> tuple[list[float], str]:
    from fmuloader.fmi3 import Fmi3Slave

    root = ElementTree.fromstring(zipfile.ZipFile(file).read("modelDescription.xml"))
    [variables], [mode] = root.iter("ModelVariables"), root.iter("CoSimulation")
    references = {variable.attrib["name"]: int(variable.attrib["valueReference"]) for variable in variables}
    slave = Fmi3Slave(file, model_identifier=mode.attrib["modelIdentifier"])
    slave.instantiate_co_simulation("a", instantiation_token=root.attrib["instantiationToken"])
    slave.enter_initialization_mode(start_time=0.0)
    for name, value in reals.items():
        slave.set_float64([references[name]], value if isinstance(value, list) else [value])
    for name, number in whole_numbers.items():
        slave.set_uint32([references[name]], [number])
    slave.exit_initialization_mode()
    course = []
    for step in range(steps):
        slave.do_step(step * 1e-3, 1e-3)
        course += slave.get_float64([references[output]])
    [text] = slave.get_string([references["hash"]])
    slave.terminate()
    slave.free_instance()
    return course, text


course, text = {"libcosim": by_libcosim, "ecos": by_ecos, "fmuloader": by_fmuloader}[importer]()
# As bits: decimal numbers are not read back exactly everywhere.
bits = [struct.unpack("<Q", struct.pack("<d", value))[0] for value in course]
print(json.dumps({"course": bits, "hash": text}))
