"""A peer on Eclipse Cyclone DDS, with the message types of cyclone_peer.py, without ROS.

    python cyclone.py TENSION_N

Reads frames, clock and operating state; sends messages that must be rejected; pulls the tendon; disables, pauses,
resumes; prints its results.
"""

import json
import math
import sys
import time

from cyclone_peer import (
    Clock, Header, JointState, JointTrajectory, JointTrajectoryPoint, OperatingState, StringStamped, TFMessage, Time,
    best_effort, kept, plain, reader, writer
)

LIMIT_S = 60.0

tf, tf_static = reader(TFMessage, "/tf", best_effort), reader(TFMessage, "/tf_static", kept)
clock, motor = reader(Clock, "/clock", plain), reader(JointState, "/CM/bend_motor/measured_js", best_effort)
arm, follow = reader(JointState, "/UR5/measured_js", best_effort), writer(JointTrajectory, "/UR5/joint_trajectory")
operating = reader(OperatingState, "/UR5/operating_state", kept)
servo_jf, move_jp = writer(JointState, "/CM/bend_motor/servo_jf"), writer(JointState, "/UR5/move_jp")
state_command = writer(StringStamped, "/UR5/state_command")
header = Header(Time(0, 0), "")
newest, states, frames = {}, [], {}


def look():
    for name, source in (("clock", clock), ("motor", motor), ("arm", arm)):
        for sample in source.take(50):
            newest[name] = sample
    for sample in operating.take(50):
        states.append((sample.state, sample.is_homed, sample.is_busy))
    for source in (tf_static, tf):
        for sample in source.take(50):
            frames.update({t.child_frame_id: t for t in sample.transforms})


def until(what, found):
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        look()
        if found():
            return
        time.sleep(0.01)
    sys.exit(f"{what}: not in {LIMIT_S} s; states {states}, frames {sorted(frames)}, {newest}")


def say(word):
    state_command.write(StringStamped(header, word))


def pull(effort, name=()):
    servo_jf.write(JointState(header, list(name), [], [], list(effort)))


def tension():
    return newest["motor"].effort[0] if "motor" in newest else math.nan


def matched(source):
    return len(source.get_matched_subscriptions()) == 1


tension_n = float(sys.argv[1])
until("subscriptions", lambda: all(map(matched, (servo_jf, move_jp, state_command, follow))))
until("first state", lambda: {"clock", "motor", "arm"} <= newest.keys() and "CM/tip" in frames and "UR5/base" in frames and states)
pull([math.nan, 0.0])
pull([1.0])
pull([1.0, 0.0], ["tendon_0", "elbow"])
move_jp.write(JointState(header, [], [0.0] * 7, [], []))
say("fly")
pull([tension_n, 0.0], ["tendon_0", "tendon_1"])
until("tension", lambda: abs(tension() - tension_n) < 0.05)

# A trajectory of the last joint, by name: out, and half-way back.
begin, joint = list(newest["arm"].position), len(newest["arm"].position) - 1
out, back = ([*begin[:joint], begin[joint] + by_rad] for by_rad in (0.04, 0.02))
points = [JointTrajectoryPoint(at, [], [], [], Time(second, 0)) for second, at in ((1, out), (2, back))]
follow.write(JointTrajectory(header, newest["arm"].name, points))
turned = []
until("trajectory", lambda: turned.append(newest["arm"].position[joint] - begin[joint]) or (
    max(turned) > 0.035 and abs(turned[-1] - 0.02) < 1e-4 and abs(newest["arm"].velocity[joint]) < 1e-6))

say("disable")
until("DISABLED", lambda: states[-1][0] == "DISABLED")
pull([0.0, 0.0])
time.sleep(0.2)
say("enable")
until("ENABLED", lambda: states[-1][0] == "ENABLED")
kept_n = tension()

say("pause")
until("PAUSED", lambda: states[-1][0] == "PAUSED")
stopped = newest["clock"]
time.sleep(0.5)
look()
stood = newest["clock"] == stopped or newest["clock"].clock.sec == stopped.clock.sec
pull([0.0, 0.0])
time.sleep(0.2)
say("resume")
until("going on", lambda: states[-1][0] == "ENABLED")
until("slack", lambda: pull([0.0, 0.0]) or tension() < 0.05)


def chain(child):
    """Returns the position of a frame in the world, through its parents."""
    position = [0.0, 0.0, 0.0]
    while child != "world":
        t = frames[child].transform
        q, (x, y, z) = t.rotation, position
        ux, uy, uz = (2 * (q.y * z - q.z * y), 2 * (q.z * x - q.x * z), 2 * (q.x * y - q.y * x))
        position = [
            x + q.w * ux + q.y * uz - q.z * uy + t.translation.x,
            y + q.w * uy + q.z * ux - q.x * uz + t.translation.y,
            z + q.w * uz + q.x * uy - q.y * ux + t.translation.z,
        ]
        child = frames[child].header.frame_id
    return position


stamp = frames["CM/tip"].header.stamp
shown, tip_m = sorted(frames), chain("CM/tip")
# A reset forgets the tension.
pull([tension_n, 0.0])
until("tension again", lambda: abs(tension() - tension_n) < 0.05)
say("reset")
until("reset", lambda: tension() < 0.05)
print(json.dumps({
    "states": states,
    "kept_n": kept_n,
    "turned_rad": [max(turned), turned[-1]],
    "stood": stood,
    "frames": shown,
    "tip_m": tip_m,
    "tip_time_s": stamp.sec + 1e-9 * stamp.nanosec,
    "tendons": newest["motor"].name,
}))
