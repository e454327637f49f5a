"""Compare two checkpoints: is the later one better, or was it luck?

Both run the same episodes. Only episodes that exactly one checkpoint solves are decisive. `python
compare_checkpoints.py` runs 2 x 40 episodes in this process, in seconds, and prints the difference
with its interval and McNemar's test, for each environment and for all. The checkpoints are
simulated: an expert whose hand drifts less after longer training.

`vlagents-ray eval` runs your own checkpoints, and the same lines compare them
(docs/tutorials/checkpoints.md). `vlagents-ray merge` combines results of different runs in one
folder.
"""

import time

import numpy as np

from vlagents_ray import Act
from vlagents_ray.evaluate import EvalConfig, Results, compare, evaluate
from vlagents_ray.policies.scripted import Scripted

ENVS = ["tabletop/lift", "tabletop/slide"]


class Trainee(Scripted):
    """A simulated policy with checkpoints."""

    def __init__(self, checkpoint_step):
        """Create the policy at a training step."""
        super().__init__()
        self.checkpoint_step = checkpoint_step

    def reset(self, obs, instruction, seed=0, **kwargs):
        """Begin an episode; the drift depends on the checkpoint and the seed of the episode."""
        drift = 0.35 * 0.5 ** (self.checkpoint_step / 5000)  # drift per action
        self.drift = np.random.default_rng(seed).normal(0, drift, 3).astype(np.float32)
        return super().reset(obs, instruction, **kwargs)

    def act(self, obs):
        """Return the expert's action with the drift, (4,)."""
        action = super().act(obs).action.copy()
        action[:3] = np.clip(action[:3] + self.drift, -1, 1)
        return Act(action)


def main():
    """Run the episodes, and compare the checkpoints."""
    plan = EvalConfig(
        policies=[{"name": "trainee", "steps": [2000, 8000]}],
        suites=[{"name": env, "envs": [env], "episodes": 20} for env in ENVS],
        out=time.strftime("runs/compared-%H%M%S"),
        video="none",
        workers=0,
    )
    evaluate(plan, agent_factory=Trainee)

    results = Results.load(plan.out)
    found = compare(results, "trainee@8000", "trainee@2000")
    for line in (*found.suites, found.total):
        low, high = line.interval
        pairs = line.pairs
        print(
            f"{line.suite}: {pairs.total} pairs; only the later solved {pairs.only_a}, only the "
            f"other {pairs.only_b}"
        )
        print(
            f"  difference of the rates: {low:+.0%} to {high:+.0%} with 95 % confidence, p = "
            f"{line.adjusted:.2g}"
        )


if __name__ == "__main__":
    main()
