"""The settings under `args.parts` in a deployment file: parts of replicas that plug-ins add."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import BaseModel

from vlagents_ray.registry import entries, names
from vlagents_ray.serve.config.registered import RegisteredArgs


class PartConfig(BaseModel, extra="forbid"):
    """The settings that all parts of a replica have. The `Config` of a part adds its own."""


class PartArgs(RegisteredArgs):
    """The settings of parts, by name. The value null turns off a part that is on by default."""

    kind: ClassVar[str] = "replica"
    base: ClassVar[str] = "vlagents_ray.serve.replica.part.ReplicaPart"
    config_base: ClassVar[type[BaseModel]] = PartConfig

    def on(self) -> dict[str, Any]:
        """Return the settings of the enabled parts, by name, in the order of the registry.

        A part that is on by default is only on if its plug-in is installed, which the Python
        environment of a policy may lack.
        """
        settings = dict(self.model_extra or {})
        for name, entry in entries(self.kind).items():
            if entry.by_default and name not in settings:
                settings[name] = self.config_of(name)()
        in_order = dict.fromkeys((*names(self.kind), *settings))
        return {name: settings[name] for name in in_order if settings.get(name) is not None}
