"""The import of robosuite in processes without a terminal, several of which may do it at once."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator

from vlagents_ray.envs.rendering.graphics import EGL_DEVICE, GPUS
from vlagents_ray.envs.rendering.render_probe import EGL_CURE
from vlagents_ray.errors import EnvFailed


@contextlib.contextmanager
def importing_robosuite(env: str) -> Iterator[None]:
    """Surround the first import of robosuite; `env` is named in errors."""
    with _no_log_file(), _egl_number(env):
        yield


@contextlib.contextmanager
def _no_log_file() -> Iterator[None]:
    """robosuite logs to one fixed file of the machine, which another user of it may own: then the import fails.

    This also hides its advice about macros, which are not needed.
    """

    def nowhere(_filename: object) -> logging.Handler:
        return logging.NullHandler()

    log = logging.getLogger("robosuite_logs")
    real, level = logging.FileHandler, log.level
    logging.FileHandler = nowhere  # type: ignore[assignment,misc]
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logging.FileHandler = real  # type: ignore[misc]
        log.setLevel(level)


@contextlib.contextmanager
def _egl_number(env: str) -> Iterator[None]:
    """Correct robosuite, which takes EGL's numbers for CUDA's and refuses those not in CUDA_VISIBLE_DEVICES.

    It reads them when it is imported. Where no EGL device was chosen it would draw on the one with CUDA's number, and
    fail on "": the worker finds out on which.
    """
    chosen, visible = os.environ.get(EGL_DEVICE), os.environ.get(GPUS)
    if visible == "" and chosen is None and os.environ.get("MUJOCO_GL") == "egl":
        raise EnvFailed(f"{env} finds no EGL device that renders in software, and was given no GPU; {EGL_CURE}")
    if chosen is None or not visible:
        yield
        return
    os.environ[GPUS] = chosen
    try:
        yield
    finally:
        os.environ[GPUS] = visible
