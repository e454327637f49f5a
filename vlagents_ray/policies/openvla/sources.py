"""OpenVLA's model classes, from a source tree or, where that is allowed, from the checkpoint itself."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.util
import io
import json
import os
import sys
import types
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

MODEL, PROCESSOR = "OpenVLAForActionPrediction", "PrismaticImageProcessor"
VARIABLES = ("OPENVLA_SRC", "OPENVLA_OFT_SRC")  # either serves both policies: the used code is the same
_PACKAGES = ("prismatic", "prismatic.extern", "prismatic.extern.hf", "prismatic.training", "prismatic.vla")


def model_classes(checkpoint: Path, source_dir: str | None, trust_remote_code: bool) -> tuple[Any, Any]:
    """Return the classes of the model and of its image processor.

    With `trust_remote_code`, they are the classes that the checkpoint's files name: Python code that runs with all
    rights of this process. Otherwise they come from the source tree: `source_dir`, $OPENVLA_SRC, $OPENVLA_OFT_SRC, or
    an installed `prismatic`.

    Raises:
        ConfigError: There are no such classes.
    """
    if trust_remote_code:
        return (
            _remote(checkpoint, "config.json", "AutoModelForVision2Seq"),
            _remote(checkpoint, "preprocessor_config.json", "AutoImageProcessor"),
        )
    return _from_source(find_source(source_dir))


def _remote(checkpoint: Path, file: str, auto: str) -> Any:
    named = json.loads((checkpoint / file).read_text(encoding="utf-8")).get("auto_map", {}).get(auto)
    if named is None:
        raise ConfigError(
            f"trust_remote_code: {checkpoint / file} names no code (auto_map has no {auto!r}); "
            f"take the classes from a source tree instead: set source_dir"
        )
    return require("transformers.dynamic_module_utils").get_class_from_dynamic_module(named, str(checkpoint))


def find_source(source_dir: str | None) -> Path:
    """Return the folder that holds the package `prismatic`."""
    asked = [source_dir] if source_dir else [os.environ[name] for name in VARIABLES if os.environ.get(name)]
    if not asked:
        spec = importlib.util.find_spec("prismatic")  # finds without importing
        asked = [str(Path(found).parent) for found in (spec.submodule_search_locations or ())] if spec else []
    for folder in asked:
        root = Path(folder).expanduser().resolve()
        if (root / "prismatic/extern/hf/modeling_prismatic.py").is_file():
            return root
    raise ConfigError(
        f"OpenVLA's model classes: got {asked or 'no source tree'}, want a folder with prismatic/extern/hf in it; set "
        f"source_dir or ${VARIABLES[0]} to a clone of openvla or openvla-oft, or, if you trust the Python code that "
        f"lies beside the weights, trust_remote_code: true"
    )


@lru_cache(maxsize=4)
def _from_source(root: Path) -> tuple[Any, Any]:
    # OFT's code prints settings that do not apply here
    with _bare_packages(root), contextlib.redirect_stdout(io.StringIO()):
        modeling = importlib.import_module("prismatic.extern.hf.modeling_prismatic")
        processing = importlib.import_module("prismatic.extern.hf.processing_prismatic")
    return getattr(modeling, MODEL), getattr(processing, PROCESSOR)


@contextlib.contextmanager
def _bare_packages(root: Path) -> Iterator[None]:
    """Import from `root` without the packages' own `__init__`, which import all of training's packages, TensorFlow
    too.
    """
    before = _take_out()
    for name in _PACKAGES:
        package = types.ModuleType(name)
        package.__path__ = [str(root.joinpath(*name.split(".")))]
        sys.modules[name] = package
    try:
        yield
    finally:
        # torch.compile imports the module of a function that it compiles, by the module's name
        alias = f"prismatic_{hashlib.sha256(str(root).encode()).hexdigest()[:16]}"
        for name, module in _take_out().items():
            module.__name__ = name.replace("prismatic", alias, 1)
            sys.modules[module.__name__] = module
        sys.modules.update(before)


def _take_out() -> dict[str, types.ModuleType]:
    names = [name for name in sys.modules if name.partition(".")[0] == "prismatic"]
    return {name: sys.modules.pop(name) for name in names}
