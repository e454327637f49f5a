"""Provenance of a run: versions of packages, and the git state of the driver, this package and the policies."""

from __future__ import annotations

import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from vlagents_ray.evaluate.artifacts.storage import PROVENANCE, whole
from vlagents_ray.ray_tools.git_state import GitState, code_in, code_of
from vlagents_ray.registry import names


def driver_code() -> dict[str, GitState | None]:
    """The git state of the working directory and of this package; None where there is no git repository."""
    return {"folder": code_in(Path.cwd()), "vlagents_ray": code_of("vlagents_ray")}


def versions() -> dict[str, Any]:
    """The versions of Python, of packages and of the platform in the driver, and `driver_code` as JSON."""
    packages = {}
    for name in ("vlagents-ray", "ray", "numpy", "av"):
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            packages[name] = "not installed"
    code = {name: None if one is None else one.to_json() for name, one in driver_code().items()}
    return {"python": platform.python_version(), "platform": platform.platform(), **packages, "code": code}


def policy_code(metadata: dict[str, Any]) -> GitState | None:
    """The git state of a policy's code, diff included, if it is the same here as on its server; else None."""
    policy = metadata.get("policy")
    here = code_of(names("policies").get(policy, policy)) if isinstance(policy, str) else None
    return here if here is not None and here.to_json() == metadata.get("code") else None


def save_diffs(out: Path, found: Iterable[GitState | None]) -> None:
    """Write the diff of each git state from its commit to `out/provenance/SHA256.diff`, once."""
    for code in found:
        if code is None or code.diff_sha256 is None:
            continue
        path = out / PROVENANCE / f"{code.diff_sha256}.diff"
        if not path.exists():
            with whole(path) as part:
                part.write_bytes(code.diff)
