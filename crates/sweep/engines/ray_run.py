"""Runs the points of a sweep as Ray tasks: ray_run.py TRABECULA STUDY FOLDER [ADDRESS]

ADDRESS is that of a cluster whose nodes see the same folder; without it, two workers on this machine. Needs `ray` from PyPI.
"""

import shlex
import subprocess
import sys

import ray

#: Seconds after which the list of points is given up.
LIST_LIMIT_S = 600
#: Seconds after which a run is given up; its point fails.
RUN_LIMIT_S = 86_400


@ray.remote(max_retries=3)
def run(command):
    """Makes one run; its row is in the folder afterwards."""
    words = shlex.split(command)
    return subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, timeout=RUN_LIMIT_S).returncode


def main(trabecula, study, folder, address=None):
    words = [trabecula, "sweep", "list", study, "-o", folder]
    listed = subprocess.run(words, check=True, capture_output=True, text=True, timeout=LIST_LIMIT_S)
    commands = listed.stdout.splitlines()
    if address:
        ray.init(address=address)
    else:
        ray.init(num_cpus=2, include_dashboard=False, configure_logging=False, log_to_driver=False)
    # A point whose worker is killed is run again: a row is kept only when it is whole.
    codes = ray.get([run.remote(command) for command in commands])
    ray.shutdown()
    print(f"{codes.count(0)} of {len(codes)} points run")
    return 0 if codes.count(0) == len(codes) else 1


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
