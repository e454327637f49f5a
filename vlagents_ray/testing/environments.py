"""`check_env`: a test suite for the interface of `EvalEnv`."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import EvalEnv
from vlagents_ray.errors import InvalidAction, InvalidObservation
from vlagents_ray.interface import Act, Obs
from vlagents_ray.testing.comparing import ContractViolation, check_close, require_same, require_wireable
from vlagents_ray.validation import check_observation


def check_env(
    env: EvalEnv,
    *,
    steps: int = 5,
    seeds: tuple[int, int] = (0, 1),
    options: Mapping[str, Any] | None = None,
    same_steps: bool = True,
    step_limit: bool = True,
) -> None:
    """Check that an environment implements the interface of `EvalEnv`; closes it.

    Random actions are executed in an episode of each of the two seeds, and then in the first episode again.

    Args:
        env: The environment, not reset yet.
        steps: The number of actions in an episode.
        seeds: The seeds of two different episodes.
        options: The options of each `reset`.
        same_steps: Whether the same actions must also lead to the same observations; if False, only the first
            observation of a seed must be the same, as for a simulator that is not reproducible bit for bit.
        step_limit: Whether one episode runs until `env.max_steps`; False if that takes too long.

    Raises:
        ContractViolation: The environment does not implement the interface; the message names the place.
    """
    contract = env.contract
    if not isinstance(contract, Contract):
        raise ContractViolation(f"contract: got {type(contract).__name__}, want a Contract")
    if contract.action.dim is None:
        raise ContractViolation("contract.action.dim: got None, want the number of components of an action")
    if type(env.max_steps) is not int or env.max_steps < 1:
        raise ContractViolation(f"max_steps: got {env.max_steps!r}, want an int of at least 1")
    require_wireable(env.describe(), "describe()")
    if not all(isinstance(name, str) for name in env.tasks()):
        raise ContractViolation(f"tasks(): got {env.tasks()!r}, want a list of names")
    suite = _Suite(env, contract, options)
    actions = suite.random_actions(steps)
    first = suite.play(seeds[0], actions)
    other = suite.play(seeds[1], actions)
    again = suite.play(seeds[0], actions)
    because = "an episode must be a pure function of its seed and options, whatever was played before"
    require_same(first.instruction, again.instruction, "instruction", because)
    require_same(first.seen[0], again.seen[0], "the first observation", because)
    if same_steps:
        for i, (a, b) in enumerate(zip(first.seen, again.seen, strict=False)):
            require_same(a, b, f"the observation after step {i}", because)
        require_same(first.outcomes, again.outcomes, "[reward, terminated, truncated, success] of the steps", because)
        suite.check_unseen(seeds[0], actions, first)
    because = "a later step or reset changed it: give new arrays each time"
    for rollout in (first, other, again):
        for i, (given, kept) in enumerate(zip(rollout.given, rollout.seen, strict=True)):
            require_same(kept, given, f"the observation after step {i}", because)
    suite.check_invalid_actions(seeds[0])
    if step_limit:
        suite.check_step_limit(seeds[0])
    check_close(env)


@dataclass(slots=True)
class _Rollout:
    instruction: str
    given: list[Obs]  # the env's own objects
    seen: list[Obs]  # copies of them, made immediately
    outcomes: list[Any]


@dataclass(slots=True)
class _Suite:
    """Plays episodes, and checks the results of the environment."""

    _env: EvalEnv
    _contract: Contract
    _options: Mapping[str, Any] | None

    def random_actions(self, count: int) -> list[np.ndarray]:
        spec = self._contract.action
        low = -1.0 if spec.low is None else spec.low
        high = 1.0 if spec.high is None else spec.high
        actions = np.random.default_rng(0).uniform(low, high, (count, spec.dim or 1))
        return list(actions.astype(np.float32))

    def play(self, seed: int, actions: list[np.ndarray]) -> _Rollout:
        obs = self.reset(seed)
        rollout = _Rollout(self._env.instruction, [obs], [copy.deepcopy(obs)], [])
        for action in actions:
            obs, outcome = self.step(action)
            rollout.given.append(obs)
            rollout.seen.append(copy.deepcopy(obs))
            rollout.outcomes.append(outcome)
            if outcome[1] or outcome[2]:
                break
        return rollout

    def reset(self, seed: int) -> Obs:
        result = self._env.reset(seed=seed, options=self._options)
        if not isinstance(result, tuple) or len(result) != 2:
            raise ContractViolation(f"reset: got {_kind(result)}, want (Obs, info)")
        obs, info = result
        _check_obs(obs, self._contract, "reset")
        if not isinstance(info, dict):
            raise ContractViolation(f"reset: info is {_kind(info)}, want a dict")
        require_wireable(info, "reset: info")
        instruction = self._env.instruction
        if not isinstance(instruction, str):
            raise ContractViolation(f"instruction: got {_kind(instruction)}, want a str")
        if self._contract.instruction and not instruction:
            raise ContractViolation("instruction: is empty, but the contract states that the env has one")
        return obs

    def step(self, action: np.ndarray) -> tuple[Obs, list[Any]]:
        """Execute an action; return the observation, and reward, terminated, truncated and success."""
        sent = action.copy()
        result = self._env.step(Act(sent))
        require_same(action, sent, "the action", "step must leave the caller's array as it is")
        if not isinstance(result, tuple) or len(result) != 5:
            raise ContractViolation(f"step: got {_kind(result)}, want (Obs, reward, terminated, truncated, info)")
        obs, *outcome, info = result
        _check_obs(obs, self._contract, "step")
        kinds = (("reward", float), ("terminated", bool), ("truncated", bool))
        for (name, kind), value in zip(kinds, outcome, strict=True):
            if type(value) is not kind:
                raise ContractViolation(f"step: {name} is {_kind(value)}, want a {kind.__name__}")
        if not isinstance(info, dict):
            raise ContractViolation(f"step: info is {_kind(info)}, want a dict")
        if type(info.get("success")) is not bool:
            raise ContractViolation(f"step: info['success'] is {_kind(info.get('success'))}, want a bool")
        require_wireable(info, "step: info")
        return obs, [*outcome, info["success"]]

    def check_unseen(self, seed: int, actions: list[np.ndarray], seen: _Rollout) -> None:
        """Repeat the episode `seen` with `looked_at` False before the last step; only images may be absent."""
        self.reset(seed)
        last = len(seen.outcomes) - 1
        because = "`looked_at` may omit images and must change nothing else"
        for i, (action, expected) in enumerate(zip(actions, seen.seen[1:], strict=False)):
            self._env.looked_at = i == last
            obs, reward, terminated, truncated, info = self._env.step(Act(action.copy()))
            a, b = (one if i == last else Obs({}, one.gripper, one.state) for one in (expected, obs))
            require_same(a, b, f"the observation after step {i}", because)
            outcome = [reward, terminated, truncated, info["success"]]
            require_same(seen.outcomes[i], outcome, f"[reward, terminated, truncated, success] of step {i}", because)

    def check_invalid_actions(self, seed: int) -> None:
        self.reset(seed)
        [good] = self.random_actions(1)
        dim = len(good)
        for what, action in (
            (f"of shape ({dim + 1},)", np.append(good, good[0])),
            ("that holds NaN", np.full(dim, np.nan, np.float32)),
        ):
            try:
                self._env.step(Act(action))
            except InvalidAction:
                continue
            except Exception as error:
                raise ContractViolation(f"step: an action {what} raised {error!r}, want InvalidAction") from error
            raise ContractViolation(f"step: an action {what} was executed, want InvalidAction")
        self.step(good)

    def check_step_limit(self, seed: int) -> None:
        self.reset(seed)
        [action] = self.random_actions(1)
        limit = self._env.max_steps
        for count in range(1, limit + 1):
            _, (_, terminated, truncated, _) = self.step(action)
            if terminated:
                return
            if truncated != (count == limit):
                state = "is" if truncated else "is not"
                raise ContractViolation(f"step {count} {state} truncated, but max_steps is {limit}")


def _check_obs(obs: object, contract: Contract, where: str) -> None:
    if not isinstance(obs, Obs):
        raise ContractViolation(f"{where}: the observation is {_kind(obs)}, want an Obs")
    try:
        check_observation(obs, contract)
    except InvalidObservation as error:
        raise ContractViolation(f"{where}: {error}") from error
    for name, part in obs.state.items():
        if part.dtype != np.float32:
            raise ContractViolation(f"{where}: state {name!r} is {part.dtype}, want float32")
    for kind, have, stated in (("cameras", obs.cameras, contract.cameras), ("state", obs.state, contract.state)):
        if stated is not None and set(have) != set(stated):
            raise ContractViolation(f"{where}: {kind} are {sorted(have)}, the contract states {sorted(stated)}")
    if contract.gripper is False and obs.gripper is not None:
        raise ContractViolation(f"{where}: gripper is {obs.gripper}, the contract states that there is none")
    require_wireable(obs.info, f"{where}: Obs.info")


def _kind(value: object) -> str:
    return f"a tuple of {len(value)}" if isinstance(value, tuple) else type(value).__name__
