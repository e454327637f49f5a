"""The settings under `args.dialects` in a deployment file. A dialect that is not named there is
off.

Each dialect defines its own settings as `Config` of its class. This module defines the settings
that they share, and the section of all dialects by name: a registered name, or "module:Class".
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, ClassVar

from pydantic import BaseModel, Field, field_validator, model_validator

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.naming import did_you_mean
from vlagents_ray.protocol.messages import PriorityName
from vlagents_ray.registry import dialect_class, names, require
from vlagents_ray.serve.config.registered import RegisteredArgs
from vlagents_ray.wire.mapping import KeyMapping

logger = logging.getLogger(__name__)

MappingSetting = str | dict[str, Any]


class DialectConfig(BaseModel, extra="forbid"):
    """The settings that all dialects have. The `Config` of a dialect adds its own."""

    mapping: MappingSetting | None = Field(
        default=None,
        description="Conversion of the client's observations: the name of a preset, or an object "
        "(`vlagents_ray.wire.mapping`). null: the client uses this project's names.",
    )
    priority: PriorityName = Field(
        default="robot",
        description="Priority of the client's requests. Robots are served before simulations.",
    )

    @field_validator("mapping")
    @classmethod
    def _readable(cls, value: MappingSetting | None) -> MappingSetting | None:
        if value is not None:
            read_mapping(value)
        return value

    def keys(self) -> KeyMapping | None:
        """Return the mapping; None if the client uses this project's names."""
        return None if self.mapping is None else read_mapping(self.mapping)


class PortConfig(DialectConfig):
    """The settings of all dialects that have their own port."""

    port: int = Field(
        ge=1,
        le=65535,
        description="Port to which clients connect. The deployment fails if the port is in use.",
    )
    host: str | None = Field(
        default=None,
        description=(
            "Address on which the dialect listens. null: the address of `vlagents-ray serve`, and "
            "127.0.0.1 under `serve deploy`."
        ),
    )


class KeylessPortConfig(PortConfig):
    """The settings of a dialect with its own port, whose protocol has no field for an API key."""

    without_key: bool = Field(
        default=False,
        description="Accept clients without an API key, since this protocol has no field for a "
        "key.",
    )


class DialectArgs(RegisteredArgs):
    """The settings of all dialects that are on, by name."""

    kind: ClassVar[str] = "dialects"
    base: ClassVar[str] = "vlagents_ray.serve.dialects.base.Dialect"
    config_base: ClassVar[type[BaseModel]] = DialectConfig

    @model_validator(mode="after")
    def _ports_of_their_own(self) -> DialectArgs:
        ports = {name: config.port for name, config in self.gateways().items()}
        for port, number in Counter(ports.values()).items():
            if number > 1:
                sharing = " and ".join(name for name in ports if ports[name] == port)
                raise ValueError(
                    f"expected a port for each dialect, got {port} for {sharing}; change one"
                )
        return self

    def gateways(self) -> dict[str, PortConfig]:
        """Return the settings of the dialects that have their own port, by name."""
        return {
            name: config for name, config in self.on().items() if isinstance(config, PortConfig)
        }

    def at_root(self) -> list[str]:
        """Return the dialects at the root path: the first dialect that has a root, and all other
        dialects with the same protocol there.
        """
        roots = {name: getattr(dialect_class(name), "root", "") for name in self.on()}
        first = next(filter(None, roots.values()), None)
        return [name for name, root in roots.items() if root == first]

    def describe(self) -> dict[str, Any]:
        """Describe the enabled dialects for the metadata: addresses, clients and mapping by
        name.
        """
        descriptions: dict[str, Any] = {}
        for name, config in self.on().items():
            cls = dialect_class(name)
            mapping = config.keys()
            descriptions[name] = {
                **cls.places(config),
                "clients": cls.clients,
                "summary": cls.summary,
                "mapping": None if mapping is None else mapping.to_json(),
            }
        for name in self.at_root():
            descriptions[name]["paths"].insert(0, "WS /")
        return descriptions

    def require_fit(self, contract: Contract | None) -> None:
        """Raise `ConfigError` if a dialect's mapping lacks a part of the observation that the
        policy needs.
        """
        misfits = []
        for name, config in self.on().items():
            for sentence in dialect_class(name).lacks(config, contract):
                misfits.append(f"- dialects.{name}: {sentence}")
        if misfits:
            raise ConfigError("dialects and policy do not fit:\n" + "\n".join(misfits))

    def require_packages(self) -> None:
        """Raise `MissingDependency` if an enabled dialect needs a package that is not installed."""
        for name in self.on():
            for module in dialect_class(name).requires:
                require(module)


def read_mapping(value: str | Mapping[str, Any]) -> KeyMapping:
    """Read a mapping.

    The presets are the mappings of known clients. Each dialect defines its own presets, with the
    units and the order of values in its system's examples.

    Args:
        value: A preset's name, or an object. The fields of an object with `preset` override the
            fields of the preset.

    Raises:
        ConfigError: The preset is unknown, or the object is invalid.
    """
    if not isinstance(value, (str, Mapping)):
        raise ConfigError(
            f"mapping: expected a preset's name or an object, got {type(value).__name__}"
        )
    fields = {"preset": value} if isinstance(value, str) else dict(value)
    base = _preset(fields.pop("preset")) if "preset" in fields else {}
    return KeyMapping.from_json({**base, **fields})


@cache
def presets() -> dict[str, KeyMapping]:
    """Return the presets of all registered dialects, by name."""
    mappings = {}
    for dialect_presets in _presets_by_dialect():
        for name, preset in dialect_presets.items():
            mappings[name] = KeyMapping.from_json(preset)
    return mappings


def _preset(name: object) -> Mapping[str, Any]:
    """Return a preset in the form in which its dialect defines it.

    Raises:
        ConfigError: There is no preset of this name.
    """
    for dialect_presets in _presets_by_dialect():
        if isinstance(name, str) and name in dialect_presets:
            return dialect_presets[name]
    known = presets()
    meant = did_you_mean(str(name), known)
    raise ConfigError(
        f"mapping: expected one of the presets {sorted(known)}, or an object, got {name!r}{meant}"
    )


def _presets_by_dialect() -> Iterator[Mapping[str, Mapping[str, Any]]]:
    """Yield the presets of each dialect. A dialect that cannot be imported is left out, and its
    error is logged.
    """
    for name in names("dialects"):
        try:
            dialect = dialect_class(name)
        except VLAgentsError as error:
            logger.warning("dialect %r: its presets are not available: %s", name, error)
            continue
        yield dialect.presets
