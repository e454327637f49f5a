"""PushT: a disc pushes a T-shaped block onto its outline; from Diffusion Policy, as packaged by gym-pusht."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence

from vlagents_ray.envs.gymnasium import Gymnasium

_ID = "gym_pusht/PushT-v0"


class PushT(Gymnasium):
    """PushT by its published protocol.

    Observation: "front", (96, 96, 3) by default, and `state["agent_pos"]`, (2,) in pixels of the field, 512 by 512.

    Action: (2,) in [0, 512]: where the disc shall go, in the same pixels.
    """

    def __init__(
        self,
        *,
        width: int | None = None,
        height: int | None = None,
        max_steps: int | None = None,
        record_size: Sequence[int] | None = None,
    ) -> None:
        """Make the environment.

        Args:
            width: The width to which the image is stretched, pixels.
            height: The height to which the image is stretched, pixels.
            max_steps: The step limit; 300 by default.
            record_size: Height and width of further copies of the image, for recordings only.

        Raises:
            ConfigError: An option has a wrong value.
            MissingDependency: gym-pusht is not installed.
        """
        super().__init__(_ID, width=width, height=height, max_steps=max_steps, record_size=record_size)

    @classmethod
    def missing(cls) -> str | None:
        if importlib.util.find_spec("gym_pusht") is None:
            return "gym_pusht is not installed; pip install 'vlagents-ray[pusht]'"
        return None
