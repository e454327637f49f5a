"""The families with random checkpoints, and the deployment file of a checkpoint."""

from __future__ import annotations

import importlib
import importlib.util
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import yaml

from benchmarks.checkpoints.recipe import Recipe, SizeName, WrittenCheckpoint
from vlagents_ray.errors import ConfigError, MissingDependency
from vlagents_ray.naming import did_you_mean
from vlagents_ray.registry import require

DEPLOYMENT = "deployment.yaml"
_LARGEST_BATCH = 32


@dataclass(frozen=True, slots=True)
class Family:
    """A family of policies."""

    module: str  # name of the module in this folder
    environment: str  # name of the family's requirements: `vlagents-ray venv create NAME`
    packages: tuple[str, ...]  # packages that the environment must have
    dtypes: tuple[str, ...] = ("bfloat16", "float32")  # types of the weights, the usual type first


FAMILIES = {
    "pi0": Family("pi0", "hf", ("torch", "transformers", "safetensors")),
    "smolvla": Family("lerobot", "lerobot", ("torch", "lerobot", "transformers")),
    "pi05": Family("lerobot", "lerobot", ("torch", "lerobot", "transformers")),
    "act": Family("lerobot", "lerobot", ("torch", "lerobot"), ("float32",)),
    "diffusion": Family("lerobot", "lerobot", ("torch", "lerobot"), ("float32",)),
    "openvla": Family("openvla", "openvla", ("torch", "timm", "transformers")),
}


def write_checkpoint(
    family: str, folder: Path, size: SizeName = "full", dtype: str | None = None
) -> WrittenCheckpoint:
    """Write a checkpoint of random weights, and a deployment file that serves it with this Python.

    Args:
        family: One of `FAMILIES`.
        folder: The folder for the checkpoint and `deployment.yaml`, which must not exist or be
            empty.
        size: "full" is the published size, "small" has some tens of millions of parameters.
        dtype: Type of the weights; None selects the family's usual type.

    Returns:
        The written checkpoint.

    Raises:
        ConfigError: The family, the type of the weights or the size is unknown, or the folder is
            not empty.
        MissingDependency: The family's packages are not installed in this Python.
    """
    known = FAMILIES.get(family)
    if known is None:
        raise ConfigError(
            f"family: expected one of {list(FAMILIES)}{did_you_mean(family, FAMILIES)}, got "
            f"{family!r}"
        )
    dtype = dtype or known.dtypes[0]
    if dtype not in known.dtypes:
        raise ConfigError(
            f"--dtype: got {dtype!r}, {family} is made in {' or '.join(known.dtypes)}"
        )
    if missing := [name for name in known.packages if importlib.util.find_spec(name) is None]:
        raise MissingDependency(
            f"{family}: {sys.executable} has no {', '.join(missing)}; run this command in the "
            f"family's environment: `vlagents-ray venv create {known.environment} --out "
            f".venv-{known.environment}`, then `.venv-{known.environment}/bin/python -m "
            f"benchmarks.checkpoints {family} {folder}`"
        )
    folder = folder.absolute()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder}: exists already; name a new folder, or remove this one")
    folder.mkdir(parents=True, exist_ok=True)
    try:
        module = importlib.import_module(f"{__package__}.{known.module}")
        written: WrittenCheckpoint = module.write(Recipe(family, folder, size, dtype))
        _write_deployment(folder / DEPLOYMENT, family, written)
    except BaseException:
        shutil.rmtree(folder)  # a partial checkpoint looks like a complete one
        raise
    return written


def _write_deployment(file: Path, family: str, written: WrittenCheckpoint) -> None:
    args = {
        "policy": written.policy,
        "environment": {"python": sys.executable},
        "config": written.config,
        "batch": {"max_size": _LARGEST_BATCH},
        "resources": {"num_gpus": int(require("torch").cuda.is_available())},
    }
    app = {
        "name": family,
        "route_prefix": "/",
        "import_path": "vlagents_ray.serve.app:build",
        "args": args,
    }
    document = {"http_options": {"host": "127.0.0.1", "port": 8000}, "applications": [app]}
    head = f"# {family} with {written.parameters:,} random parameters: its actions mean nothing.\n"
    file.write_text(head + yaml.safe_dump(document, sort_keys=False))
