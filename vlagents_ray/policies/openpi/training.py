"""openpi's training configs, which describe the models and data of checkpoints."""

from __future__ import annotations

import importlib
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

SOURCE = "OPENPI_SRC"  # the variable that names a checkout; PyPI's "openpi" is another project
FOLDERS = ("src", "packages/openpi-client/src")


def train_config(name: str) -> Any:
    """Return openpi's `TrainConfig` of a name, or the one at "module:NAME"."""
    configs = require("openpi.training.config")
    module, colon, attribute = name.partition(":")
    if not colon:
        try:
            return configs.get_config(name)
        except ValueError as error:
            raise ConfigError(f"config {name!r}: not one of openpi's {sorted(configs._CONFIGS_DICT)}") from error
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except ModuleNotFoundError as error:
        raise ConfigError(f"config {name!r}: no module {error.name!r}; add its folder to PYTHONPATH") from error
    if not isinstance(found, configs.TrainConfig):
        raise ConfigError(f"config {name!r}: got {type(found).__name__}, want an openpi TrainConfig")
    return found
