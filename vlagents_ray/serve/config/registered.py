"""Settings of registered classes by name, each checked by the `Config` of its class."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import BaseModel, create_model, model_validator
from pydantic.fields import FieldInfo

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import names, registered_class


class RegisteredArgs(BaseModel, extra="allow"):
    """A section of a deployment file with a key for each class that is on. A key is a registered
    name or "module:Class". A class whose value is null is off.
    """

    kind: ClassVar[str]  # kind of the registered names, see `registry.names`
    base: ClassVar[str]  # base class of the registered classes, as "module.Class", for messages
    config_base: ClassVar[type[BaseModel]]  # base class of each `Config`

    @model_validator(mode="before")
    @classmethod
    def _by_their_own_models(cls, data: Any) -> Any:
        """Check each class's settings with its `Config`, and raise all errors together."""
        if not isinstance(data, Mapping):
            return data
        fields: dict[str, Any] = {
            str(name): (cls.config_of(str(name)) | None, None) for name in data
        }
        checked = create_model("_Registered", **fields).model_validate(data)
        settings = {name: getattr(checked, name) for name in fields}

        in_order = dict.fromkeys((*names(cls.kind), *settings))
        return {name: settings[name] for name in in_order if name in settings}

    @classmethod
    def config_of(cls, name: str) -> type[BaseModel]:
        """Return the model of the settings of one class.

        Raises:
            ConfigError: The class has no `Config`.
        """
        registered = registered_class(cls.kind, name)
        config = getattr(registered, "Config", None)
        if not (isinstance(config, type) and issubclass(config, cls.config_base)):
            raise ConfigError(
                f"{name}: expected a subclass of {cls.base}, whose Config is a "
                f"{cls.config_base.__name__}, got "
                f"{registered.__module__}.{registered.__qualname__} without one; add it"
            )
        return config

    def on(self) -> dict[str, Any]:
        """Return the settings of the classes that are on, by name, in the order of the registry."""
        return {
            name: config for name, config in (self.model_extra or {}).items() if config is not None
        }

    @classmethod
    def registered_fields(cls) -> dict[str, FieldInfo]:
        """Return the known settings, for messages about unknown settings."""
        return {name: FieldInfo(annotation=cls.config_of(name)) for name in names(cls.kind)}
