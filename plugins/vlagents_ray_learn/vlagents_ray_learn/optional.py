"""Packages that are in an extra of this distribution."""

from __future__ import annotations

from types import ModuleType

from vlagents_ray.registry import require


def optional(module: str, extra: str = "rollouts") -> ModuleType:
    """Import a module of a package that an extra installs; raises `MissingDependency`, which
    names the extra.
    """
    return require(module, extra=extra, distribution="vlagents-ray-learn")
