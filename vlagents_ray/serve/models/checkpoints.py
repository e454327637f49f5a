"""The checkpoints that a deployment offers, and a session's choice among them. This module does not
load checkpoints.

A policy's settings contain its checkpoint, and optionally a training step of the checkpoint
(`checkpoint: /runs/a/{step}`, `checkpoint_step: 20000`). A session chooses among the checkpoints in
the deployment file; it can never choose a path.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from vlagents_ray.errors import UnknownCheckpoint
from vlagents_ray.interface import Agent
from vlagents_ray.policies.base.checkpoint import at_step
from vlagents_ray.serve.requests import DEFAULT, CheckpointChoice

CHOICE, STEP = "checkpoint", "checkpoint_step"  # options of a reset, and settings of a policy


class Checkpoints:
    """The deployment's own settings, the choices that may replace some of them, and the factory
    of agents.
    """

    def __init__(
        self,
        make: Callable[[Mapping[str, Any]], Agent],
        config: Mapping[str, Any] | None = None,
        choices: Mapping[str, Mapping[str, Any]] | None = None,
        *,
        steps: bool = False,
        loaded: int = 2,
    ) -> None:
        """Define the checkpoints of a deployment.

        Args:
            make: Creates an agent from settings, without loading anything.
            choices: The choices by name. `CheckpointArgs` describes this and the following
                arguments.
            steps: Whether sessions may choose a step.
            loaded: Maximum number of loaded checkpoints.
        """
        self.make = make
        self.limit = loaded
        self.config = dict(config or {})
        self._choices = {name: dict(settings) for name, settings in (choices or {}).items()}
        self._steps = steps

    def split_options(self, options: Mapping[str, Any]) -> tuple[CheckpointChoice, dict[str, Any]]:
        """Split the options of a reset into the chosen checkpoint and the options for the policy.

        Raises:
            UnknownCheckpoint: The deployment does not offer the chosen checkpoint or step.
        """
        rest = dict(options)
        choice, step = rest.pop(CHOICE, None), rest.pop(STEP, None)
        if choice is not None and (not isinstance(choice, str) or choice not in self._choices):
            raise UnknownCheckpoint(f"{CHOICE}: expected {self._choices_text()}, got {choice!r}")

        if step is not None:
            if not self._steps:
                raise UnknownCheckpoint(
                    f"{STEP}: expected {self._choices_text()}, got {step!r}; leave it out"
                )
            if isinstance(step, bool) or not isinstance(step, int) or step < 0:
                raise UnknownCheckpoint(
                    f"{STEP}: expected a number of training steps, such as 20000, got {step!r}"
                )
        return CheckpointChoice(choice, step), rest

    def settings(self, choice: CheckpointChoice, config: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of an agent for the choice, which are based on the deployment's own
        settings `config`.
        """
        chosen = {} if choice.name is None else self._choices[choice.name]
        return {**config, **chosen, **({} if choice.step is None else {STEP: choice.step})}

    def examples(self) -> list[CheckpointChoice]:
        """Return an example of each choice: the deployment's own checkpoint, every named
        checkpoint, and a step if sessions may choose steps.
        """
        return [
            DEFAULT,
            *map(CheckpointChoice, self._choices),
            *([CheckpointChoice(step=0)] if self._steps else []),
        ]

    def describe(self, config: Mapping[str, Any]) -> dict[str, Any]:
        """Return the available choices, for the metadata."""
        choices = {
            name: resolved(self.settings(CheckpointChoice(name), config)) for name in self._choices
        }
        return {"choices": choices, "steps": self._steps, "limit": self.limit}

    def offers(
        self, choice: CheckpointChoice, settings: Mapping[str, Any], config: Mapping[str, Any]
    ) -> bool:
        """Return whether the deployment offers the choice, and whether `settings` are the settings
        of that choice.
        """
        known = choice.name is None or choice.name in self._choices
        return (
            known
            and (choice.step is None or self._steps)
            and self.settings(choice, config) == settings
        )

    def _choices_text(self) -> str:
        """Return the choices in words, for an error."""
        names = sorted(self._choices)
        texts = [f"one of {names}"] if names else []
        texts += [f"a {STEP}"] if self._steps else []
        if not texts:
            return "none, as there is only one"
        return " or ".join([*texts, "none, for its own"])


def resolved(settings: Mapping[str, Any]) -> str | None:
    """Return the checkpoint in the settings, with the step filled in."""
    checkpoint, step = settings.get(CHOICE), settings.get(STEP)
    return at_step(checkpoint, step) if isinstance(checkpoint, str) else checkpoint
