"""The evaluation protocol of ManiSkill 3, under which results are comparable."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class ManiSkillProtocol:
    """The section "Evaluation" of ManiSkill 3's guide to its set-up for reinforcement learning."""

    ignore_terminations: bool = True  # an episode continues to the step limit after success or failure
    reconfiguration_freq: int = 1  # the scene is rebuilt for each episode, with other objects where a task draws them
    metrics: tuple[str, ...] = ("success_once", "success_at_end")
    seeds: str = "one an environment"  # each episode has its own seed, which determines all that is random in it


PROTOCOL = ManiSkillProtocol()


def described(*, reconfigure: bool, max_steps: int, own_limit: int | None) -> dict[str, Any]:
    """The protocol for the record, and in `deviations` what of these settings is not as it says."""
    deviations = []
    if not reconfigure:
        deviations.append("reconfigure is False: scenes are kept from episode to episode")
    if max_steps != own_limit:
        deviations.append(f"max_steps is {max_steps}, the task's own is {own_limit}")
    return {**asdict(PROTOCOL), "metrics": list(PROTOCOL.metrics), "deviations": deviations}
