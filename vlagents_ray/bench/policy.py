"""The policy of the round trips: `noop`, which at `reset` also says what its images lost on the way."""

from __future__ import annotations

from typing import Any

from vlagents_ray.bench.observing import observation
from vlagents_ray.bench.statistics import lost_db
from vlagents_ray.interface import Obs
from vlagents_ray.policies.noop import Noop


class Measured(Noop):
    """`reset` returns {"psnr_db"}: of the cameras, against the bench's own; None if they are the same."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {"psnr_db": lost_db(obs.cameras, observation().cameras)}
