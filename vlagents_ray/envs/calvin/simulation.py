"""CALVIN's simulator in PyBullet, made from a checkout with its own settings."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from vlagents_ray.envs.rendering.graphics import EGL_DEVICE
from vlagents_ray.envs.rendering.render_probe import EGL_CURE
from vlagents_ray.errors import ConfigError, EnvFailed
from vlagents_ray.registry import require

VARIABLE = "CALVIN_SRC"
CURE = (
    f"git clone --recurse-submodules https://github.com/mees/calvin, and name that folder in {VARIABLE} on every node, "
    f"or as the env's option `source_dir`"
)
Renderer = Literal["egl", "tiny"]
_PACKAGE, _CONF = Path("calvin_env"), Path("calvin_env/conf")
_TASKS = Path("calvin_models/conf/callbacks/rollout/tasks/new_playtable_tasks.yaml")
_WORDS = Path("calvin_models/conf/annotations/new_playtable_validation.yaml")


def find_checkout(chosen: str | None) -> Path:
    """Return the checkout of CALVIN, `chosen` or that of CALVIN_SRC; raises `ConfigError` if it is none."""
    named = chosen or os.environ.get(VARIABLE)
    if not named:
        raise ConfigError(f"calvin: {VARIABLE} is not set; {CURE}")
    checkout = Path(named).expanduser().resolve()
    lacks = [str(part) for part in (_CONF, _TASKS, _WORDS) if not (checkout / part).exists()]
    if lacks:
        raise ConfigError(f"calvin: {checkout} lacks {lacks}, want a checkout of CALVIN with its submodules; {CURE}")
    return checkout


def make_simulator(checkout: Path, scene: str, renderer: Renderer) -> Any:
    """Make CALVIN's `PlayTableSimEnv` of a scene, with the cameras, arm and rates of its datasets.

    Args:
        checkout: The checkout.
        scene: "A" to "D".
        renderer: As upstream draws, through OpenGL ("egl"), or PyBullet's renderer in software ("tiny").

    Raises:
        EnvFailed: PyBullet cannot draw through EGL.
    """
    folder = str(checkout / _PACKAGE)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    if device := os.environ.get(EGL_DEVICE):
        os.environ.setdefault("EGL_VISIBLE_DEVICES", device)
    with quietly():
        require("pybullet")
        hydra, omegaconf = require("hydra"), require("omegaconf").OmegaConf
        code: Any = importlib.import_module("calvin_env.envs.play_table_env")
        code.get_git_commit_hash = lambda _: ""  # which wants a repository
        parts = {
            "env": "env/play_table_env",
            "scene": f"scene/calvin_scene_{scene}",
            "arm": "robot/panda",
            "fingers": "robot/panda_longer_finger",
            "static": "cameras/cameras/static",
            "gripper": "cameras/cameras/gripper",
        }
        read = {name: omegaconf.load(checkout / _CONF / f"{path}.yaml") for name, path in parts.items()}
        read["fingers"].pop("defaults")  # the arm, which hydra would merge
        settings = omegaconf.create(
            {
                "data_path": "data",
                "use_vr": False,
                "env": read["env"],
                "scene": read["scene"],
                "robot": omegaconf.merge(read["arm"], read["fingers"]),
                "cameras": {"static": read["static"], "gripper": read["gripper"]},
            }
        )
        try:
            return hydra.utils.instantiate(settings.env, use_scene_info=True, use_egl=renderer == "egl")
        except SystemExit as error:  # PyBullet could not load its plug-in, which it has printed
            raise EnvFailed(f"calvin: PyBullet cannot draw through EGL; {EGL_CURE}, or set renderer to tiny") from error


def read_tasks(checkout: Path) -> tuple[Any, dict[str, str]]:
    """Return CALVIN's judge of tasks, `Tasks`, and the words of each task in its evaluation."""
    hydra, omegaconf = require("hydra"), require("omegaconf").OmegaConf
    with quietly():
        judge = hydra.utils.instantiate(omegaconf.load(checkout / _TASKS))
    return judge, {task: texts[0] for task, texts in omegaconf.load(checkout / _WORDS).items()}


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Keep what upstream's code prints and warns of, such as gym's end, off the terminal; errors are raised."""
    nowhere = io.StringIO()
    with contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
