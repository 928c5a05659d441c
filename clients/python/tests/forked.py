"""A child made by fork: it uses nothing of its parent's client, and its end disconnects nobody.

Run by the test `tests/processes/forks.rs` as the external controller `mine` of a lockstep run with X-ray and a volume.
"""

import gc
import multiprocessing
import os
import subprocess
import sys
import threading

import numpy as np
import trabecula as t

LIMIT_S = 60.0


def answer(client):
    state = client.wait_state(LIMIT_S)
    with client.command() as command:
        command.tendon_mode = t.TENDON_SERVO_JF
        command.tendon_force_n[0] = 2.0
    return state.tick


def status_of(call):
    try:
        call()
    except t.Error as error:
        return error.status
    return 0


def all_calls(client):
    """Every call of a client that needs no state."""
    return [
        client.wait_state, client.next_state, client.poll_state, client.loan_command, client.send_command,
        client.discard_command, client.request_frame, client.wait_frame, client.volume, client.events, client.next_removed,
        lambda: client.run_control(t.CONTROL_STOP), lambda: client.remark("x"), lambda: client.status, lambda: client.info,
        lambda: client.states_missed,
    ]


def child(client, hu, expected):
    """What a worker does: it reads what was handed out, and is refused what it asks for."""
    assert int(hu.astype(np.int64).sum()) == expected
    for call in all_calls(client):
        status = status_of(call)
        assert status == t.ERROR_FORKED, (call, status)
    client.close()
    # The child's own client.
    with t.Client(controller="") as observer:
        assert observer.wait_state(LIMIT_S).tick >= 0
        assert int(observer.volume(LIMIT_S).hu.astype(np.int64).sum()) == expected


def forked(body, leave):
    """The exit code of a forked child."""
    pid = os.fork()
    if pid == 0:
        try:
            body()
        except BaseException:
            sys.excepthook(*sys.exc_info())
            os._exit(1)
        leave()
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def held_lock_and_child(client):
    """A fork while other threads hold and release the memory of clients."""
    over = threading.Event()

    def churn():
        while not over.is_set():
            with t.Client(controller="") as observer:
                state = observer.wait_state(LIMIT_S)
            del state

    thread = threading.Thread(target=churn)
    thread.start()
    for _ in range(20):
        assert forked(gc.collect, lambda: sys.exit(0)) == 0
    over.set()
    thread.join()


if __name__ == "__main__":
    client = t.Client()
    hu = client.volume(LIMIT_S).hu
    expected = int(hu.astype(np.int64).sum())
    ticks = [answer(client)]

    # A normal exit, which runs every clean-up; a hard exit; an exec.
    assert forked(lambda: child(client, hu, expected), lambda: sys.exit(0)) == 0
    ticks.append(answer(client))
    assert forked(lambda: child(client, hu, expected), lambda: os._exit(0)) == 0
    assert forked(lambda: None, lambda: os.execv(sys.executable, [sys.executable, "-c", "pass"])) == 0

    def let_go():
        global client, hu
        client = hu = None
        gc.collect()

    assert forked(let_go, lambda: sys.exit(0)) == 0
    ticks.append(answer(client))

    workers = multiprocessing.get_context("fork")
    worker = workers.Process(target=child, args=(client, hu, expected))
    worker.start()
    worker.join(LIMIT_S)
    assert worker.exitcode == 0, worker.exitcode
    with workers.Pool(2) as pool:
        assert pool.map(abs, [-1, -2, -3]) == [1, 2, 3]
    ticks.append(answer(client))

    subprocess.run([sys.executable, "-c", "pass"], check=True)
    subprocess.run(["true"], check=True, preexec_fn=gc.collect)
    ticks.append(answer(client))
    # Each answer is for its own tick: the parent was connected the whole time.
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks))), ticks
    held_lock_and_child(client)
    for _ in range(50):
        answer(client)
    frame = client.wait_frame(client.request_frame(), LIMIT_S)
    assert frame.pixels.size
    client.run_control(t.CONTROL_STOP, timeout_s=LIMIT_S)
    try:
        while True:
            client.wait_state(LIMIT_S)
    except t.Ended:
        print("ended")
