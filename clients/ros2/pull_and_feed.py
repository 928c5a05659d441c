"""Feeds the tool 5 mm along its axis and pulls the tendon to 5 N, using only ROS 2: needs a shell with ROS 2
sourced, and no package of Trabecula.
"""
import rclpy
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState

rclpy.init()
node = rclpy.create_node("pull_and_feed")
feed = node.create_publisher(PoseStamped, "/UR5/servo_cp", 10)
pull = node.create_publisher(JointState, "/CM/bend_motor/servo_jf", 10)
first = []

def step(measured):
    first.append(measured) if not first else None
    begin, now = first[0].header.stamp, measured.header.stamp
    t = now.sec - begin.sec + 1e-9 * (now.nanosec - begin.nanosec)
    q, p, depth = first[0].pose.orientation, first[0].pose.position, min(0.002 * t, 0.005)
    goal = PoseStamped()
    goal.header.frame_id, goal.pose.orientation = "world", q
    goal.pose.position.x = p.x + depth * 2 * (q.x * q.z + q.w * q.y)    # +z of the tool's base
    goal.pose.position.y = p.y + depth * 2 * (q.y * q.z - q.w * q.x)
    goal.pose.position.z = p.z + depth * (1 - 2 * (q.x**2 + q.y**2))
    feed.publish(goal)
    pull.publish(JointState(effort=[min(5.0, 2.0 * t), 0.0]))

node.create_subscription(PoseStamped, "/UR5/measured_cp", step, 10)
rclpy.spin(node)
