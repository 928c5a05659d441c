"""Compares two ways to use the hub from Python: the package `trabecula` (ctypes over the C library) and the
PyPI package `iceoryx2`.

    python3 clients/python/benchmarks/transports.py target/release/trabecula

Both answer every state of the same lockstep scene with a command, polling, alternately in one run; the
physics measures the time from publishing a state (7064 bytes) to receiving its command (320 bytes), which is
in the log. Needs
both packages and NumPy: `pip install . iceoryx2==0.10.0 numpy`.
"""

import csv
import ctypes
import os
import pathlib
import subprocess
import sys
import tempfile

SCENE = pathlib.Path(__file__).parents[2] / "scenes" / "free_space.toml"
TURNS = 3
COMMAND_BYTES = 320


def answer_by_ctypes():
    import trabecula

    with trabecula.Client() as client:
        try:
            while True:
                state = client.poll_state()
                if state is None:
                    continue
                command = client.loan_command()
                command.tendon_mode = trabecula.TENDON_SERVO_JF
                command.tendon_force_n[0] = 6.0 * abs(0.5 - state.bend_rad)
                client.send_command()
        except trabecula.Ended:
            pass


def answer_by_iceoryx2():
    """A client on plain iceoryx2: no layout check, its own sequence, message types from `trabecula`."""
    import iceoryx2
    from trabecula import _generated as messages

    folder = pathlib.Path(os.environ["TRABECULA_SESSION"])
    config = iceoryx2.config.default()
    config.global_cfg.root_path = iceoryx2.Path.new(str(folder))
    config.global_cfg.prefix = iceoryx2.FileName.new(f"trabecula010_{folder.name}_")
    builder = iceoryx2.NodeBuilder.new().config(config)
    node = builder.signal_handling_mode(iceoryx2.SignalHandlingMode.Disabled).create(iceoryx2.ServiceType.Ipc)

    def service(name):
        return node.service_builder(iceoryx2.ServiceName.new(name))

    views = {}

    def view(message, address):
        if (message, address) not in views:
            memory = (ctypes.c_char * message.dtype.itemsize).from_address(address)
            views[message, address] = message(memoryview(memory).cast("B"))
        return views[message, address]

    byte_slice = iceoryx2.Slice[ctypes.c_uint8]
    state_service = service("state").publish_subscribe(byte_slice).open()
    states = state_service.subscriber_builder().buffer_size(512).create()
    status_service = service("run_status").publish_subscribe(byte_slice).open()
    status = status_service.subscriber_builder().buffer_size(16).create()
    command_service = service("command/mine").publish_subscribe(byte_slice).open()
    commands = command_service.publisher_builder().initial_max_slice_len(COMMAND_BYTES).create()
    wake = service("wake/physics").event().open().notifier_builder().create()
    sequence = 0
    while True:
        sample = states.receive()
        if sample is None:
            ended = status.receive()
            if ended is not None and view(messages.RunStatus, ended.payload().data_ptr).phase == 3:
                return
            continue
        state = view(messages.State, sample.payload().data_ptr)
        sequence += 1
        loan = commands.loan_slice_uninit(COMMAND_BYTES)
        address = loan.payload().data_ptr
        ctypes.memset(address, 0, COMMAND_BYTES)
        command = view(messages.Command, address)
        command.sequence, command.state_tick = sequence, state.tick
        command.tendon_mode = 1
        command.tendon_force_n[0] = 6.0 * abs(0.5 - state.bend_rad)
        loan.assume_init().send()
        sample.delete()
        wake.notify()


def round_trips_us(program, how, folder):
    run = subprocess.Popen(
        [program, "run", SCENE, "--output", folder], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    session = run.stderr.readline().split()[1]
    environment = {**os.environ, "TRABECULA_SESSION": session, "TRABECULA_CONTROLLER": "mine"}
    subprocess.run([sys.executable, __file__, how], env=environment, check=True, timeout=300)
    _, said = run.communicate(timeout=60)
    assert run.returncode == 0, said
    log = next(pathlib.Path(folder).iterdir()) / "timing.mcap"
    table = pathlib.Path(folder) / "timing.csv"
    topic = ["--topic", "/timing/tick", "--field", "round_trip_ns"]
    export = [program, "log", "export", log, *topic, "-o", table]
    subprocess.run(export, check=True, stdout=subprocess.DEVNULL)
    with open(table) as rows:
        trips = [
            float(next(v for k, v in row.items() if k.startswith("round_trip")))
            for row in csv.DictReader(rows)
        ]
    return [trip * 1e-3 for trip in trips if trip > 0]


def main():
    program = os.path.abspath(sys.argv[1])
    result = {"ctypes": [], "iceoryx2": []}
    for _ in range(TURNS):
        for how, trips in result.items():
            with tempfile.TemporaryDirectory() as folder:
                trips.extend(round_trips_us(program, how, folder))
    p50 = {}
    for how, trips in result.items():
        trips.sort()
        p50[how], p99 = trips[len(trips) // 2], trips[len(trips) * 99 // 100]
        print(f"{how:9} p50 {p50[how]:8.2f} us, p99 {p99:9.2f} us, {len(trips)} round trips")
    print(f"iceoryx2 / ctypes at the median: {p50['iceoryx2'] / p50['ctypes']:.2f}")


if __name__ == "__main__":
    ways = {"ctypes": answer_by_ctypes, "iceoryx2": answer_by_iceoryx2}
    ways.get(sys.argv[1], main)()
