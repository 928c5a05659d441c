"""Loss and latency of the ROS 2 bridge compared with plain rclpy, in one run, and the bridge's memory over
time.

    python lab/peers/ros2.py TRABECULA_PROGRAM [SECONDS] [RATE_HZ]

Needs the packages that tests/processes/ros2.rs installs. A session without bone runs in real time; the bridge
and a plain rclpy publisher of the same JointState each send RATE_HZ (100) messages per second to one rclpy
subscriber (reliable, depth 10; DDS's source and reception stamps, one clock).
"""

import os
import pathlib
import subprocess
import sys
import tempfile
import time

PUBLISHER = """
import sys, time, rclpy
from sensor_msgs.msg import JointState
rclpy.init(); node = rclpy.create_node("publisher")
out = node.create_publisher(JointState, "/peer/measured_js", 1)
due, period_s = time.monotonic(), 1.0 / float(sys.argv[1])
while True:
    out.publish(JointState(name=["joint"] * 6, position=[0.1] * 6, velocity=[0.0] * 6))
    due += period_s
    time.sleep(max(0.0, due - time.monotonic()))
"""
SCENE = """name = "quiet"
[run]
mode = "realtime"
duration_s = {duration_s}
[tool]
burr_start_mm = [0.0, 0.0, -34.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
[[controller]]
name = "holder"
drives = ["tendon", "arm", "burr"]
hold = {{ tension_n = 2.0 }}
"""


def figures(name, seen, sent):
    ages = sorted(age for age, _ in seen)
    at = lambda share: ages[min(len(ages) - 1, int(share * len(ages)))] / 1e3
    print(f"| {name} | {len(seen)} of {sent} | {at(0.5):.0f} | {at(0.9):.0f} | {at(0.99):.0f} |")


def rss_kb(process):
    text = pathlib.Path(f"/proc/{process.pid}/status").read_text()
    return int(text.split("VmRSS:")[1].split()[0])


def cpu_s(process):
    """Returns user plus system time, from proc(5)'s fields 14 and 15."""
    fields = pathlib.Path(f"/proc/{process.pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(bridge, seconds):
    import rclpy
    from sensor_msgs.msg import JointState

    rclpy.init()
    node = rclpy.create_node("measure")
    seen = {"/UR5/measured_js": [], "/peer/measured_js": []}

    def listen(topic):
        # The callback's second argument: DDS's stamps.
        def keep(message, info):
            age_ns = info["received_timestamp"] - info["source_timestamp"]
            seen[topic].append((age_ns, info["publication_sequence_number"]))

        node.create_subscription(JointState, topic, keep, 10)

    any(map(listen, seen))
    deadline = time.monotonic() + 30.0
    while not all(seen.values()) and time.monotonic() < deadline:
        rclpy.spin_once(node, timeout_sec=0.1)
    any(map(list.clear, seen.values()))
    start, memory, used_s = time.monotonic(), [], cpu_s(bridge)
    while time.monotonic() - start < seconds:
        rclpy.spin_once(node, timeout_sec=0.1)
        if time.monotonic() - start >= 15.0 * len(memory):
            memory.append(rss_kb(bridge))
    share = 100.0 * (cpu_s(bridge) - used_s) / (time.monotonic() - start)
    rclpy.shutdown()
    print("| from | received of sent | p50 us | p90 us | p99 us |\n|---|---|---|---|---|")
    for name, topic in (("bridge", "/UR5/measured_js"), ("rclpy", "/peer/measured_js")):
        figures(name, seen[topic], seen[topic][-1][1] - seen[topic][0][1] + 1)
    print(f"bridge: {share:.1f} % of a core; memory every 15 s, kB:", *memory)


def main():
    program = sys.argv[1]
    seconds, rate_hz = [*map(float, sys.argv[2:]), *(60.0, 100.0)[len(sys.argv) - 2 :]]
    os.environ.update(ROS_DOMAIN_ID="97", ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    with tempfile.TemporaryDirectory() as folder:
        scene = pathlib.Path(folder, "scene.toml")
        scene.write_text(SCENE.format(duration_s=seconds + 60.0))
        run = subprocess.Popen(
            [program, "run", scene, "--output", folder],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )
        session = next(line.split()[1] for line in run.stdout if line.startswith("session "))
        bridge = subprocess.Popen(
            [program, "bridge", "ros2", "--rate", str(rate_hz), "--session", session],
            stdout=subprocess.PIPE, text=True,
        )
        publisher = subprocess.Popen([sys.executable, "-c", PUBLISHER, str(rate_hz)])
        try:
            print(bridge.stdout.readline().strip())
            measure(bridge, seconds)
        finally:
            publisher.kill()
            bridge.terminate()
            print(bridge.communicate(timeout=30)[0].strip())
            run.terminate()
            run.communicate(timeout=60)


main()
