"""A Gymnasium VectorEnv as rows, each of which plays the episode of its own seed.

A VectorEnv resets a row whose episode is over in the next step, in the same one, or leaves that to the caller
(https://farama.org/Vector-Autoreset-Mode). Here an episode begins by a reset with its seed alone; those that the
VectorEnv begins by itself are not played.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError

Row = tuple[Any, float, bool, bool, dict[str, Any]]
"""What `gymnasium.Env.step` returns, for one row."""

_MODES = {"NEXT_STEP", "SAME_STEP", "DISABLED"}


class VectorRows:
    """The rows of a VectorEnv; row 0 alone has the interface of a `gymnasium.Env`."""

    def __init__(self, name: str, vector: Any) -> None:
        """Take a VectorEnv over.

        Args:
            name: Its name, for messages.
            vector: The `gymnasium.vector.VectorEnv`, which `close` closes.

        Raises:
            ConfigError: It does not say what it does with a row whose episode is over.
        """
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
        """Reset all rows; returns the first one's observation and info."""
        return self.reset_all([seed] * self.num_envs, options)[0]

    def step(self, action: np.ndarray) -> Row:
        """Step all rows by one action; returns the first one's step."""
        return self.step_all(np.repeat(action[None], self.num_envs, axis=0))[0]

    def render(self) -> Any:
        """Return the first row's picture."""
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
        """Return the picture of each row."""
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
