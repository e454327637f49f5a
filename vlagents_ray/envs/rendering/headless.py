"""Defaults for rendering without a display, on cores that several workers share."""

from __future__ import annotations

import ctypes
import os

from vlagents_ray.envs.rendering.graphics import choose_devices


def prepare_rendering() -> None:
    """Set the variables that drivers and simulators read when they are loaded; those set by the user are kept.

    To be called before any simulator is imported: ManiSkill, too, imports MuJoCo, which chooses its
    OpenGL then and for good.
    """
    os.environ.setdefault("LP_NUM_THREADS", "1")  # Mesa's software drivers take all cores otherwise
    if not os.environ.get("MUJOCO_GL") and not os.environ.get("DISPLAY") and _has_egl():
        os.environ["MUJOCO_GL"] = "egl"
    choose_devices()


def _has_egl() -> bool:
    try:
        ctypes.CDLL("libEGL.so.1")  # without it `MUJOCO_GL=egl` makes `import mujoco` fail
    except OSError:
        return False
    return True
