"""A controller written from docs/messages.md alone, with the PyPI package iceoryx2 and without Trabecula's
package.

Every name, number and offset is read from the page, so that an error or omission there fails this test.
"""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import pathlib
import re
import struct
import time
from typing import Any, Callable

import support
from scenes import shared
from support import Run

(iceoryx2,) = support.needs("iceoryx2")

PAGE = (support.ROOT / "docs/messages.md").read_text()
LIMIT_S = 30
TICKS = 500
TENSION_N = 7.25
CODES = {"uint32": "<I", "uint64": "<Q", "float64": "<d"}


def word(pattern: str) -> str:
    """Returns the only match of a pattern in the page."""
    found = set(re.findall(pattern, PAGE))
    assert len(found) == 1, (pattern, found)
    return str(found.pop())


def section(title: str) -> str:
    return PAGE.split(f"\n## {title}\n", 1)[1].split("\n## ", 1)[0]


def rows(text: str) -> list[list[str]]:
    """Returns the cells of table rows."""
    lines = [line.strip() for line in text.splitlines() if line.strip().startswith("| ")]
    return [[cell.strip().strip("`") for cell in line.strip("|").split(" | ")] for line in lines]


class Message:
    """A message of the page: the offsets of its fields."""

    def __init__(self, name: str) -> None:
        text = section(name)
        self.size = int(re.search(r", (\d+) bytes\.", text)[1])
        self.layout = re.search(r"layout `([0-9a-f]{16})`", text)[1]
        scalars = [(row[0], row[1].split("[")[0], row[2]) for row in rows(text)]
        self.fields = {
            name: (CODES[scalar], int(offset)) for name, scalar, offset in scalars if scalar in CODES
        }

    def get(self, memory: Any, name: str) -> Any:
        code, offset = self.fields[name]
        return struct.unpack_from(code, memory, offset)[0]

    def put(self, memory: Any, **values: Any) -> None:
        for name, value in values.items():
            code, offset = self.fields[name]
            struct.pack_into(code, memory, offset, value)


STATE, COMMAND, STATUS = Message("State"), Message("Command"), Message("RunStatus")
SERVICES = {row[0]: row for row in rows(section("Services")) if len(row) == 9}
WAKE = {row[0].split(" (")[0]: row for row in rows(section("Joining with iceoryx2 alone")) if len(row) == 3}
SHM_PREFIX = word(r"which is `(\S+<name of the folder>_)`")
HELD = int(word(r"may hold (\d+) samples at a time"))
ENDED = int(word(r"with `phase` (\d+), after the last state"))
SESSION_VARIABLE, NAME_VARIABLE = (
    word(r"programs that it starts in\s+`(\w+)`"),
    word(r"`(\w+)` holds the name"),
)


def drives_a_run() -> None:
    # 1. The session.
    folder, name = pathlib.Path(os.environ[SESSION_VARIABLE]), os.environ[NAME_VARIABLE]
    announced = json.loads((folder / "session.json").read_text())
    assert announced["iceoryx2"] == word(r"iceoryx2 \*\*([0-9.]+)\*\*")
    command_name = word(r"publisher of `(command/<controller>)`").replace("<controller>", name)
    for service, message in [("state", STATE), ("run_status", STATUS), (command_name, COMMAND)]:
        assert announced["layouts"][service] == message.layout, service
    index = announced["controllers"].index(name)

    # 2. The node.
    iceoryx2.set_log_level(iceoryx2.LogLevel.Fatal)
    config = iceoryx2.config.default()
    config.global_cfg.root_path = iceoryx2.Path.new(str(folder))
    config.global_cfg.prefix = iceoryx2.FileName.new(SHM_PREFIX.replace("<name of the folder>", folder.name))
    builder = iceoryx2.NodeBuilder.new().config(config)
    node = builder.signal_handling_mode(iceoryx2.SignalHandlingMode.Disabled).create(iceoryx2.ServiceType.Ipc)

    # 3. Services.
    def service(name: str) -> Any:
        return node.service_builder(iceoryx2.ServiceName.new(name))

    def subscriber(name: str) -> Any:
        opened = service(name).publish_subscribe(iceoryx2.Slice[ctypes.c_uint8]).open()
        return opened.subscriber_builder().buffer_size(int(SERVICES[name][3])).create()

    def taken(subscriber: Any) -> Any:
        """Returns a copy of the oldest waiting message, which is released at once."""
        sample = subscriber.receive()
        if sample is None:
            return None
        slice_ = sample.payload()
        copy = ctypes.string_at(slice_.data_ptr, slice_.len())
        sample.delete()
        return copy

    states, status = subscriber("state"), subscriber("run_status")
    commands = service(command_name).publish_subscribe(iceoryx2.Slice[ctypes.c_uint8]).open()
    most_bytes = int(SERVICES["command/<controller>"][8])
    commands = commands.publisher_builder().initial_max_slice_len(most_bytes).create()

    # 4. Waking: the physics, and being woken.
    notifier = service(WAKE["physics"][1]).event().open().notifier_builder().create()
    listener = (
        service(WAKE["a controller"][1].replace("<index>", str(index)))
        .event()
        .open()
        .listener_builder()
        .create()
    )
    first, stride = re.fullmatch(r"(\d+) \+ (\d+) × index", WAKE["a controller"][2]).groups()
    flags_file = word(r"in the file `(\S+)` in the session's folder")
    with open(folder / flags_file, "r+b") as file:
        flags = mmap.mmap(file.fileno(), 0)
    struct.pack_into("<I", flags, int(first) + int(stride) * index, 1)

    # 5. The controller, to 7. the end.
    sequence, answered = 0, None
    limit = time.monotonic() + LIMIT_S
    while True:
        newest = None
        while (message := taken(states)) is not None:
            assert len(message) == STATE.size
            newest = message
        if newest is not None:
            tick = STATE.get(newest, "tick")
            if tick != answered:
                sequence, answered = sequence + 1, tick
                loan = commands.loan_slice_uninit(COMMAND.size)
                assert loan.payload().data_ptr % 8 == 0
                memory = (ctypes.c_ubyte * COMMAND.size).from_address(loan.payload().data_ptr)
                ctypes.memset(memory, 0, COMMAND.size)
                COMMAND.put(
                    memory, sequence=sequence, state_tick=tick, tendon_mode=1, tendon_force_n=TENSION_N
                )
                del memory
                loan.assume_init().send()
                notifier.notify()
            limit = time.monotonic() + LIMIT_S
            continue
        phases = []
        while (message := taken(status)) is not None:
            phases.append(STATUS.get(message, "phase"))
        if ENDED in phases and not states.has_samples():
            break
        # May return early and empty: two wake-ups can be merged into one.
        listener.timed_wait(iceoryx2.Duration.from_secs(LIMIT_S))
        assert time.monotonic() < limit, f"no message within {LIMIT_S} s"
    # At the end there is nothing to answer: 500 or 501 states.
    assert sequence in (TICKS, TICKS + 1), sequence


def test_a_controller_written_from_the_page_alone_drives_a_run_to_its_end(
    start: Callable[[str], Run],
) -> None:
    """The page must explain how to reach the session, how to wake readers, and how to detect the end."""
    # The second controller, so that its index matters.
    before, pilot, holder = shared("lockstep", 1e-3 * TICKS).split("[[controller]]")
    run = start("[[controller]]".join([before, holder, pilot]))
    support.outside(drives_a_run, session=run.session, controller="pilot")
    folder = run.end()
    ticks = support.messages(folder / "run.mcap", "/latched")
    assert len(ticks) == TICKS
    for tick in ticks:
        latched = tick["commands"][1]
        assert (latched["source"], latched["age_ticks"]) == (1, 0), tick
        assert latched["command"]["tendon_force_n"][0] == TENSION_N, tick
    support.assert_replays(folder)


if __name__ == "__main__":
    support.main(globals())
