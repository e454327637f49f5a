"""OpenVLA's and OpenVLA-OFT's own code, out of the source trees that $OPENVLA_SRC and
$OPENVLA_OFT_SRC name.

OFT's also needs `diffusers==0.30.3` and `peft==0.11.1`, which serving does not.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import sys
import types
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from vlagents_ray.policies.base.accelerator import ensure_torchvision

VARIABLES = ("OPENVLA_SRC", "OPENVLA_OFT_SRC")
# Their __init__ import TensorFlow and more.
_PACKAGES = ("", ".extern", ".extern.hf", ".models", ".training", ".vla")


def source(variable: str) -> Path | None:
    """Return the source tree that a variable names; None if there is none."""
    root = Path(os.environ.get(variable) or "-")
    return root if (root / "prismatic").is_dir() else None


@lru_cache
def module(variable: str, name: str) -> types.ModuleType:
    """Return a module of the package `prismatic` in that tree; modules of one tree share their
    imports.
    """
    with _packages(variable):
        return importlib.import_module(f"prismatic.{name}")


_imported: dict[str, dict[str, types.ModuleType]] = {name: {} for name in VARIABLES}


@contextlib.contextmanager
def _packages(variable: str) -> Iterator[None]:
    ensure_torchvision()
    imported = _imported[variable]
    for suffix in _PACKAGES:
        name = f"prismatic{suffix}"
        if name not in imported:
            package = imported[name] = types.ModuleType(name)
            package.__path__ = [str(Path(os.environ[variable], *name.split(".")))]
    sys.modules.update(imported)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        for name in [name for name in sys.modules if name.partition(".")[0] == "prismatic"]:
            imported[name] = sys.modules.pop(name)
