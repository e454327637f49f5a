"""A robot behind topics of ROS 2, through rclpy or through a rosbridge; see docs/ros.md."""

from vlagents_ray_robot.ros.robot import RosRobot, RosSettings, read_settings

__all__ = ["RosRobot", "RosSettings", "read_settings"]
