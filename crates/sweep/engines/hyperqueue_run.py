"""Runs the points of a sweep as tasks of HyperQueue: hyperqueue_run.py TRABECULA STUDY FOLDER [SERVER]

SERVER is the server directory of a running HyperQueue whose workers share the folder; without it, two workers are
started in this process.
Needs `hyperqueue` from PyPI.
"""

import shlex
import subprocess
import sys

from hyperqueue import Client, Job, LocalCluster
from hyperqueue.cluster import WorkerConfig

#: Timeout for listing the points, seconds.
LIST_LIMIT_S = 600


def finish(client, commands):
    job = Job()
    for command in commands:
        # The tasks of a lost worker are retried, because rows are written atomically.
        job.program(shlex.split(command), stdout=None, stderr=None, crash_limit=4)
    client.wait_for_jobs([client.submit(job)])


def main(trabecula, study, folder, server=None):
    words = [trabecula, "sweep", "list", study, "-o", folder]
    listed = subprocess.run(words, check=True, capture_output=True, text=True, timeout=LIST_LIMIT_S)
    commands = listed.stdout.splitlines()
    if server:
        finish(Client(server), commands)
    else:
        with LocalCluster() as cluster:
            for _ in range(2):
                cluster.start_worker(WorkerConfig(cores=1))
            finish(cluster.client(), commands)
    print(f"{len(commands)} points run")


if __name__ == "__main__":
    main(*sys.argv[1:])
