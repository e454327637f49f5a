"""The checkpoint that a session asked for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CheckpointChoice:
    """The checkpoint that a session asked for: by default the deployment's own."""

    name: str | None = None  # name of one of the deployment's `choices`; None for the deployment's own
    step: int | None = None  # training step of the checkpoint; None for the step that the settings name

    def __str__(self) -> str:
        if self == DEFAULT:
            return "the deployment's own checkpoint"
        step = "" if self.step is None else f"step {self.step}"
        return f"checkpoint {' at '.join(filter(None, ('' if self.name is None else repr(self.name), step)))}"


DEFAULT = CheckpointChoice()
