"""A CRTK program: curved drilling through ROS 2 alone. Uses arm, bend motor and burr through CRTK's topics only.

    python crtk_drilling.py INSERTION_M FEED_M_PER_S TENSION_N

Feeds the arm along the tool's axis with `servo_cp`, pulls the tendon with `servo_jf` as the tool goes in, and prints
its measurements.
"""

import json
import sys
import time

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import String, UInt64

LIMIT_S = 240.0
insertion_m, feed_m_per_s, tension_n = map(float, sys.argv[1:4])
rclpy.init()
node = rclpy.create_node("crtk_drilling")
newest, count = {}, {}


def listen(kind, topic, qos=10):
    def keep(message):
        newest[topic] = message
        count[topic] = count.get(topic, 0) + 1

    node.create_subscription(kind, topic, keep, qos)


listen(PoseStamped, "/UR5/measured_cp")
listen(JointState, "/UR5/measured_js")
listen(JointState, "/CM/bend_motor/measured_js")
listen(PoseStamped, "/CM/measured_cp")
listen(UInt64, "/removed_voxels")
listen(Image, "/c_arm/image_raw")
listen(String, "/robot_description", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
servo_cp = node.create_publisher(PoseStamped, "/UR5/servo_cp", 10)
servo_jf = node.create_publisher(JointState, "/CM/bend_motor/servo_jf", 10)
burr = node.create_publisher(JointState, "/CM/burr/servo_jv", 10)


def until(what, found):
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        rclpy.spin_once(node, timeout_sec=0.02)
        if found():
            return
    sys.exit(f"{what}: nothing in {LIMIT_S} s; have {sorted(newest)}")


def axis(pose):
    """+z of a pose's frame."""
    q = pose.orientation
    return np.array([2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x**2 + q.y**2)])


def place(pose):
    return np.array([pose.position.x, pose.position.y, pose.position.z])


def seconds(message):
    return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9


topics = ["/UR5/measured_cp", "/UR5/measured_js", "/CM/bend_motor/measured_js", "/CM/measured_cp", "/robot_description"]
until("state", lambda: all(topic in newest for topic in topics))
until("subscriptions", lambda: all(p.get_subscription_count() == 1 for p in (servo_cp, servo_jf, burr)))
start = newest["/UR5/measured_cp"]
origin, along, begun_s = place(start.pose), axis(start.pose), seconds(start)
tendons = len(newest["/CM/bend_motor/measured_js"].name)
until("a node beside this one", lambda: len(node.get_node_names()) > 1)
nodes = node.get_node_names()


def drill():
    """Performs one step of the feed, at the time of the newest state. Returns whether it is finished."""
    rclpy.spin_once(node, timeout_sec=0.02)
    depth_m = min((seconds(newest["/UR5/measured_cp"]) - begun_s) * feed_m_per_s, insertion_m)
    goal = PoseStamped()
    goal.header.frame_id = "world"
    goal.pose.orientation = start.pose.orientation
    goal.pose.position.x, goal.pose.position.y, goal.pose.position.z = map(float, origin + depth_m * along)
    servo_cp.publish(goal)
    servo_jf.publish(JointState(effort=[tension_n * depth_m / insertion_m] + [0.0] * (tendons - 1)))
    burr.publish(JointState(name=["burr"], velocity=[838.0]))
    return depth_m >= insertion_m


last = None
until("feed", lambda: (count["/UR5/measured_cp"] != last) and drill())
settled_s = seconds(newest["/UR5/measured_cp"]) + 0.5
until("rest", lambda: drill() and seconds(newest["/UR5/measured_cp"]) > settled_s)
tool, tip = newest["/UR5/measured_cp"].pose, newest["/CM/measured_cp"].pose
image = newest.get("/c_arm/image_raw")
print(json.dumps({
    "nodes": nodes,
    "joints": newest["/UR5/measured_js"].name,
    "inserted_m": float((place(tool) - origin) @ along),
    "bend_deg": float(np.degrees(np.arccos(np.clip(axis(tip) @ axis(tool), -1.0, 1.0)))),
    "tension_n": list(newest["/CM/bend_motor/measured_js"].effort),
    "removed": newest["/removed_voxels"].data,
    "description": newest["/robot_description"].data[:60],
    "image": None if image is None else [image.encoding, image.height, image.width, len(image.data)],
    "images": count.get("/c_arm/image_raw", 0),
    "states": count["/UR5/measured_js"],
}))
rclpy.shutdown()
