"""Which checkpoints a deployment offers, and which of them a session asked for. Pure decisions.

A policy's settings name its checkpoint, and perhaps a step of it (`checkpoint: /runs/a/{step}`,
`checkpoint_step: 20000`). A session chooses among what the deployment file offers; it never names a path.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from vlagents_ray.errors import UnknownCheckpoint
from vlagents_ray.interface import Agent
from vlagents_ray.policies.base.checkpoint import at_step

CHOICE, STEP = "checkpoint", "checkpoint_step"  # options of a reset, and settings of a policy


@dataclass(frozen=True, slots=True)
class Wish:
    """What a session asked for."""

    choice: str | None = None  # one of the deployment's `choices`
    step: int | None = None

    def __str__(self) -> str:
        if self == OWN:
            return "the deployment's own checkpoint"
        step = "" if self.step is None else f"step {self.step}"
        return f"checkpoint {' at '.join(filter(None, ('' if self.choice is None else repr(self.choice), step)))}"


OWN = Wish()


class Checkpoints:
    """The deployment's own settings, what may be chosen in place of some of them, and how to make an agent of any."""

    def __init__(
        self,
        make: Callable[[Mapping[str, Any]], Agent],
        config: Mapping[str, Any] | None = None,
        choices: Mapping[str, Mapping[str, Any]] | None = None,
        *,
        steps: bool = False,
        loaded: int = 2,
    ) -> None:
        """`make` builds an agent of settings, and loads nothing; `loaded` are held in memory at once, at most."""
        self.make = make
        self.config = dict(config or {})
        self.limit = loaded
        self._choices = {name: dict(settings) for name, settings in (choices or {}).items()}
        self._steps = steps

    def wish(self, options: Mapping[str, Any]) -> tuple[Wish, dict[str, Any]]:
        """What a reset's options ask for, and those left for the policy; `UnknownCheckpoint` if there is no such."""
        rest = dict(options)
        choice, step = rest.pop(CHOICE, None), rest.pop(STEP, None)
        if choice is not None and (not isinstance(choice, str) or choice not in self._choices):
            raise UnknownCheckpoint(f"{CHOICE}: got {choice!r}, want {self._offered()}")
        if step is not None:
            if not self._steps:
                raise UnknownCheckpoint(f"{STEP}: got {step!r}; this deployment offers {self._offered()}")
            if isinstance(step, bool) or not isinstance(step, int) or step < 0:
                raise UnknownCheckpoint(f"{STEP}: got {step!r}, want a number of training steps, such as 20000")
        return Wish(choice, step), rest

    def settings(self, wish: Wish, config: Mapping[str, Any]) -> dict[str, Any]:
        """Those that an agent is made of where `config` are the deployment's own."""
        chosen = {} if wish.choice is None else self._choices[wish.choice]
        return {**config, **chosen, **({} if wish.step is None else {STEP: wish.step})}

    def examples(self) -> list[Wish]:
        """The deployment's own, every choice, and a step if those can be chosen."""
        return [OWN, *map(Wish, self._choices), *([Wish(step=0)] if self._steps else [])]

    def describe(self, config: Mapping[str, Any]) -> dict[str, Any]:
        """What there is to choose, for the metadata."""
        choices = {name: resolved(self.settings(Wish(name), config)) for name in self._choices}
        return {"choices": choices, "steps": self._steps, "limit": self.limit}

    def offers(self, wish: Wish, settings: Mapping[str, Any], config: Mapping[str, Any]) -> bool:
        """Do these settings follow from that wish?"""
        known = wish.choice is None or wish.choice in self._choices
        return known and (wish.step is None or self._steps) and self.settings(wish, config) == settings

    def _offered(self) -> str:
        offered = [f"one of {sorted(self._choices)}"] if self._choices else []
        offered += [f"a {STEP}"] if self._steps else []
        return " or ".join([*offered, "none, for its own"]) if offered else "none but its own"


def resolved(settings: Mapping[str, Any]) -> str | None:
    """The checkpoint that settings name, with its step filled in."""
    checkpoint, step = settings.get(CHOICE), settings.get(STEP)
    return at_step(checkpoint, step) if isinstance(checkpoint, str) else checkpoint
