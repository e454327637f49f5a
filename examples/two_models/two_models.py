"""A robot with two models: a slow planner chooses a subtask once a second, and a fast policy moves
the arm ten times a second.

Each model is a deployment with its own sessions. Both models are scripted here, and take as long as
real models. In the folder of this file, in two terminals:

    vlagents-ray serve two_models.yaml
    python two_models.py http://localhost:8000

The planner is part of the robot, like a slow sensor: each observation contains its newest answer.
So only the policy moves the robot.
"""

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from vlagents_ray import (
    Act,
    ActionSpec,
    Agent,
    ChunkPlayer,
    Contract,
    RemoteAgent,
    StateSpec,
)
from vlagents_ray.chunking.choice import choose_for
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.robot import run_loop
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
        time.sleep(self.thinks_s)
        joints, goal = obs.state["joints"], obs.info["goal"]
        reach = STEP * np.arange(1, ROWS + 1)[:, np.newaxis]  # (ROWS, 1), rad
        return Act((joints + np.clip(goal - joints, -reach, reach)).astype(np.float32))


class GuidedArm(SimulatedRobot):  # replace SimulatedRobot with your arm
    """An arm whose observations contain the planner's newest answer.

    No tick waits for the planner. While the planner is late or down, its last answer remains in
    use. The arm holds when that answer is older than `max_age_s`.
    """

    def __init__(self, planner, period_s=1.0, max_age_s=3.0):
        super().__init__(CONTRACT)
        self.planner, self.period_s, self.max_age_s = planner, period_s, max_age_s
        self.thread = ThreadPoolExecutor(1)
        self.call, self.called_s = None, 0.0  # the planner's last call, and the time of its start
        self.problem = "it has not answered yet"

    def __enter__(self):
        obs, self.called_s = super().observe(), time.monotonic()
        self.planner.initialize()
        self.planner.reset(obs, TASK)
        # The newest answer, and the time of its observation. Without one, the robot does not begin.
        self.answer, self.seen_s = self.planner.act(obs), self.called_s
        return self

    def __exit__(self, *exc):
        self.thread.shutdown()
        self.planner.close()

    def observe(self):
        obs, now = super().observe(), time.monotonic()
        if self.call is not None and self.call.done():
            try:
                self.answer, self.seen_s = self.call.result(), self.called_s
            except VLAgentsError as error:
                self.problem = str(error)
            self.call = None
        if self.call is None and now - self.called_s >= self.period_s:
            self.call, self.called_s = self.thread.submit(self.planner.act, obs), now
        return replace(obs, info={**obs.info, "goal": self.answer.action})

    @property
    def holds(self):
        """The reason why the control loop must hold the arm, or None."""
        age_s = time.monotonic() - self.seen_s
        if age_s <= self.max_age_s:
            return None
        return f"the planner's answer is {age_s:.1f} s old: {self.problem}"


def main(url):
    """Perform the task, and print the result."""
    planner = RemoteAgent(f"{url}/planner", timeout_s=5)
    policy = RemoteAgent(f"{url}/policy", timeout_s=5)
    player = ChunkPlayer(policy, choose_for(policy, hz=10).settings)
    with player, GuidedArm(planner) as arm:
        report = run_loop(arm, player, hz=10, seconds=40, until=lambda: arm.answer.done)
    print(f"{TASK}: {'done' if arm.answer.done else 'not done'}")
    print(f"policy: {report.timeliness.time_share.share:.1%} of its ticks in time")
    print(f"held for: {report.reasons or 'nothing'}")


if __name__ == "__main__":
    main(sys.argv[1])
