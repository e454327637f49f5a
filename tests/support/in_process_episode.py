"""Run one episode of an environment with a policy in the test's process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from vlagents_ray.envs import EvalEnv
from vlagents_ray.envs.base import SequentialBatch
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.evaluate.episode.episode import Diverged, Images, run_episodes
from vlagents_ray.evaluate.episode.records import EpisodeObserver, EpisodeResult
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.scripted import Scripted


class Always(Agent):
    """A policy that returns the same action in every step."""

    def __init__(self, *action: float) -> None:
        self.action = np.array(action, np.float32)

    def act(self, obs: Obs) -> Act:
        return Act(self.action.copy())


def run_episode(
    env: EvalEnv,
    agent: Agent,
    key: EpisodeKey,
    *,
    executed: Callable[[np.ndarray, float, bool], None] = lambda _action, _reward, _success: None,
    images: Images = "all",
    **settings: Any,
) -> EpisodeResult:
    """Run `run_episodes` with one environment, which stays open, and with the agent as its only
    session.

    Raises:
        VLAgentsError: An error that the policy did not cause.
    """
    observer, batch = EpisodeObserver(), SequentialBatch([env])
    observer.add_action = executed  # type: ignore[method-assign]
    [outcome] = run_episodes(
        batch, agent, [agent], [key], **settings, observers=[observer], images=images
    )
    if isinstance(outcome, VLAgentsError):
        raise outcome
    if isinstance(outcome, Diverged):
        raise outcome.error
    return outcome


def play(
    env: EvalEnv, name: str, agent: Agent | str, *, seed: int = 0, **options: Any
) -> EpisodeResult:
    """Run the episode of `seed` with an agent or with an expert "module:Class", and return it. The
    `reset_options` are passed to the environment.
    """
    if isinstance(agent, str):
        agent = Scripted.from_config({"expert": agent})
    key = EpisodeKey(name, episode=0, seed=seed, settings="")
    return run_episode(env, agent, key, reset_options=options)
