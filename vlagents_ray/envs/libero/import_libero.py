"""The import of LIBERO in processes without a terminal, several of which may do it at once."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import json
import os
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

from vlagents_ray.envs.rendering.headless import prepare_rendering
from vlagents_ray.envs.rendering.render_probe import EGL_CURE
from vlagents_ray.envs.robosuite.importing import importing_robosuite
from vlagents_ray.errors import EnvFailed, MissingDependency
from vlagents_ray.registry import require

_CONFIG = "LIBERO_CONFIG_PATH"


def root() -> Path:
    """The package's folder with its problems and initial states; raises `MissingDependency`."""
    require("libero")
    spec = importlib.util.find_spec("libero.libero")
    if spec is None or spec.origin is None:
        raise MissingDependency("'libero' is another package; pip install 'vlagents-ray[libero]' brings hf-libero")
    return Path(spec.origin).parent


@functools.cache
def load() -> Path:
    """Import LIBERO and robosuite, once a process; returns `root()`."""
    prepare_rendering()
    folder = root()
    try:
        with _own_config(folder), importing_robosuite("libero"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings of upstream code; LIBERO itself changes the filters
            require("libero.libero.benchmark")
            require("libero.libero.envs")
    except MissingDependency:
        raise
    except Exception as error:
        about_egl = "EGL" in str(error) or "OpenGL" in str(error)
        cure = f"; {EGL_CURE}" if about_egl else ""
        raise EnvFailed(f"libero could not be imported: {type(error).__name__}: {error}{cure}") from error
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
