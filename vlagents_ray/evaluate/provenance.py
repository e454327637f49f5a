"""What a run was made with: versions, and the code of the driver, the package, the policies and the environments."""

from __future__ import annotations

import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from vlagents_ray.code import Code, code_in, code_of
from vlagents_ray.evaluate.files import PROVENANCE, whole
from vlagents_ray.registry import names


def driver_code() -> dict[str, Code | None]:
    """Of the folder in which the run was started, and of this package; None where git knows nothing of it."""
    return {"folder": code_in(Path.cwd()), "vlagents_ray": code_of("vlagents_ray")}


def versions() -> dict[str, Any]:
    """What the driver runs on: Python, packages, and the code by what it is of."""
    packages = {}
    for name in ("vlagents-ray", "ray", "numpy", "av"):
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            packages[name] = "not installed"
    code = {name: None if one is None else one.to_json() for name, one in driver_code().items()}
    return {"python": platform.python_version(), "platform": platform.platform(), **packages, "code": code}


def policy_code(metadata: dict[str, Any]) -> Code | None:
    """The code of a policy, if what its server says of it is what is here, too: then the difference is known."""
    policy = metadata.get("policy")
    here = code_of(names("policies").get(policy, policy)) if isinstance(policy, str) else None
    return here if here is not None and here.to_json() == metadata.get("code") else None


def save_diffs(out: Path, found: Iterable[Code | None]) -> None:
    """Write `out/provenance/SHA256.diff` of what differs from its commit; each once."""
    for code in found:
        if code is None or code.diff_sha256 is None:
            continue
        path = out / PROVENANCE / f"{code.diff_sha256}.diff"
        if not path.exists():
            with whole(path) as part:
                part.write_bytes(code.diff)
