"""The rows of a Gymnasium VectorEnv as environments that step together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.envs.batch import BatchEnv, Options, Steps, episodes_of, images_in_rows
from vlagents_ray.envs.gymnasium.vector_rows import VectorRows
from vlagents_ray.envs.gymnasium.view import View
from vlagents_ray.envs.mapping import plain
from vlagents_ray.errors import ConfigError, EnvFailed, NotReset, VLAgentsError
from vlagents_ray.interface import Act, Obs


class GymnasiumBatch(BatchEnv):
    """Environments of one id that a VectorEnv steps in one call."""

    def __init__(
        self,
        name: str,
        rows: VectorRows,
        view: View,
        contract: Contract,
        *,
        max_steps: int,
        instruction: str,
        described: Mapping[str, Any],
    ) -> None:
        """Take the VectorEnv of a `Gymnasium` over.

        Args:
            name: The env's name, for messages.
            rows: The VectorEnv, which `close` closes.
            view: How its observations and actions become ours.
            contract: The contract of each environment.
            max_steps: The step limit of each environment.
            instruction: The task in words.
            described: What `describe` returns.
        """
        self.num_envs, self.max_steps, self.restarts = rows.num_envs, max_steps, rows.restarts
        self._name, self._rows, self._view, self._contract = name, rows, view, contract
        self._instruction, self._described = instruction, dict(described)
        self._closed = False
        self._playing = 0
        self._steps = np.zeros(self.num_envs, dtype=int)  # of each episode
        self._seen: list[Obs] = []  # the last observation of each episode

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instructions(self) -> list[str]:
        return [self._instruction] * self._playing

    def reset(self, *, seeds: Sequence[int], options: Sequence[Options | None] | None = None) -> list[Obs]:
        """Begin the episode of a seed, 0 or more, in each environment, all with the same options."""
        playing = episodes_of(seeds, self.num_envs)
        given = list(options or [None])
        if any(option != given[0] for option in given):
            raise ConfigError(f"{self._name}: reset options {given} differ; a VectorEnv's rows have the same ones")
        if min(seeds) < 0:
            raise ConfigError(f"{self._name}: seeds are {list(seeds)}, want 0 or more")
        every = [*seeds, *[seeds[-1]] * (self.num_envs - playing)]
        first = self._call("reset_all", every, given[0])
        self._playing, self._steps[:] = playing, 0
        self._seen = images_in_rows(self._observed([nested for nested, _ in first[:playing]]))
        return self._seen

    def restart(self, index: int, *, seed: int, options: Options | None = None) -> Obs:
        if not self.restarts:
            return super().restart(index, seed=seed, options=options)
        nested, _ = self._call("reset_row", index, seed, options)
        self._steps[index] = 0
        self._seen[index] = self._view.observe(nested, lambda: self._call("render_all")[index])
        return self._seen[index]

    def step(self, acts: Sequence[Act | None]) -> Steps:
        if not self._playing:
            raise NotReset(f"{self._name}: step before reset; call reset(seeds=...) first")
        if len(acts) != self._playing:
            raise ConfigError(f"step: got {len(acts)} actions, want {self._playing}, one for each episode or None")
        still = self._view.idle()
        moves = [still if act is None else self._view.command(act, self._contract) for act in acts]
        actions = np.stack([*moves, *[still] * (self.num_envs - self._playing)])
        rows = self._call("step_all", actions)[: self._playing]
        self._steps += 1
        self._seen = images_in_rows(self._observed([row[0] for row in rows]))
        terminated = [row[2] for row in rows]
        truncated = [row[3] or bool(self._steps[i] >= self.max_steps) for i, row in enumerate(rows)]
        infos = [
            {} if act is None else {**plain(info), "success": self._view.succeeded(info, ended)}
            for act, (_, _, ended, _, info) in zip(acts, rows, strict=True)
        ]
        return self._seen, [row[1] for row in rows], terminated, truncated, infos

    def describe(self) -> dict[str, Any]:
        return {**self._described, "num_envs": self.num_envs}

    def close(self) -> None:
        self._playing = 0
        if not self._closed:
            self._closed = True
            self._rows.close()

    def _observed(self, nested: Sequence[Any]) -> list[Obs]:
        pictures: Sequence[Any] = self._call("render_all") if self._view.renders else ()
        return [self._view.observe(one, partial(pictures.__getitem__, i)) for i, one in enumerate(nested)]

    def _call(self, method: str, *args: Any) -> Any:
        if self._closed:
            raise NotReset(f"{self._name}: is closed; make it again")
        try:
            return getattr(self._rows, method)(*args)
        except VLAgentsError:
            raise
        except Exception as error:
            raise EnvFailed(f"{self._name}: {method} raised {type(error).__name__}: {error}") from error
