"""LIBERO's package: its import by several processes without a terminal, and its meshes and textures.

The import may happen in several processes at once. Nothing here downloads the meshes and textures.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.util
import json
import os
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

from vlagents_ray.envs.graphics import prepare_rendering
from vlagents_ray.envs.render_probe import failing
from vlagents_ray.envs.robosuite import importing_robosuite
from vlagents_ray.errors import EnvFailed, MissingDependency
from vlagents_ray.registry import require

_CONFIG = "LIBERO_CONFIG_PATH"
VARIABLE = "LIBERO_ASSETS"
_DATASET = "lerobot/libero-assets"  # hf-libero's own source of them
_CACHE = Path(".cache") / "libero" / "assets"  # in the home, where hf-libero's own download puts them
_NEEDED = ("articulated_objects", "scenes", "stable_hope_objects", "stable_scanned_objects", "turbosquid_objects")

CURE = (
    f"download them once: hf download {_DATASET} --repo-type dataset --local-dir libero-assets; then "
    f"set {VARIABLE} to that folder on every node, or the env's option `assets`"
)


def package_folder() -> Path:
    """The package's folder with its problems and initial states; raises `MissingDependency`."""
    require("libero")
    spec = importlib.util.find_spec("libero.libero")
    if spec is None or spec.origin is None:
        raise MissingDependency("'libero' is another package; pip install 'vlagents-ray[libero]' brings hf-libero")
    return Path(spec.origin).parent


@functools.cache
def import_libero() -> Path:
    """Import LIBERO and robosuite, once a process; returns `package_folder()`."""
    prepare_rendering()
    folder = package_folder()
    with (
        failing("libero", "import its package"),
        _own_config(folder),
        importing_robosuite("libero"),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")  # warnings of upstream code; LIBERO itself changes the filters
        require("libero.libero.benchmark")
        require("libero.libero.envs")
    return folder


@contextlib.contextmanager
def _own_config(folder: Path) -> Iterator[None]:
    """A configuration of this process alone.

    LIBERO reads one from the home, asks on stdin where there is none, and writes it there. Its paths are
    wanted nowhere but in helpers that are not used here, so it goes with the import.
    """
    parts = {"assets": "assets", "bddl_files": "bddl_files", "datasets": "datasets", "init_states": "init_files"}
    paths = {"benchmark_root": str(folder)} | {key: str(folder / name) for key, name in parts.items()}
    before = os.environ.get(_CONFIG)
    with tempfile.TemporaryDirectory(prefix="libero-config-") as own:
        Path(own, "config.yaml").write_text(json.dumps(paths))  # JSON is YAML
        os.environ[_CONFIG] = own
        try:
            yield
        finally:
            if before is None:
                del os.environ[_CONFIG]
            else:
                os.environ[_CONFIG] = before


def find_assets(chosen: str | None = None) -> Path:
    """Return the assets' folder: `chosen`, that of `LIBERO_ASSETS`, or hf-libero's own; raises `EnvFailed`."""
    named = chosen or os.environ.get(VARIABLE)
    places = [Path(named)] if named else [package_folder() / "assets", Path.home() / _CACHE]
    folder = next((place for place in places if place.is_dir()), None)
    if folder is None:
        looked = " and ".join(str(place) for place in places)
        raise EnvFailed(f"libero: no assets (meshes and textures) in {looked}; {CURE}")
    lacks = [part for part in _NEEDED if not (folder / part).is_dir()]
    if lacks:
        raise EnvFailed(f"libero: the assets in {folder} lack {lacks}; {CURE}")
    return folder.resolve()


def assets_digest(folder: Path) -> str:
    """Return a digest of a folder, which is equal if relative paths and sizes of all files are."""
    files = sorted((str(path.relative_to(folder)), path.stat().st_size) for path in folder.rglob("*") if path.is_file())
    return hashlib.sha256(repr(files).encode()).hexdigest()[:16]
