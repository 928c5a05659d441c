"""A CRTK program: curved drilling through ROS 2 alone. Uses arm, bend motor and burr through CRTK's topics only.

    python crtk_drilling.py INSERTION_M FEED_M_PER_S TENSION_N [CT DRILLED]

Feeds the arm along the tool's axis with `servo_cp`, pulls the tendon with `servo_jf` as the tool goes in, and prints
its measurements. Rebuilds the drilled CT from the clouds of removed voxels: CT and DRILLED are files of int16, x
fastest, before and after.
"""

import json
import sys
import time

import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image, JointState, PointCloud2
from std_msgs.msg import Float64MultiArray, String, UInt64
from visualization_msgs.msg import Marker

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
listen(PointStamped, "/c_arm/burr_tip")
# Subscribed to from the start: one that joins later misses the first X-rays.
tips = []
node.create_subscription(PointStamped, "/c_arm/burr_tip", tips.append, QoSProfile(depth=100))
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
listen(String, "/robot_description", latched)
listen(PoseStamped, "/anatomy/pose", latched)
listen(Float64MultiArray, "/anatomy/voxels", latched)
listen(Marker, "/anatomy/surface", latched)


class Removed:
    """Voxels removed according to the clouds, by their index in the CT, with their places."""

    def __init__(self):
        self.places, self.largest, self.stamp_s = {}, 0, 0.0
        node.create_subscription(PointCloud2, "/removed_voxels/points", self.take, QoSProfile(depth=1000))

    def take(self, cloud):
        self.largest = max(self.largest, len(cloud.data))
        fields = [(field.name, field.offset, field.datatype) for field in cloud.fields]
        assert fields == [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("index", 12, 6)], fields
        points = np.frombuffer(cloud.data, dtype=[("at", "<f4", 3), ("index", "<u4")])
        if len(points) == 0:
            self.places.clear()
        self.stamp_s = seconds(cloud)
        self.places.update(zip(points["index"].tolist(), points["at"]))


removed = Removed()
servo_cp = node.create_publisher(PoseStamped, "/UR5/servo_cp", 10)
take = node.create_publisher(PoseStamped, "/c_arm/take", 10)
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
for stopped_s in (0.5, 1.0):
    # The burr stands: nothing more is removed, and the last clouds are on their way.
    burr.publish(JointState(name=["burr"], velocity=[0.0]))
    until("standing", lambda: seconds(newest["/UR5/measured_cp"]) > settled_s + stopped_s)
predrilled = len(removed.places) - newest["/removed_voxels"].data
# A late subscriber gets everything so far.
late = Removed()
until("all clouds", lambda: len(late.places) >= len(removed.places))
grid = newest["/anatomy/voxels"].data
counts, sizes_m = np.array(grid[:3]).astype(int), np.array(grid[3:])
index = np.array(sorted(removed.places))
local = np.stack([index % counts[0], index // counts[0] % counts[1], index // (counts[0] * counts[1])], 1) * sizes_m
pose = newest["/anatomy/pose"].pose
w, v = pose.orientation.w, np.array([pose.orientation.x, pose.orientation.y, pose.orientation.z])
turned = local + 2.0 * np.cross(v, np.cross(v, local) + w * local)
off_m = np.abs(turned + place(pose) - np.array([removed.places[one] for one in index.tolist()])).max()
if len(sys.argv) > 5:
    ct = np.fromfile(sys.argv[4], "<i2")
    assert len(ct) == counts.prod(), (len(ct), counts)
    ct[index] = -1000
    ct.tofile(sys.argv[5])
until("surface", lambda: "/anatomy/surface" in newest)
until("surface after the last removal", lambda: seconds(newest["/anatomy/surface"]) >= removed.stamp_s > 0.0)
surface = newest["/anatomy/surface"]
# An X-ray along the patient's y with the isocentre at the tip shows the tip in its middle.
from_behind = PoseStamped(pose=newest["/CM/measured_cp"].pose)
half = float(np.sqrt(0.5))
turn = from_behind.pose.orientation
turn.x, turn.y, turn.z, turn.w = -half, 0.0, 0.0, half


def off_centre_px():
    shown, at = newest["/c_arm/image_raw"], newest["/c_arm/burr_tip"].point
    return float(np.hypot(at.x - (shown.width - 1) / 2, at.y - (shown.height - 1) / 2))


before_px = off_centre_px()
take.publish(from_behind)
until("X-ray of the tip", lambda: off_centre_px() < 1.0)
centred_px = off_centre_px()
# Twenty, five at a time: each comes, with the tip at a place of its own right of the middle, or is refused.
# The scene's own X-rays show it on the left, the one above in the middle.
places_px, changed_s, middle_px = set(), 0.0, (newest["/c_arm/image_raw"].width - 1) / 2
tips.clear()
for number in range(1, 21):
    from_behind.pose.position.x += 2e-3
    take.publish(from_behind)
    if number % 5 == 0:
        time.sleep(0.02)


def is_quiet():
    """Whether no X-ray of a new place has come for 5 s."""
    global changed_s
    now_s, known = seconds(newest["/UR5/measured_cp"]), len(places_px)
    places_px.update(px for tip in tips if (px := round(tip.point.x - middle_px)) > 3)
    changed_s = now_s if len(places_px) > known or changed_s == 0.0 else changed_s
    return now_s > changed_s + 5.0


until("last X-ray", is_quiet)
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
    "predrilled": predrilled,
    "off_centre_px": [before_px, centred_px],
    "places_px": sorted(places_px),
    "late_equals": late.places.keys() == removed.places.keys(),
    "largest_cloud": removed.largest,
    "off_m": float(off_m),
    "surface": [surface.type, len(surface.points), surface.header.frame_id],
}))
rclpy.shutdown()
