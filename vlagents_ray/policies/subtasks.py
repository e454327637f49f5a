"""The wrapper that makes a policy follow the subtasks of a planner instead of the instruction of
its episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vlagents_ray.errors import InvalidObservation, shown
from vlagents_ray.interface import SUBTASK, Agent, Obs
from vlagents_ray.policies.outcomes import attempt
from vlagents_ray.policies.wrapper import Wrapper


class Subtasks(Wrapper):
    """Resets a session of the policy whenever `subtask` in the info of its observations changes.

    The new subtask is the instruction of that reset, and the options of the reset are the options
    of the episode. A policy that reads the instruction only at a reset can therefore follow a
    planner (`vlagents_ray.robot.planner`). The reset deletes the policy's memory of earlier
    observations. An observation without a subtask changes nothing.

    Args:
        agent: The policy.
        config: Unused: the wrapper has no settings.
    """

    def __init__(self, agent: Agent, config: Any = None) -> None:
        super().__init__(agent, config)
        self._followed: str | None = None  # the instruction of the policy's last reset
        self._options: dict[str, Any] = {}

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode, with the subtask of the first observation if it has one."""
        self._options = kwargs
        self._followed = _subtask(obs) or instruction
        return self.agent.reset(obs, self._followed, **kwargs)

    def change_batch(
        self, obs: Sequence[Obs], sessions: Sequence[Wrapper]
    ) -> list[Obs | Exception]:
        """Reset the sessions whose subtask has changed."""
        return [
            attempt(session.follow, session_obs)  # type: ignore[attr-defined]
            for session_obs, session in zip(obs, sessions, strict=True)
        ]

    def follow(self, obs: Obs) -> Obs:
        """Reset this session if its subtask has changed.

        Args:
            obs: Its observation.

        Returns:
            The observation for the policy.

        Raises:
            InvalidObservation: The subtask is not a text.
        """
        subtask = _subtask(obs)
        if subtask is not None and subtask != self._followed:
            self.agent.reset(obs, subtask, **self._options)
            self._followed = subtask
        return obs


def _subtask(obs: Obs) -> str | None:
    subtask = obs.info.get(SUBTASK)
    if subtask is None or isinstance(subtask, str):
        return subtask
    raise InvalidObservation(
        f"info[{SUBTASK!r}]: expected a text, got {shown(subtask)}; leave it out if there is no "
        "planner"
    )
