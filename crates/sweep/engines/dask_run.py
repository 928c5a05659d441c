"""Runs the points of a sweep on Dask workers: dask_run.py TRABECULA STUDY FOLDER [SCHEDULER]

SCHEDULER is the address of a scheduler whose workers share the folder; default: two workers on this machine.
Needs `dask` and `distributed` from PyPI.
"""

import shlex
import subprocess
import sys

from dask.distributed import Client, as_completed

#: Timeout for listing the points, seconds.
LIST_LIMIT_S = 600
#: Timeout of a run, after which its point fails, seconds.
RUN_LIMIT_S = 86_400


def run(command):
    """Runs one point and leaves its row in the folder."""
    words = shlex.split(command)
    return subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, timeout=RUN_LIMIT_S).returncode


def main(trabecula, study, folder, scheduler=None):
    words = [trabecula, "sweep", "list", study, "-o", folder]
    listed = subprocess.run(words, check=True, capture_output=True, text=True, timeout=LIST_LIMIT_S)
    commands = listed.stdout.splitlines()
    client = Client(scheduler) if scheduler else Client(n_workers=2, threads_per_worker=1, dashboard_address=None)
    # A point whose worker is killed is retried, because rows are written atomically.
    futures = client.map(run, commands, pure=False, retries=3)
    codes = [future.result() for future in as_completed(futures)]
    client.close()
    print(f"{codes.count(0)} of {len(codes)} points run")
    return 0 if codes.count(0) == len(codes) else 1


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
