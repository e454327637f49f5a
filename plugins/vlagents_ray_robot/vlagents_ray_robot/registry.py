"""The entries that this distribution registers, one for each robot and command."""

from vlagents_ray.registry import RegistryEntry

MUJOCO = RegistryEntry(
    "vlagents_ray_robot.mujoco_arm:MujocoArm",
    "arms in MuJoCo: so101, franka, aloha, ur5e, xarm7, or the path of an MJCF or URDF file",
    needs=("mujoco",),
    extra="arms",
    tasks=":<arm>",
)

LEROBOT = RegistryEntry(
    "vlagents_ray_robot.lerobot_robot:LeRobotRobot",
    "any robot that LeRobot drives, such as so101_follower",
    needs=("lerobot",),
    requirements=("lerobot",),
    tasks=":<type>",
)

ROS = RegistryEntry(
    "vlagents_ray_robot.ros:RosRobot",
    "a robot behind topics of ROS 2, which a YAML file names",
    needs=("yaml",),
    extra="ros",
    tasks=":<file>",
)

CHECK = RegistryEntry(
    "vlagents_ray_robot.check_command:main",
    "Check a robot before a policy moves it.",
)
