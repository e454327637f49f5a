"""A robot with two models: a slow planner chooses a subtask once a second, and a fast policy moves
the arm ten times a second.

Each model is a deployment with its own sessions. Both models are scripted here, and take as long as
real models. In the folder of this file, in two terminals:

    vlagents-ray serve two_models.yaml
    python two_models.py http://localhost:8000

docs/fleet.md explains what happens if a model is late or not available.
"""

import sys
import time

import numpy as np

from vlagents_ray import (
    Act,
    ActionSpec,
    Agent,
    ChunkPlayer,
    Contract,
    PlayerSettings,
    RemoteAgent,
    StateSpec,
)
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.robot import RobotWithPlanner, run_loop
from vlagents_ray.robot.simulated import SimulatedRobot

TASK = "put the cup away"
SUBTASKS = {  # subtask -> pose in which it is done, rad
    "reach over the cup": [0.6, 0.3, 0.0],
    "lower the hand": [0.6, 0.3, -0.4],
    "lift the cup": [0.6, 0.6, 0.0],
    "carry it to the shelf": [-0.6, 0.6, 0.0],
}
ROWS = 10  # number of rows of the policy's chunks
STEP = 0.06  # motion of a joint in a row, rad
CONTRACT = Contract(
    state={"joints": StateSpec(3, "rad")},
    action=ActionSpec(dim=3, space="joint_position", delta=False),
)


class Planner(Agent):
    """Checks whether the subtask is done, and answers with the current subtask: its words, and its
    pose as the action.
    """

    contract = CONTRACT

    def __init__(self, thinks_s=0.3):
        self.thinks_s = thinks_s

    def reset(self, obs, instruction, **kwargs):
        self.subtasks = list(SUBTASKS)
        return {}

    def act(self, obs):
        time.sleep(self.thinks_s)
        is_done = np.abs(obs.state["joints"] - SUBTASKS[self.subtasks[0]]).max() < 0.02
        task_done = is_done and len(self.subtasks) == 1
        if is_done and not task_done:
            self.subtasks.pop(0)
        subtask = self.subtasks[0]
        pose = np.array(SUBTASKS[subtask], np.float32)
        return Act(pose, done=bool(task_done), info={"subtask": subtask})


class Reach(Agent):
    """Moves all joints in chunks towards the planner's pose."""

    contract = CONTRACT

    def __init__(self, thinks_s=0.04):
        self.thinks_s = thinks_s

    def act(self, obs):
        if "goal" not in obs.info:
            raise InvalidObservation(
                "info['goal']: expected the pose of a planner, got none; drive a RobotWithPlanner"
            )
        time.sleep(self.thinks_s)
        joints, goal = obs.state["joints"], obs.info["goal"]
        reach = STEP * np.arange(1, ROWS + 1)[:, np.newaxis]  # (ROWS, 1), rad
        return Act((joints + np.clip(goal - joints, -reach, reach)).astype(np.float32))


def main(url):
    """Perform the task, and print how many ticks of both models were in time."""
    # Replace it with your arm: observe() -> Obs, apply(action), stop().
    arm = SimulatedRobot(CONTRACT)
    planner = RemoteAgent(f"{url}/planner", timeout_s=5)
    policy = RemoteAgent(f"{url}/policy", timeout_s=5)
    with (
        # Each observation contains the newest subtask. The robot holds still while the subtask is
        # older than 3 s.
        RobotWithPlanner(arm, planner, instruction=TASK, hz=1, max_age_s=3) as robot,
        ChunkPlayer(policy, PlayerSettings(mode="async")) as player,
    ):
        report = run_loop(
            robot, player, hz=10, seconds=40, until=lambda: robot.task_done, instruction=TASK
        )

    print(f"{TASK}: {'done' if robot.task_done else 'not done'}")
    for model, timeliness in (("policy", report.timeliness), ("planner", robot.planner_timeliness)):
        figures = timeliness.time_share
        if figures.share is not None:
            print(f"{model}: {figures.share:.1%} of {figures.ticks} ticks in time")
    print(f"held for: {report.reasons or 'nothing'}")


if __name__ == "__main__":
    main(sys.argv[1])
