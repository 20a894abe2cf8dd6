"""A hand behind ros2_control's topics, in a process of its own: python ros2_hand.py; lines in, lines out."""

from __future__ import annotations

import json
import sys
import threading

from torch_ekm.testing import Motors


def serve(motors: Motors, names: list[str], answer=None) -> None:
    """Publish ``/joint_states`` at 100 Hz, follow one-point trajectories; answer lines of stdin."""
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from rclpy.executors import SingleThreadedExecutor
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory

    context = rclpy.Context()
    context.init(args=[])
    node = rclpy.create_node("hand", context=context)
    states = node.create_publisher(JointState, "/joint_states", 1)
    poses = node.create_publisher(PoseStamped, "/object", 1)
    goals: list[list[float]] = []
    spoil: list[str] = []

    def follow(message: JointTrajectory) -> None:
        at = dict(zip(message.joint_names, message.points[0].positions, strict=True))
        goals.append([at[name] for name in names])
        motors.send(goals[-1])

    node.create_subscription(JointTrajectory, "/hand/joint_trajectory", follow, 10)

    def publish() -> None:
        message = JointState(name=list(names), position=[float(x) for x in motors.now()])
        message.velocity = [1.0 if motors.moving else 0.0] * len(names)
        message.header.stamp = node.get_clock().now().to_msg()
        if "old" in spoil:
            message.header.stamp.sec -= 5
        if "nan" in spoil:
            message.position[0] = float("nan")
        if "name" in spoil:
            message.name[0] = "other"
        if "short" in spoil:
            message.position = message.position[:-1]
        if "nothing" not in spoil:
            states.publish(message)
        pose = PoseStamped()
        pose.header.stamp, pose.header.frame_id = message.header.stamp, "camera"
        pose.pose.position.y, pose.pose.orientation.w = 0.1, 1.0
        poses.publish(pose)

    node.create_timer(0.01, publish)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    print("ready", flush=True)
    for line in sys.stdin:
        word = line.strip()
        if word.startswith("spoil "):
            spoil[:] = word.split()[1:]
            print("ok", flush=True)
        elif answer is not None and word not in ("now", "goals"):
            print(json.dumps(answer(word)), flush=True)
        else:
            print(json.dumps(goals if word == "goals" else [motors.now(), motors.moving]), flush=True)


if __name__ == "__main__":
    serve(Motors([0.3, 0.3], float(sys.argv[1])), ["left_motor", "right_motor"])
