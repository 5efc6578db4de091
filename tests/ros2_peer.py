"""A node of real ROS 2 (rclpy), run by the Python that has it; prints what it found as JSON. For test_ros2.py.

python ros2_peer.py hear|fly|release|pipeline <domain>
"""

import json
import sys
import time

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float32MultiArray, Int32, Int64
from visualization_msgs.msg import MarkerArray

WAIT = 150.0  # [s] for the other side to start
HEARD = {
    "/payload/odom": Odometry, "/drone_0/odom": Odometry, "/target": PoseStamped, "/drone_0/reference": PoseStamped,
    "/cables": JointState, "/markers": MarkerArray, "/drone_0/action": Float32MultiArray,
}  # fmt: skip


def spin(node, done, seconds=WAIT):
    """Spin until done() or the time is over; return whether it is done."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and not done():
        rclpy.spin_once(node, timeout_sec=0.05)
    return done()


def stamp(message):
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def place(message):
    at = message.pose.pose.position
    return [at.x, at.y, at.z]


def hear(node):
    """Subscribe to everything, by default QoS, and with some as sensor data; look at the graph; come late to /scene."""
    heard = {name: [] for name in HEARD}
    for name, kind in HEARD.items():
        node.create_subscription(kind, name, heard[name].append, 10)
    best_effort = []
    node.create_subscription(Odometry, "/payload/odom", best_effort.append, qos_profile_sensor_data)
    complete = spin(node, lambda: all(len(messages) >= 50 for messages in heard.values()) and len(best_effort) >= 50)
    scenes = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)
    node.create_subscription(MarkerArray, "/scene", scenes.append, latched)
    spin(node, lambda: bool(scenes), 10.0)
    clock = node.get_clock().now().nanoseconds * 1e-9
    graph = {}
    for name in HEARD:
        (published,) = node.get_publishers_info_by_topic(name)
        own = node.get_subscriptions_info_by_topic(name)[0]
        graph[name] = {
            "type": published.topic_type, "own type": own.topic_type, "hash": str(published.topic_type_hash),
            "own hash": str(own.topic_type_hash), "reliability": published.qos_profile.reliability.name,
            "durability": published.qos_profile.durability.name,
        }  # fmt: skip
    (scene,) = node.get_publishers_info_by_topic("/scene")
    odometry = heard["/payload/odom"]
    return {
        "complete": complete, "counts": {name: len(messages) for name, messages in heard.items()},
        "best effort": len(best_effort), "scenes": len(scenes), "markers": len(scenes[0].markers) if scenes else 0,
        "scene": scene.qos_profile.durability.name, "graph": graph, "clock": clock,
        "stamps": [stamp(message) for message in odometry], "places": [place(message) for message in odometry],
        "tensions": [list(message.effort) for message in heard["/cables"]],
        "frames": [odometry[-1].header.frame_id, odometry[-1].child_frame_id] if odometry else [],
        "actions": list(heard["/drone_0/action"][-1].data) if heard["/drone_0/action"] else [],
    }  # fmt: skip


def fly(node):
    """Send each drone 0.3 m up from where it was first heard, at 50 Hz of simulation time; return heights."""
    drones, first, latest = 2, {}, {}
    senders = [node.create_publisher(PoseStamped, f"/drone_{i}/setpoint", 10) for i in range(drones)]
    payload = []

    def note(message, i):
        first.setdefault(i, message)
        latest[i] = message
        if len(first) == drones and stamp(message) - stamp(first[i]) > 0.02:
            pose = PoseStamped(header=message.header, pose=first[i].pose.pose)
            pose.pose.position.z = heights[i] + 0.3
            senders[i].publish(pose)

    heights = {}
    for i in range(drones):
        node.create_subscription(
            Odometry, f"/drone_{i}/odom",
            lambda message, i=i: (heights.setdefault(i, message.pose.pose.position.z), note(message, i)), 10,
        )  # fmt: skip
    node.create_subscription(Odometry, "/payload/odom", payload.append, 10)
    done = spin(node, lambda: len(payload) > 1 and stamp(payload[-1]) - stamp(payload[0]) > 4.0)
    return {
        "complete": done, "before": heights, "payload": [place(payload[0])[2], place(payload[-1])[2]],
        "after": {i: message.pose.pose.position.z for i, message in latest.items()},
    }  # fmt: skip


def release(node):
    """Let a policy node begin by /fly once it is there, and hear its set-points."""
    flown, waiting = [], []
    node.create_subscription(PoseStamped, "/drone_0/setpoint", flown.append, 10)
    node.create_subscription(Odometry, "/payload/odom", waiting.append, 10)
    ready = spin(node, lambda: len(flown) > 20 and len(waiting) > 20)
    still = [message.pose.position.z for message in flown[-10:]]
    sender, target = node.create_publisher(Bool, "/fly", 10), []
    node.create_subscription(PoseStamped, "/target", target.append, 10)
    spin(node, lambda: sender.get_subscription_count() > 0, 10.0)
    sender.publish(Bool(data=True))
    count = len(flown)

    def off():
        """Return how far the payload was from its target at most in the last 50 messages [m]."""
        goal = target[-1].pose.position
        places = [message.pose.pose.position for message in waiting[-50:]]
        return max(((at.x - goal.x) ** 2 + (at.y - goal.y) ** 2 + (at.z - goal.z) ** 2) ** 0.5 for at in places)

    done = spin(node, lambda: len(flown) > count + 250 and target and off() < 0.15, 2 * WAIT)
    return {"ready": ready, "complete": bool(done), "still": still, "off": off() if target else None}


def pipeline(node):
    """Hear the pipeline of the report's names, by its QoS; come late to the planned path and to the clock."""
    flown, stages, poses = [], [], []
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_subscription(Odometry, "/payload_odom", flown.append, best_effort)
    node.create_subscription(PoseStamped, "/simulation/position_drone_2", poses.append, best_effort)
    node.create_subscription(Int32, "/state/state_drone_1", stages.append, 10)
    # 3 s of the flight, in which the nodes have begun
    complete = spin(node, lambda: len(flown) > 1 and stamp(flown[-1]) - stamp(flown[0]) > 3.0 and poses and stages)
    paths, times = [], []
    late = DurabilityPolicy.TRANSIENT_LOCAL
    reliable = QoSProfile(depth=1, durability=late, reliability=ReliabilityPolicy.RELIABLE)
    node.create_subscription(Path, "/path", paths.append, reliable)
    clock = QoSProfile(depth=1, durability=late, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_subscription(Int64, "/sync_time", lambda message: times.append(message.data), clock)
    spin(node, lambda: paths and len(times) > 30, 15.0)
    (published,) = node.get_publishers_info_by_topic("/sync_time")
    target = paths[0].poses[-1].pose.position if paths else None
    at = flown[-1].pose.pose.position
    return {
        "complete": bool(complete), "stages": sorted({message.data for message in stages}), "times": times,
        "off": [at.x - target.x, at.y - target.y, at.z - target.z] if target else [],
        "frame": paths[0].header.frame_id if paths else "", "stamp": stamp(flown[-1]),
        "qos": [published.qos_profile.reliability.name, published.qos_profile.durability.name],
    }  # fmt: skip


def main():
    role, domain = sys.argv[1], int(sys.argv[2])
    rclpy.init(domain_id=domain)
    node = Node("peer", parameter_overrides=[Parameter("use_sim_time", value=True)])
    print(json.dumps({"hear": hear, "fly": fly, "release": release, "pipeline": pipeline}[role](node)))
    node.destroy_node()
    rclpy.shutdown()


main()
