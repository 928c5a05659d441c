"""Reads a log with rosbags and with rerun and prints `reader topic count` lines, and the bits of some fields.

Usage: ecosystem.py LOG FOLDER
"""

import collections
import os
import pathlib
import re
import struct
import subprocess
import sys

from rosbags.highlevel import AnyReader


def with_rosbags(log):
    counts = collections.Counter()
    with AnyReader([log]) as reader:
        for connection, _time, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            number = counts[connection.topic]
            counts[connection.topic] += 1
            if connection.topic == "/state":
                link = message.t_world_link[7].position_m[2]
                print("rosbags", "/state", number, message.tick, struct.pack(">d", link).hex())
            if connection.topic == "/drr/image":
                print("rosbags", "/drr/image", number, message.encoding, message.height, message.width, len(message.data))
    for topic, count in counts.items():
        print("rosbags", topic, count)


def with_rerun(log, folder):
    converted = folder / "log.rrd"
    rerun = [sys.executable, "-m", "rerun"]
    os.environ["RERUN_ANALYTICS"] = "0"
    subprocess.run([*rerun, "mcap", "convert", log, "-o", converted], check=True, capture_output=True)
    subprocess.run([*rerun, "rrd", "verify", converted], check=True, capture_output=True)
    printed = subprocess.run([*rerun, "rrd", "print", converted], check=True, capture_output=True, text=True)
    rows = collections.Counter()
    chunk = re.compile(r"Chunk\(\S+\) with ([\d ]+) rows \(.*?\) - (/\S+) - data columns: \[(.*)\]")
    for count, entity, columns in chunk.findall(printed.stdout):
        # How rerun shows a message whose type it knows only by its schema, and an image.
        if any(column.endswith((":message", "Image:buffer")) for column in columns.split()):
            rows[entity] += int(count.replace(" ", ""))
    for entity, count in rows.items():
        print("rerun", entity, count)


with_rosbags(pathlib.Path(sys.argv[1]))
with_rerun(sys.argv[1], pathlib.Path(sys.argv[2]))
