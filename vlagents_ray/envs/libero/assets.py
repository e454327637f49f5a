"""The location of LIBERO's meshes and textures, which nothing here downloads."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from vlagents_ray.envs.libero import import_libero
from vlagents_ray.errors import EnvFailed

VARIABLE = "LIBERO_ASSETS"
_DATASET = "lerobot/libero-assets"  # hf-libero's own source of them
_CACHE = Path(".cache") / "libero" / "assets"  # in the home, where hf-libero's own download puts them
_NEEDED = ("articulated_objects", "scenes", "stable_hope_objects", "stable_scanned_objects", "turbosquid_objects")

CURE = (
    f"download them once: hf download {_DATASET} --repo-type dataset --local-dir libero-assets; then "
    f"set {VARIABLE} to that folder on every node, or the env's option `assets`"
)


def find_assets(chosen: str | None = None) -> Path:
    """Find the folder of the assets: `chosen`, or the one that `LIBERO_ASSETS` names, or that of hf-libero itself.

    Args:
        chosen: The folder in the env's options; None if it has none.

    Returns:
        The folder.

    Raises:
        EnvFailed: There is no such folder, or it lacks a part; the message has the command for the download.
    """
    named = chosen or os.environ.get(VARIABLE)
    places = [Path(named)] if named else [import_libero.root() / "assets", Path.home() / _CACHE]
    folder = next((place for place in places if place.is_dir()), None)
    if folder is None:
        looked = " and ".join(str(place) for place in places)
        raise EnvFailed(f"libero: no assets (meshes and textures) in {looked}; {CURE}")
    lacks = [part for part in _NEEDED if not (folder / part).is_dir()]
    if lacks:
        raise EnvFailed(f"libero: the assets in {folder} lack {lacks}; {CURE}")
    return folder.resolve()


def digest(folder: Path) -> str:
    """Return a digest of a folder, which is equal if relative paths and sizes of all files are."""
    files = sorted((str(path.relative_to(folder)), path.stat().st_size) for path in folder.rglob("*") if path.is_file())
    return hashlib.sha256(repr(files).encode()).hexdigest()[:16]
