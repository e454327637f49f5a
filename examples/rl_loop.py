"""Reinforcement learning with the server in the loop: a policy learns the mounting angle of its
camera.

The policy of own_policy.py runs in a server, workers run episodes in own_env.py with it, and this
program learns from their transitions (REINFORCE) and pushes new weights. In the folder of this
file, in two terminals:

    vlagents-ray serve own_policy:Servo
    python rl_loop.py http://localhost:8000

It needs the extra 'learn'. learn/train.py is the same loop for a torch policy with images and
words, with cloning, PPO, a teacher and GRPO: docs/tutorials/learn.md.
"""

import sys
import time

import numpy as np
from own_policy import Servo, offset

from vlagents_ray import join
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray_learn import Publisher, RolloutPlan, Rollouts, TrainingEvaluation, arrays

ENV = "own_env:CraneEnv"
SPREAD = 0.5  # standard deviation of the explored actions
ITERATIONS, EPISODES, RATE = 4, 32, 80.0


class Learner:
    """Trains a policy's gain towards the actions that moved the hook nearer to the mark than
    other actions.
    """

    def __init__(self):
        self.policy = Servo()
        self.policy.initialize()

    def improve(self, columns):
        """Take a step along the policy gradient.

        Args:
            columns: The columns of T transitions: cameras.front (T, H, W, 3) uint8, action (T, 2),
                and reward (T,), the distance gained, m.
        """
        gain = self.policy.weights["gain"]
        seen = np.stack([offset(picture) for picture in columns["cameras.front"]])  # (T, 2)
        # (T, 2), gradients of the log-probabilities.
        tried = (columns["action"] - seen @ gain.T) / SPREAD**2
        reward = columns["reward"]
        better = (reward - reward.mean()) / reward.std()  # (T,)
        gradient = (better[:, None] * tried).T @ seen / len(seen)
        self.policy.load_parameters({"gain": (gain + RATE * gradient).astype(np.float32)})


def main(url):
    """Learn for several iterations, and evaluate before and after on held-out episodes."""
    # So that the workers run in the server's Ray cluster, next to the policy.
    join(url, log_to_driver=False)
    learner = Learner()
    held_out = {"envs": [ENV], "episodes": 20, "seeds": [10_000]}
    out = time.strftime("runs/rl-%H%M%S")
    plan = EvalConfig(policies=[{"name": "servo"}], suites=[held_out], out=out, video="none")
    # The evaluation runs in this process. With the URL as policy, it would run in workers.
    evaluation = TrainingEvaluation(learner.policy, plan)
    exploring = {"policy_options": {"spread": SPREAD}}
    with (
        Publisher(url) as weights,
        Rollouts(RolloutPlan(ENV, url, workers=2, num_envs=4, **exploring)) as rollouts,
    ):
        for iteration in range(ITERATIONS + 1):
            version = weights.push(learner.policy.parameters(), allow_same=True)
            if iteration in (0, ITERATIONS):
                rate = evaluation.play(version).totals[-1].success_once
                print(f"servo@{version}: {rate} of the held-out episodes")
            if iteration < ITERATIONS:
                rollouts.version = version
                columns = arrays(rollouts.collect(EPISODES))
                print(
                    f"servo@{version}: {columns['reward'].mean() * 100:+.1f} cm a step while it "
                    "explores"
                )
                learner.improve(columns)
    print(f"the curve: {out}/report.html")


if __name__ == "__main__":
    main(sys.argv[1])
