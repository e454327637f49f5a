"""The settings of `vlagents-ray learn tabletop`: which methods, and how much of each."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, PositiveInt

from vlagents_ray.evaluate.plan.config import Tracker, TrackingConfig

Method = Literal["bc", "rpd", "ppo", "grpo"]


class LearnPlan(BaseModel):
    """How much is learned, and where the results go. Each method but "bc" improves the clone that "bc" makes."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    methods: list[Method] = Field(default=["bc", "rpd", "ppo"], min_length=1)
    out: Path = Path("runs/learn")
    resume: bool = False  # go on where a run that was interrupted, or killed, had got to
    seed: NonNegativeInt = 0  # of the networks, and of the training's episodes
    demonstrations: PositiveInt = 48  # episodes of the teacher
    clone_steps: PositiveInt = 2000  # of the optimizer
    iterations: PositiveInt = 10  # of each method
    episodes: PositiveInt = 32  # of the student in each iteration
    groups: PositiveInt = 8  # episodes from one start state, in "grpo"
    steps: PositiveInt | None = None  # of the optimizer in each iteration; default: rpd 500, ppo 40, grpo 20
    evaluate_every: PositiveInt = 5  # iterations
    held_out: PositiveInt = 200  # episodes of an evaluation, the same for each version
    workers: PositiveInt = 2
    num_envs: PositiveInt = 16  # environments of a worker
    track: list[Tracker] = []  # where success rates are shown beside `out`, against the optimizer's steps
    tracking: TrackingConfig = TrackingConfig()
