"""The versions of LeRobot that are served, each in its own environment, and the types that only one of them has."""

from __future__ import annotations

import importlib.metadata

REQUIREMENTS = {"0.4.4": "requirements/lerobot.txt", "0.6.1": "requirements/lerobot06.txt"}
_REWARDS = dict.fromkeys(("reward_classifier", "sarm", "robometer", "topreward"), "it returns rewards, not actions")
_REFUSED = {
    "0.4.4": {
        "groot": "it is GR00T N1.5, whose statistics cannot be checked in LeRobot 0.4.4; serve it with GR00T's own "
        "code, or GR00T N1.7 with LeRobot 0.6.1 (requirements/lerobot06.txt)",
    },
    "0.6.1": {
        "lingbot_va": "it goes on from the frames and caches of the chunk before, which it keeps for one robot",
    },
}
_ONLY_IN = {
    "sac": "0.4.4",
    **dict.fromkeys(
        ("eo1", "evo1", "fastwam", "gaussian_actor", "lingbot_va", "molmoact2", "multi_task_dit", "vla_jepa"), "0.6.1"
    ),
}


def installed() -> str:
    """Return the version of the LeRobot of this environment, "0.6.1"."""
    return importlib.metadata.version("lerobot")


def is_new() -> bool:
    """Whether this environment has LeRobot 0.6 or newer."""
    return tuple(int(part) for part in installed().split(".")[:2]) >= (0, 6)


def refusal(name: str) -> str | None:
    """Return why LeRobot's policies of that type are not served in this environment; None if they are."""
    ours = "0.6.1" if is_new() else "0.4.4"
    if reason := _REWARDS.get(name) or _REFUSED[ours].get(name):
        return reason
    theirs = _ONLY_IN.get(name, ours)
    if theirs == ours:
        return None
    other = "; LeRobot 0.6 calls that gaussian_actor, and does not read it" if name == "sac" else ""
    return f"LeRobot {installed()}, the one here, does not have it{other}; {reads(theirs)}"


def reads(version: str) -> str:
    """Return what to do for a checkpoint of that version of LeRobot."""
    return f"LeRobot {version} reads it: `vlagents-ray env make {REQUIREMENTS[version]}`"


def other_version() -> str:
    """Return what to do if a checkpoint is of the other version of LeRobot."""
    other = "0.4.4" if is_new() else "0.6.1"
    return f"the LeRobot here is {installed()}; if it was written by another, {reads(other)}"
