"""A Gymnasium VectorEnv as rows, each of which plays the episode of its own seed, and as a batch of environments.

A VectorEnv resets a row whose episode is over in the next step, in the same one, or leaves that to the caller
(https://farama.org/Vector-Autoreset-Mode). Here an episode begins by a reset with its seed alone; those that the
VectorEnv begins by itself are not played.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import BatchEnv, Options, Steps, episodes_of, images_in_rows
from vlagents_ray.envs.gymnasium.view import View, plain
from vlagents_ray.errors import ConfigError, EnvFailed, NotReset, VLAgentsError
from vlagents_ray.interface import Act, Obs

Row = tuple[Any, float, bool, bool, dict[str, Any]]
"""What `gymnasium.Env.step` returns, for one row."""

_MODES = {"NEXT_STEP", "SAME_STEP", "DISABLED"}


class VectorRows:
    """The rows of a VectorEnv; row 0 alone has the interface of a `gymnasium.Env`."""

    def __init__(self, name: str, vector: Any) -> None:
        """Take a VectorEnv over; raises `ConfigError` if its mode of autoreset is unknown."""
        mode = vector.metadata.get("autoreset_mode")
        self.autoreset = str(getattr(mode, "name", mode)).upper()  # an AutoresetMode, or its name
        if self.autoreset not in _MODES:
            raise ConfigError(
                f"{name}: metadata['autoreset_mode'] of its VectorEnv is {mode!r}, want a "
                f"gymnasium.vector.AutoresetMode; set it in the VectorEnv's class, with Gymnasium 1.1 or newer"
            )
        self.num_envs = int(vector.num_envs)
        self.observation_space, self.action_space = vector.single_observation_space, vector.single_action_space
        self.render_mode, self.spec = vector.render_mode, vector.spec
        self._name, self._vector = name, vector
        self._over = np.zeros(self.num_envs, dtype=bool)  # rows that want a reset before they step again

    @property
    def restarts(self) -> bool:
        """Whether one row can begin an episode while the others go on."""
        return self.autoreset == "DISABLED"

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.reset_all([seed] * self.num_envs, options)[0]

    def step(self, action: np.ndarray) -> Row:
        return self.step_all(np.repeat(action[None], self.num_envs, axis=0))[0]

    def render(self) -> Any:
        return self.render_all()[0]

    def reset_all(
        self, seeds: Sequence[int], options: Mapping[str, Any] | None = None
    ) -> list[tuple[Any, dict[str, Any]]]:
        """Begin the episode of a seed in each row, all with the same options; returns observations and infos."""
        seen, infos = self._vector.reset(seed=list(seeds), options=dict(options) if options else None)
        self._over[:] = False
        return [(_row(seen, i), _info(infos, i)) for i in range(self.num_envs)]

    def reset_row(self, index: int, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in one row; only where `restarts` is true."""
        seen, infos = self._reset_some(np.arange(self.num_envs) == index, seed, options)
        return _row(seen, index), _info(infos, index)

    def step_all(self, actions: np.ndarray) -> list[Row]:
        """Step each row by its action, (num_envs, D).

        The step that ends an episode returns the episode's last observation and info in each mode of autoreset. What a
        row returns after that, until its next reset, has no meaning.
        """
        if self.restarts and self._over.any():  # such a row must not be stepped
            self._reset_some(self._over.copy(), 0, None)
        seen, rewards, terminated, truncated, infos = self._vector.step(actions)
        rows: list[Row] = []
        for i in range(self.num_envs):
            ended = bool(terminated[i]), bool(truncated[i])
            last = any(ended) and "final_obs" in infos  # same-step: `seen` is the next episode's first
            info = _info(infos.get("final_info", {}) if last else infos, i)
            rows.append((_row(infos["final_obs"] if last else seen, i), float(rewards[i]), *ended, info))
            self._over[i] |= any(ended)
        return rows

    def render_all(self) -> Sequence[Any]:
        pictures: Sequence[Any] = self._vector.render()
        if pictures is None or len(pictures) != self.num_envs:
            got = None if pictures is None else len(pictures)
            raise ConfigError(f"{self._name}: render gives {got} pictures, want one for each of {self.num_envs} rows")
        return pictures

    def stated(self, attribute: str) -> Any:
        """Return an attribute of the first row's environment; None if it has none, or lives in another process."""
        envs = getattr(self._vector, "envs", None)
        if not envs or not envs[0].has_wrapper_attr(attribute):
            return None
        return envs[0].get_wrapper_attr(attribute)

    def close(self) -> None:
        self._vector.close()

    def _reset_some(self, rows: np.ndarray, seed: int, options: Mapping[str, Any] | None) -> tuple[Any, Any]:
        """Reset the rows of a mask, (num_envs,) bool; returns observations and infos of all."""
        self._over[rows] = False
        answer: tuple[Any, Any] = self._vector.reset(
            seed=[seed] * self.num_envs, options={**(options or {}), "reset_mask": rows}
        )
        return answer


def _row(batched: Any, index: int) -> Any:
    """Return one row of a batched observation; mappings and tuples of a space hold a batch in each place."""
    if isinstance(batched, Mapping):
        return {key: _row(value, index) for key, value in batched.items()}
    return batched[index]


def _info(infos: Mapping[str, Any], index: int) -> dict[str, Any]:
    """Return one row's info: what its mask, `_key`, says that it has, as `VectorEnv._add_info` puts it."""
    found: dict[str, Any] = {}
    for key, value in infos.items():
        if key.startswith("_") and key[1:] in infos:
            continue
        mask = infos.get(f"_{key}")
        if mask is not None and not mask[index]:
            continue
        if isinstance(value, Mapping):
            found[key] = _info(value, index)
        else:
            found[key] = value[index] if isinstance(value, (np.ndarray, list, tuple)) else value
    return found


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
        """Take the VectorEnv of a `Gymnasium` over; `described` is what `describe` returns."""
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
