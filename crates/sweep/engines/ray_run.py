"""Runs the points of a sweep as Ray tasks: ray_run.py TRABECULA STUDY FOLDER [ADDRESS]

ADDRESS is that of a cluster whose nodes share the folder; default: two workers on this machine.
Needs `ray` from PyPI.
"""

import shlex
import subprocess
import sys

import ray

#: Timeout for listing the points, seconds.
LIST_LIMIT_S = 600
#: Timeout of a run, after which its point fails, seconds.
RUN_LIMIT_S = 86_400


@ray.remote(max_retries=3)
def run(command):
    """Runs one point and leaves its row in the folder."""
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
    # A point whose worker is killed is retried, because rows are written atomically.
    codes = ray.get([run.remote(command) for command in commands])
    ray.shutdown()
    print(f"{codes.count(0)} of {len(codes)} points run")
    return 0 if codes.count(0) == len(codes) else 1


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
