"""An environment that records the host on which it runs, and can be paused."""

from __future__ import annotations

import socket
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from eval_fakes import Line, wait_for

from vlagents_ray.interface import Act, Obs

NOTED = "slurm_envs:Noted"


class Noted(Line):
    """Writes a file HOST-SEED into `folder` for each episode. Episodes with a seed in `held` wait
    until the file `open` exists.
    """

    def __init__(self, folder: str, held: Sequence[int] = ()) -> None:
        super().__init__()
        self._notes, self._held = Path(folder), held

    def reset(
        self, *, seed: int, options: Mapping[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        (self._notes / f"{socket.gethostname()}-{seed}").touch()
        return super().reset(seed=seed, options=options)

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        if self._seed in self._held:
            wait_for((self._notes / "open").exists)
        return super().step(act)
