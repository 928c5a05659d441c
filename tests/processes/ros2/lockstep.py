"""An exact run: answers every state with commands that carry its stamp, computed from it alone.

    python lockstep.py DELAY_MS STATES MANNER

Follows states DELAY_MS late. MANNER `plain` sends one command per part. `rough` also sends a second command with
other values after each, in changing order, repeats those of the last state, sends one with the stamp of a state that
does not exist, and answers two states only when they are published again. `before` and `between` also reset the
simulation once, before the commands for a state or after the first of them. Prints what it saw, with the Jacobians and
clearances of the last state.
"""

import json
import math
import sys
import time

import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from cyclone_peer import Header, StringStamped, Time, writer

LIMIT_S = 80.0
delay_s, states, manner = float(sys.argv[1]) / 1e3, int(sys.argv[2]), sys.argv[3]
is_rough = manner == "rough"
rclpy.init()
node = rclpy.create_node("lockstep")
motor, arm, burr = {}, {}, {}
repeated = 0


def listen(topic, messages):
    def keep(message):
        global repeated
        stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
        repeated += stamp in messages
        messages[stamp] = message

    node.create_subscription(JointState, topic, keep, QoSProfile(depth=100))


listen("/CM/bend_motor/measured_js", motor)
listen("/UR5/measured_js", arm)
listen("/CM/burr/measured_js", burr)
arrays = {}
for kind, topic in [(Float64MultiArray, "/CM/jacobian"), (Float64MultiArray, "/CM/compliance"),
                    (Float64MultiArray, "/clearance"), (Float64MultiArray, "/UR5/jacobian"), (TwistStamped, "/UR5/measured_cv")]:
    node.create_subscription(kind, topic, lambda message, topic=topic: arrays.update({topic: message}), 10)
motor_jv = node.create_publisher(JointState, "/CM/bend_motor/servo_jv", 10)
arm_jv = node.create_publisher(JointState, "/UR5/servo_jv", 10)
burr_jv = node.create_publisher(JointState, "/CM/burr/servo_jv", 10)


state_command = writer(StringStamped, "/UR5/state_command")


def reset():
    """Resets the simulation. What was sent before arrives before, what is sent later arrives later."""
    time.sleep(0.3)
    state_command.write(StringStamped(Header(Time(0, 0), ""), "reset"))
    time.sleep(0.3)


def answer(stamp):
    """Commands of the three parts, each a function of the measured values."""
    pulled, joints = motor[stamp], arm[stamp]
    seconds = stamp[0] + stamp[1] * 1e-9
    commands = []
    for publisher, velocity in [
        (motor_jv, [2e-3 * math.cos(40.0 * seconds) - 0.5 * pulled.position[0], -1e-3 - 0.2 * pulled.position[1]]),
        (arm_jv, [0.02 * math.sin(joints.position[joint]) - 0.05 * joints.velocity[joint] for joint in range(6)]),
        (burr_jv, [400.0 + 0.2 * burr[stamp].velocity[0]]),
    ]:
        command = JointState(velocity=velocity)
        command.header.stamp.sec, command.header.stamp.nanosec = stamp
        commands.append((publisher, command))
    return commands


def halved(command):
    return JointState(header=command.header, velocity=[0.5 * rate for rate in command.velocity])


deadline = time.monotonic() + LIMIT_S
answered, last, answers = [], [], 0
while len(answered) < states and time.monotonic() < deadline:
    rclpy.spin_once(node, timeout_sec=0.01)
    if min(p.get_subscription_count() for p in (motor_jv, arm_jv, burr_jv)) == 0 or not motor:
        continue
    stamp = max(motor)
    if stamp in answered or stamp not in arm or stamp not in burr:
        continue
    number = len(answered)
    if is_rough and number in (20, 40) and answers == number:
        # Lost: the state comes again.
        before, answers = repeated, answers + 1
        while repeated < before + 3 and time.monotonic() < deadline:
            rclpy.spin_once(node, timeout_sec=0.05)
    if number == states - 1:
        # Arrays have no stamp; those that come with a repetition of this state are its own.
        for _ in range(20):
            rclpy.spin_once(node, timeout_sec=0.02)
        arrays.clear()
        while len(arrays) < 5 and time.monotonic() < deadline:
            rclpy.spin_once(node, timeout_sec=0.05)
    time.sleep(delay_s)
    commands = answer(stamp)
    if is_rough:
        for publisher, command in last:
            publisher.publish(command)
        future = JointState(velocity=[0.001, 0.0])
        future.header.stamp.sec = 1000
        motor_jv.publish(future)
        if number % 2:
            commands.reverse()
        # A second command of each part for the same state, with other values.
        commands = [one for publisher, command in commands for one in ((publisher, command), (publisher, halved(command)))]
    for place, (publisher, command) in enumerate(commands):
        if number == 60 and (manner, place) in (("before", 0), ("between", 1)):
            reset()
        publisher.publish(command)
    last = commands
    answered.append(stamp)
    answers = max(answers, number + 1)
if len(answered) < states:
    sys.exit(f"{len(answered)} of {states} states in {LIMIT_S} s; newest {max(motor, default=None)}")
gaps = sum(1 for one, next in zip(answered, answered[1:]) if (next[0] - one[0]) * 10**9 + next[1] - one[1] != 10**6)
sizes = {topic: [dim.size for dim in array.layout.dim] for topic, array in arrays.items() if hasattr(array, "layout")}
data = {topic: list(array.data) for topic, array in arrays.items() if topic in sizes}
twist = arrays["/UR5/measured_cv"].twist
print(json.dumps({
    "answered": len(answered), "gaps": gaps, "first": answered[0], "repeated": repeated, "sizes": sizes, "data": data,
    "structures": [dim.label for dim in arrays["/clearance"].layout.dim],
    "twist": [twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.x, twist.angular.y, twist.angular.z],
}))
# The last commands must arrive before the publishers disappear.
time.sleep(0.5)
rclpy.shutdown()
