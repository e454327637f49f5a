"""The settings under `args.parts` in a deployment file: parts of replicas that plug-ins add."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import BaseModel

from vlagents_ray.serve.config.registered import RegisteredArgs


class PartConfig(BaseModel, extra="forbid"):
    """The settings of a part of a replica; the `Config` of a part adds its own."""


class PartArgs(RegisteredArgs):
    """The settings of all parts that are on, by name."""

    kind: ClassVar[str] = "replica"
    base: ClassVar[str] = "vlagents_ray.serve.replica.part.ReplicaPart"
    config_base: ClassVar[type[BaseModel]] = PartConfig

    def on(self) -> dict[str, Any]:
        """Return the settings of the enabled parts, by name, in the order of the registry."""
        return dict(self.model_extra or {})
