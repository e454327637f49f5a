"""Third-party programs, started as their users start them: `program_clients.py PROGRAM PORT`, with
the program's Python.

Each function runs one program with constant pictures. It prints as JSON the "executed" rows of the
robot, and the input that a policy should have received, in this package's terms: "state" by name,
"gripper" (1 is open) and "cameras". The script imports nothing of this package.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

TASK = "lift the cup"
STEPS = 8
Said = dict[str, Any]


def picture(step: int, height: int = 224, width: int = 224) -> np.ndarray:
    return np.full((height, width, 3), 16 * (step + 1), np.uint8)


def numbers(dim: int) -> np.ndarray:
    """Return a state whose numbers float32 represents exactly."""
    return np.arange(1, dim + 1) / 32


def said(executed: Any, cameras: Sequence[str], gripper: float | None = None, **state: Any) -> Said:
    plain = {name: np.asarray(part).tolist() for name, part in state.items()}
    return {
        "executed": np.asarray(executed).tolist(),
        "cameras": list(cameras),
        "gripper": gripper,
        "state": plain,
    }


# Inspect Robots: its evaluation, with the policy of a plug-in, and with an embodiment that has the
# plug-in's own spaces.


def _inspect_robots(policy: Any) -> np.ndarray:
    """Return the actions that the embodiment executed in one episode of an evaluation."""
    import inspect_robots as ir

    executed: list[np.ndarray] = []

    class Pictures(ir.EmbodimentBase):
        info = ir.EmbodimentInfo(
            "pictures", policy.info.action_space, policy.info.observation_space, is_simulated=True
        )

        def look(self) -> Any:
            space = self.info.observation_space
            cameras = {
                one.name: picture(len(executed), one.height, one.width) for one in space.cameras
            }
            fields = () if space.state is None else space.state.fields
            return ir.Observation(cameras, {one.key: numbers(one.shape[0]) for one in fields}, TASK)

        def reset(self, scene: Any, *, seed: int | None = None) -> Any:
            return self.look()

        def step(self, action: Any) -> Any:
            executed.append(np.asarray(action.data))
            over = len(executed) == STEPS
            return ir.StepResult(
                self.look(), terminated=over, termination_reason="success" if over else None
            )

    task = ir.Task("look", [ir.Scene("one", TASK)], "success_at_end", max_steps=STEPS + 1)
    with tempfile.TemporaryDirectory() as folder:
        [log] = ir.eval(task, policy, Pictures(), log_dir=folder, fail_on_error=True)
    if log.status != "success":
        raise RuntimeError(f"the evaluation ended with {log.status}: {log}")
    return np.stack(executed)


def franka(port: int) -> Said:
    from inspect_robots_franka import OpenpiPolicy

    state = numbers(8)
    return said(
        _inspect_robots(OpenpiPolicy(port=port, actions_are_velocity=False)),
        ["front", "wrist"],
        state[7],
        joints=state[:7],
    )


def widowx_openpi(port: int) -> Said:
    from inspect_robots_widowx.policy import OpenpiPolicy

    return said(_inspect_robots(OpenpiPolicy(port=port)), ["front"])


def widowx_openvla(port: int) -> Said:
    from inspect_robots_widowx.policy import OpenVLAPolicy

    return said(_inspect_robots(OpenVLAPolicy(server_url=f"http://127.0.0.1:{port}")), ["front"])


def agibot_openpi(port: int) -> Said:
    from inspect_robots_agibot_a2.policy import OpenpiPolicy

    return said(
        _inspect_robots(OpenpiPolicy(port=port)), ["front", "left", "right"], joints=numbers(16)
    )


def agibot_go1(port: int) -> Said:
    from inspect_robots_agibot_a2.policy import Go1Policy

    policy = Go1Policy(server_url=f"http://127.0.0.1:{port}")
    return said(_inspect_robots(policy), ["front", "left", "right"], joints=numbers(16))


def yam(port: int) -> Said:
    from inspect_robots_yam.policy import ActServerPolicy

    policy = ActServerPolicy(server_url=f"http://127.0.0.1:{port}")
    return said(_inspect_robots(policy), ["front", "left", "right"], joints=numbers(14))


def unitree_g1(port: int) -> Said:
    from inspect_robots_unitree_g1.policy import Gr00tPolicy

    state = numbers(16)
    legs = {"left_leg": numbers(6), "right_leg": numbers(6), "waist": numbers(3)}
    executed = _inspect_robots(Gr00tPolicy(port=port))
    return said(executed, ["ego_view"], left_arm=state[:7], right_arm=state[8:15], **legs)


def xpolicylab(port: int) -> Said:
    from inspect_robots_xpolicylab.policy import XPolicyLabPolicy

    policy = XPolicyLabPolicy(
        url=f"ws://127.0.0.1:{port}/xpolicylab",
        arms=2,
        arm_dim=6,
        cameras={"cam_head": "base"},
        camera_height=64,
        camera_width=64,
        required_state_keys=(),
    )
    return said(_inspect_robots(policy), ["front"])


# Other programs


def strands_robots(port: int) -> Said:
    """Run its policy for servers of Cosmos 3, which use openpi's protocol with another name for the
    actions.
    """
    from strands_robots.policies import create_policy

    policy = create_policy("cosmos3", host="127.0.0.1", port=port)
    views = ("exterior_image_1_left", "exterior_image_2_left", "wrist_image_left")
    columns = [*(f"joint_{i}" for i in range(7)), "gripper"]

    def act(step: int) -> list[list[float]]:
        seen = {f"observation/{view}": picture(step) for view in views} | {
            "observation.state": numbers(8)
        }
        return [[row[name] for name in columns] for row in policy.get_actions_sync(seen, TASK)]

    state = numbers(8)
    rows = np.asarray(_acts(act))
    # In DROID and in this program's robot, gripper 1 is closed.
    rows[:, 7] = 1 - rows[:, 7]
    return said(rows, ["front", "wrist"], 1 - state[7], joints=state[:7])


def strands_robots_sim(port: int) -> Said:
    """Run its client of GR00T N1.5. Its LIBERO robot rounds the gripper to -1 or 1, so that column
    is left out.
    """
    import asyncio

    from strands_robots_sim.policies.groot import Gr00tPolicy

    policy = Gr00tPolicy("libero", host="127.0.0.1", port=port)
    position = numbers(3)

    def act(step: int) -> list[list[float]]:
        seen = {"front_camera": picture(step, 256, 256), "wrist_camera": picture(step, 256, 256)}
        pose = {"robot0_eef_pos": position, "robot0_eef_quat": np.array([0.0, 0.0, 0.0, 1.0])}
        rows = asyncio.run(policy.get_actions(seen | pose, TASK))
        return [row["action"][:6] for row in rows]

    return said(
        _acts(act), ["image", "wrist_image"], x=position[:1], y=position[1:2], z=position[2:]
    )


def positronic(port: int) -> Said:
    """Run its client of RoboArena's protocol with the observations of its DROID codec, which
    numbers cameras from 1.
    """
    from positronic.offboard.roboarena import RoboarenaClient

    client = RoboarenaClient("127.0.0.1", port)
    config = client.connect()
    if (config["action_space"], config["n_external_cameras"]) != ("joint_position", 1):
        raise RuntimeError(f"config: {config}")
    state = numbers(8)

    def act(step: int) -> Any:
        seen = {
            "observation/exterior_image_1_left": picture(step),
            "observation/wrist_image_left": picture(step),
        }
        seen |= {
            "observation/joint_position": state[:7],
            "observation/gripper_position": 1 - state[7:],
        }
        return client.infer({**seen, "prompt": TASK})["actions"]

    rows = np.array(_acts(act))
    client.reset()
    client.close()
    rows[:, 7] = 1 - rows[:, 7]  # in DROID, gripper 1 is closed
    return said(rows, ["front", "wrist"], state[7], joints=state[:7])


def provael(port: int) -> Said:
    """Run its policy for openpi's servers, which executes the first row of each chunk and has no
    convention for the gripper.
    """
    from provael.policies.openpi_adapter import OpenPiAdapter

    policy = OpenPiAdapter(host="127.0.0.1", port=port)
    policy.load()
    state = np.array([*numbers(6), 0.02, -0.02])

    def act(step: int) -> Any:
        seen = {"image": picture(step), "wrist_image": picture(step), "state": state}
        return [np.asarray(policy.act(seen, TASK))[:6]]

    return said(
        _acts(act), ["front", "wrist"], 0.5, xyz_axis_angle=state[:6], gripper_qpos=state[6:]
    )


def _acts(act: Callable[[int], Any]) -> list[Any]:
    """Return the rows of all chunks that an episode of `STEPS` steps needs."""
    rows: list[Any] = []
    while len(rows) < STEPS:
        rows += list(act(len(rows)))
    return rows


if __name__ == "__main__":
    print(json.dumps(globals()[sys.argv[1]](int(sys.argv[2]))))
