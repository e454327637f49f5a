"""Imports of packages that an extra of this distribution installs."""

from __future__ import annotations

from types import ModuleType

from vlagents_ray.registry import require


def optional(module: str, extra: str = "rollouts") -> ModuleType:
    """Import a module of a package that an extra installs.

    Raises:
        MissingDependency: The package is not installed; the message names the extra.
    """
    return require(module, extra=extra, distribution="vlagents-ray-learn")
