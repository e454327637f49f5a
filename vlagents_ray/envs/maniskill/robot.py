"""The state of a ManiSkill robot, and the meaning of its control modes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, StateSpec

# Where a finger's joint stands when closed and when open, in metres, by ManiSkill's name of the robot. In the
# action, their controllers take the last component as -1 closed, 1 open. Other robots state no gripper.
_FINGER_M = {
    "panda": (0.0, 0.04),
    "panda_wristcam": (0.0, 0.04),
    "widowx250s_bridgedataset_flat_table": (0.015, 0.037),
    "widowx250s_bridgedataset_sink": (0.015, 0.037),
}
_TOOL_LINK = "ee_gripper_link"  # of robots for which ManiSkill names no tool centre point

# The part of the action that moves the arm, as written in mani_skill/agents/controllers. The
# rotation of "pd_ee_*pose" is intrinsic XYZ Euler in the base frame; see `ManiSkill` for its sign.
_EE_POSE = {"space": "ee_pose", "rotation": "euler_xyz", "frame": "base"}
_EE_POSITION = {"space": "ee_position", "rotation": "none", "frame": "base"}
_JOINT: dict[str, Any] = {"space": "joint", "rotation": "none"}
CONTROL_MODES: dict[str, dict[str, Any]] = {
    "pd_ee_delta_pose": {**_EE_POSE, "delta": True},
    "pd_ee_target_delta_pose": {**_EE_POSE, "delta": True},
    "pd_ee_pose": {**_EE_POSE, "delta": False},
    "pd_ee_delta_pos": {**_EE_POSITION, "delta": True},
    "pd_ee_target_delta_pos": {**_EE_POSITION, "delta": True},
    "pd_joint_pos": {**_JOINT, "delta": False},
    "pd_joint_delta_pos": {**_JOINT, "delta": True},
    "pd_joint_target_delta_pos": {**_JOINT, "delta": True},
    "pd_joint_vel": {"space": "joint_velocity", "rotation": "none"},
}


class ManiSkillRobot:
    """Reads proprioception from ManiSkill's `agent`, which is a new object after each reconfiguration."""

    def __init__(self, agent: Any) -> None:
        names = [joint.name for joint in agent.robot.active_joints]
        arm = getattr(agent, "arm_joint_names", names)
        self._arm = np.array([names.index(name) for name in arm])
        self._finger_m = _FINGER_M.get(agent.uid)
        self._fingers = np.array([names.index(name) for name in getattr(agent, "gripper_joint_names", ())], dtype=int)
        self._has_tool = _tool(agent) is not None

    @property
    def gives(self) -> dict[str, StateSpec]:
        """The parts of the state that `read` fills."""
        parts = {"joints": StateSpec(dim=len(self._arm), unit="rad")}
        if self._has_tool:
            parts["tquat"] = StateSpec(dim=7, unit="m+quat_xyzw")
            parts["xyzrpy"] = StateSpec(dim=6, unit="m+rad")
        return parts

    @property
    def has_gripper(self) -> bool:
        """Whether the opening of the gripper is known."""
        return self._finger_m is not None

    def read(self, agent: Any) -> list[tuple[dict[str, np.ndarray], float | None]]:
        """Return the state of each environment, each part (D,) float32, and the gripper in [0, 1], 1 = open."""
        rows = agent.robot.get_qpos().cpu().numpy()
        states = [{"joints": qpos[self._arm]} for qpos in rows]
        if self._has_tool:
            bases = agent.robot.pose.raw_pose.cpu().numpy()
            tools = _tool(agent).pose.raw_pose.cpu().numpy()
            for state, base, tool in zip(states, bases, tools, strict=True):
                state["tquat"], state["xyzrpy"] = tool_in_base(base, tool)
        return [(state, self._opening(qpos)) for state, qpos in zip(states, rows, strict=True)]

    def _opening(self, qpos: np.ndarray) -> float | None:
        if self._finger_m is None:
            return None
        closed, opened = self._finger_m
        opening = (float(qpos[self._fingers].mean()) - closed) / (opened - closed)
        return min(max(opening, 0.0), 1.0)


def _tool(agent: Any) -> Any:
    """The link whose pose is the tool's; None if there is none."""
    tcp = getattr(agent, "tcp", None)
    return agent.robot.links_map.get(_TOOL_LINK) if tcp is None else tcp


def action_spec(control_mode: str, space: Any, *, has_gripper: bool) -> ActionSpec:
    """The contract of a control mode; `space` is its Gymnasium box, (D,)."""
    normalized = bool((space.low == -1.0).all() and (space.high == 1.0).all())
    return ActionSpec(
        dim=int(space.shape[0]),
        gripper_open=1.0 if has_gripper else None,
        gripper_closed=-1.0 if has_gripper else None,
        low=-1.0 if normalized else None,
        high=1.0 if normalized else None,
        **CONTROL_MODES.get(control_mode, {}),
    )


_LOCKED = 1e-4  # of the cosine of a pitch


def tool_in_base(base: np.ndarray, tool: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two (7,) world poses, metres and quaternion wxyz, as SAPIEN writes them, to the tool's pose in the base frame.

    Returns `tquat` (7,), metres and quaternion xyzw with w >= 0, and `xyzrpy` (6,), metres and
    radians, where R = Rz(yaw) Ry(pitch) Rx(roll); both float32.
    """
    bw, bx, by, bz = (float(v) for v in base[3:])
    tw, tx, ty, tz = (float(v) for v in tool[3:])
    # conj(base) * tool
    w = bw * tw + bx * tx + by * ty + bz * tz
    x = bw * tx - bx * tw - by * tz + bz * ty
    y = bw * ty + bx * tz - by * tw - bz * tx
    z = bw * tz - bx * ty + by * tx - bz * tw
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    px, py, pz = (float(t - b) for t, b in zip(tool[:3], base[:3], strict=True))
    # the offset turned by conj(base): v + 2 u x (u x v - bw v) with u the base's vector part
    cx, cy, cz = by * pz - bz * py - bw * px, bz * px - bx * pz - bw * py, bx * py - by * px - bw * pz
    px, py, pz = px + 2 * (by * cz - bz * cy), py + 2 * (bz * cx - bx * cz), pz + 2 * (bx * cy - by * cx)
    rolls = 2 * (w * x + y * z), 1 - 2 * (x * x + y * y)  # the sine and the cosine of it, times the pitch's cosine
    pitch = math.asin(min(max(2 * (w * y - z * x), -1.0), 1.0))
    if math.hypot(*rolls) < _LOCKED:  # gimbal lock: only the sum or the difference of roll and yaw is determined
        roll, yaw = 0.0, math.copysign(2.0, -pitch) * math.atan2(x, w)
        yaw = math.remainder(yaw, 2 * math.pi)
    else:
        roll, yaw = math.atan2(*rolls), math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    tquat = np.array([px, py, pz, x, y, z, w], dtype=np.float32)
    return tquat, np.array([px, py, pz, roll, pitch, yaw], dtype=np.float32)
