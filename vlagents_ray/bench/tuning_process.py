"""A process with one variant of a policy, which it loads and measures: `python -m vlagents_ray.bench.tuning_process`.

It runs in the policy's own Python environment, and so needs the light install and pydantic, but not Ray. The first line
of its input is `ProcessSettings`, as JSON. Each further line is a request, {"measure": SESSIONS, "seconds": S, "rank":
RANK} or {"act": BATCH}, and is answered with a line of JSON. {"step": …} is a step of a long load, {"failed": …} an
error.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.bench.line_client import die_with_parent, own_stdout
from vlagents_ray.bench.measured_policy import MeasuredPolicy, cuda, device_name, forget_peak, jax_device, peak_mib
from vlagents_ray.contract import Contract
from vlagents_ray.errors import PolicyFailed
from vlagents_ray.interface import Agent, Obs
from vlagents_ray.policies.wrapper import Wrapper, build_agent
from vlagents_ray.testing import random_observation
from vlagents_ray.validation import check_observation

_CAMERA, _STATE, _GRIPPER = "camera", "state", "gripper"  # keys: NUMBER/camera/NAME, NUMBER/state/NAME, NUMBER/gripper
FRAMES = 8  # episodes whose first actions are compared
_TUNED = ("compile", "dtype", "quantization", "batch_sizes")  # settings of a policy


@dataclass(frozen=True, slots=True)
class ProcessSettings:
    """The first line of input."""

    policy: str
    config: dict[str, Any]
    wrappers: Sequence[Any]
    max_size: int  # largest number of sessions to be measured
    patience: float  # `batch.patience`
    batch_sizes: Sequence[int]  # `batch.sizes`, or none
    frames: str | None  # a file of `save_observations`; None: random observations
    side: int  # px, of random images whose size the contract does not state
    dims: Mapping[str, int]  # sizes of parts of the state that the contract leaves open


def save_observations(observations: Sequence[Obs], file: Path) -> None:
    arrays: dict[str, np.ndarray] = {}
    for number, obs in enumerate(observations):
        arrays |= {f"{number}/{_CAMERA}/{name}": image for name, image in obs.cameras.items()}
        arrays |= {f"{number}/{_STATE}/{name}": values for name, values in obs.state.items()}
        if obs.gripper is not None:
            arrays[f"{number}/{_GRIPPER}"] = np.array(obs.gripper)
    np.savez(file, **arrays)  # type: ignore[arg-type]


def load_observations(file: Path) -> list[Obs]:
    """Read the observations written by `save_observations`."""
    found: dict[int, Obs] = {}
    with np.load(file, allow_pickle=False) as arrays:
        for key in arrays.files:
            number, kind, *name = key.split("/", 2)
            obs = found.setdefault(int(number), Obs())
            if kind == _GRIPPER:
                obs.gripper = float(arrays[key])
            else:
                (obs.cameras if kind == _CAMERA else obs.state)[name[0]] = arrays[key]
    return [found[number] for number in sorted(found)]


def main() -> None:
    """Load the policy and answer requests until the input ends."""
    die_with_parent()
    out = own_stdout()

    def answer(said: Mapping[str, Any]) -> None:
        print(json.dumps(said), file=out, flush=True)

    try:
        _serve(ProcessSettings(**json.loads(sys.stdin.readline())), answer)
    except Exception as error:  # noqa: BLE001 - a policy may raise any error
        answer({"failed": _sentence(error)})
        sys.exit(1)


def _serve(settings: ProcessSettings, answer: Callable[[Mapping[str, Any]], None]) -> None:
    agent: Agent = build_agent(settings.policy, settings.config, settings.wrappers)
    measured = MeasuredPolicy(
        agent,
        _views(settings),
        max_size=settings.max_size,
        patience=settings.patience,
        batch_sizes=settings.batch_sizes,
        on_step=lambda step: answer({"step": step}),
    )
    while isinstance(agent, Wrapper):
        agent = agent.agent
    with measured:
        uncompiled, config = measured.engine.models.uncompiled, getattr(agent, "config", None)
        has = {name: getattr(config, name) for name in _TUNED if name in getattr(type(config), "model_fields", {})}
        dtypes = [] if jax_device() is None else ["bfloat16"]  # that the accelerator computes without emulation
        if (used := cuda()) is not None:
            dtypes = ["bfloat16" if used.get_device_capability() >= (8, 0) else "float16"]
        answer({
            "device": device_name(), "load_s": measured.load_s, "uncompiled": uncompiled,
            "settings": has, "dtypes": dtypes,
            "modes": [False, True] if used is None else [False, "graphs", True],  # of `compile`
        })  # fmt: skip
        for line in sys.stdin:
            try:
                asked = json.loads(line)
                if "act" in asked:
                    said: dict[str, Any] = {
                        "actions": [action.tolist() for action in measured.actions(asked["act"], FRAMES)]
                    }
                else:
                    forget_peak()
                    turn = measured.queued(asked["measure"], asked["seconds"], asked["rank"])
                    trips_ms = [round(trip, 4) for trip in turn.trips_ms]
                    said = {"actions_per_s": turn.actions_per_s, "trips_ms": trips_ms, "peak_mib": peak_mib()}
            except Exception as error:  # noqa: BLE001 - as above; smaller batches may still work
                said = {"failed": _sentence(error)}
            answer(said)


def _views(settings: ProcessSettings) -> Callable[[Contract | None, int], Obs]:
    if settings.frames is None:
        return lambda contract, i: random_observation(contract, i, side=settings.side, dims=settings.dims)
    recorded = load_observations(Path(settings.frames))

    def view(contract: Contract | None, i: int) -> Obs:
        obs = recorded[i % len(recorded)]
        check_observation(obs, contract)
        return obs

    return view


def _sentence(error: BaseException) -> str:
    cause = error.__cause__ if isinstance(error, PolicyFailed) and error.__cause__ is not None else error
    return f"{type(cause).__name__}: {' '.join(str(cause).split())}"


if __name__ == "__main__":
    main()
