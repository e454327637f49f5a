"""Makes environments that are registered with Gymnasium, and states what the known ones do not state themselves.

An environment is one, or the rows of a VectorEnv.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from vlagents_ray.envs.gymnasium.vector import VectorRows
from vlagents_ray.envs.simulator import BenchmarkProtocol
from vlagents_ray.errors import ConfigError, MissingDependency, UnknownEnv
from vlagents_ray.registry import require

VECTORIZATIONS = ("sync", "async", "vector_entry_point")


@dataclass(frozen=True, slots=True)
class Known:
    """Defaults of the options of `Gymnasium` for one id; None uses the environment's own values."""

    module: str | None = None  # registers the id
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    cameras: Mapping[str, str] | None = None
    instruction: str = ""
    control_hz: float | None = None
    protocol: BenchmarkProtocol | None = None


def known(task: str) -> Known:
    """Return the defaults for a Gymnasium id; empty ones if it is not known."""
    if task == "gym_pusht/PushT-v0":
        return _PUSHT
    fetch = re.fullmatch(r"Fetch(\w+?)(?:Dense)?-v\d+", task)
    if fetch is None or fetch[1] not in _FETCH_INSTRUCTIONS:
        return Known()
    return Known(
        module="gymnasium_robotics",
        instruction=_FETCH_INSTRUCTIONS[fetch[1]],
        control_hz=_FETCH.control_hz,
        protocol=_FETCH,
    )


_PUSHT = Known(
    module="gym_pusht",
    kwargs={"obs_type": "pixels_agent_pos"},
    cameras={"front": "pixels"},
    instruction="push the T-shaped block onto the green target",
    control_hz=10.0,
    protocol=BenchmarkProtocol(
        name="PushT",
        source="gym-pusht 0.1.8, PushTEnv; LeRobot 0.4.4, PushtEnv and EvalConfig",
        max_steps=300,
        control_hz=10.0,
        control="absolute position",
        success="the block covers more than 95 % of the target",
        begins="where agent and block stand: the seed's; episode i has the first seed + i",
        ends_on_success=True,
        episodes=50,
    ),
)

_FETCH_INSTRUCTIONS = {
    "Reach": "move the gripper to the red target",
    "Push": "push the block to the red target",
    "Slide": "slide the puck to the red target",
    "PickAndPlace": "pick up the block and move it to the red target",
}
_FETCH = BenchmarkProtocol(
    name="Fetch",
    source="Gymnasium-Robotics 1.4.2; Plappert et al. 2018, arXiv 1802.09464",
    max_steps=50,
    control_hz=25.0,
    control="position of the gripper, delta",
    success="gripper or object is within 5 cm of the target after the last step: success_at_end",
    begins="where object and target are: the seed's",
    ends_on_success=False,
)


def make(
    name: str,
    task: str,
    *,
    module: str | None,
    kwargs: Mapping[str, Any],
    vectorization: str | None,
    rows: int,
    max_steps: int | None,
) -> Any:
    """Make an environment by its id.

    Args:
        name: The env's name, for messages.
        task: The Gymnasium id.
        module: The module that registers the id; None is the id's namespace.
        kwargs: Arguments of `gymnasium.make` or `gymnasium.make_vec`; `render_mode` is "rgb_array" by default.
        vectorization: One of `VECTORIZATIONS`; None if the id's registration decides.
        rows: How many rows a VectorEnv gets.
        max_steps: The step limit, instead of the registered one.

    Returns:
        A `gymnasium.Env`, or a `VectorRows`.

    Raises:
        UnknownEnv: There is no such id.
        ConfigError: An argument does not fit it.
        MissingDependency: The simulator is not installed.
    """
    if vectorization not in (None, *VECTORIZATIONS):
        raise ConfigError(f"{name}: vectorization is {vectorization!r}, want one of {list(VECTORIZATIONS)}")
    # pygame, which several environments draw with, prints a greeting on import otherwise
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    gymnasium = require("gymnasium")
    spec = _registered(task, module)
    if vectorization is None and spec is not None and spec.entry_point is None:
        vectorization = "vector_entry_point"
    try:
        if vectorization is None:
            arguments = {"render_mode": "rgb_array", "disable_env_checker": True, **kwargs}
            return gymnasium.make(task, max_episode_steps=max_steps, **arguments)
        arguments = _vector_arguments(gymnasium, spec, vectorization, max_steps) | dict(kwargs)
        vector = gymnasium.make_vec(task, num_envs=rows, vectorization_mode=vectorization, **arguments)
    except gymnasium.error.DependencyNotInstalled as error:
        raise MissingDependency(f"{name}: {error}") from error
    except gymnasium.error.UnregisteredEnv as error:
        raise UnknownEnv(f"{name}: {error}; set `module` to what registers it") from error
    except gymnasium.error.Error as error:
        raise ConfigError(f"{name}: {error}") from error
    except TypeError as error:
        raise ConfigError(f"{name}: {error}; check `kwargs`, got {dict(kwargs)}") from error
    return VectorRows(name, vector)


def only_vectors(task: str, module: str | None) -> bool:
    """Whether an id is registered with a VectorEnv's entry point alone."""
    spec = _registered(task, module)
    return spec is not None and spec.entry_point is None


def _registered(task: str, module: str | None) -> Any:
    """Import what registers an id, and return its spec; None if it has none under exactly this id."""
    registry = require("gymnasium").registry
    if module is None and "/" in task and task not in registry:
        module = task.partition("/")[0]
    if module is not None:
        require(module)
    return registry.get(task)


def _vector_arguments(gymnasium: Any, spec: Any, vectorization: str, max_steps: int | None) -> dict[str, Any]:
    """The arguments of `gymnasium.make_vec` by default."""
    arguments: dict[str, Any] = {"max_episode_steps": max_steps} if max_steps is not None else {}
    if vectorization != "vector_entry_point":
        mode = gymnasium.vector.AutoresetMode.DISABLED  # one row can begin an episode while the others go on
        return arguments | {
            "render_mode": "rgb_array",
            "disable_env_checker": True,
            "vector_kwargs": {"autoreset_mode": mode},
        }
    entry = getattr(spec, "vector_entry_point", None)
    if isinstance(entry, str):
        entry = gymnasium.envs.registration.load_env_creator(entry)
    if spec is not None and spec.max_episode_steps is None:
        arguments = {}  # its entry point need not take a limit
    renders = "rgb_array" in (getattr(entry, "metadata", None) or {}).get("render_modes", ())
    return arguments | ({"render_mode": "rgb_array"} if renders else {})
