"""Policies for separate Python environments. Before they are loaded, they need only numpy and this
package.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import inspect
import json
import os
import platform
import sys
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np

from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs
from vlagents_ray.abilities import members
from vlagents_ray.policies.compilation import CudaGraph
from vlagents_ray.policies.loading import (
    current_report,
    report_device,
    report_progress,
    report_uncompiled,
)
from vlagents_ray.registry import named_class


class Dances(Protocol):
    """An ability that this package does not define."""

    tempo: float

    def dance(self, obs: Obs, times: int, *, fast: bool = False) -> str:
        """Dance to an observation."""

    def rest(self, seconds: float) -> str:
        """Rest."""


RESTED = threading.Event()


class ActsAfterRest(Agent):
    """A policy whose `act` waits until `rest` was called. `rest` fails for some durations."""

    contract = Contract(action=ActionSpec(dim=1))
    tempo = 1.0

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {}

    def act(self, obs: Obs) -> Act:
        if not RESTED.wait(30):
            raise TimeoutError("no rest")
        return Act(np.zeros(1))

    def dance(self, obs: Obs, times: int, *, fast: bool = False) -> str:
        return "danced"

    def rest(self, seconds: float) -> Any:
        if seconds < 0:
            raise ValueError("/no/path/of/ours")
        if seconds == 1.0:
            return object()
        if seconds == 2.0:
            sys.exit(3)
        RESTED.set()
        return "rested"


ALIVE: weakref.WeakSet[Telling] = weakref.WeakSet()  # living sessions of this process


class Telling(Agent):
    """A policy that solves `eval_fakes.Line`. Its `info` has the versions and ids of its process,
    and the number of calls in the session.

    The module `needs` is imported when the policy is loaded. Each reset also writes its `info` as a
    line to the file `notes`.
    """

    contract = Contract(action=ActionSpec(dim=1))

    def __init__(self, needs: str = "numpy", notes: str | None = None) -> None:
        self.needs = needs
        self.notes = notes

    def initialize(self) -> None:
        print("a policy is loading", file=sys.stderr)
        self.version = importlib.import_module(self.needs).__version__
        self.weights_id = {"digest": self.version, "revision": None}

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        if instruction == "fail":
            raise RuntimeError("/no/path/of/ours")
        ALIVE.add(self)
        self.instruction, self.acts, self.seen = instruction, 0, [float(obs.info.get("value", 0))]
        if self.notes is not None:
            with Path(self.notes).open("a") as file:
                file.write(json.dumps(self.told()) + "\n")
        return self.told()

    def observe(self, obs: Obs) -> None:
        self.seen.append(float(obs.info["value"]))

    def act(self, obs: Obs) -> Act:
        if obs.info.get("exit"):
            os._exit(7)
        if obs.info.get("fails"):
            raise RuntimeError("no action")
        if obs.info.get("broken"):
            raise RuntimeError("CUDA error: device-side assert triggered")
        self.acts += 1
        self.observe(Obs(info={"value": obs.info.get("value", 0)}))
        position = obs.state["position"][:1] if obs.state else np.zeros(1)
        return Act(-np.asarray(position, np.float32), info=self.told() | {"batch": 1})

    def act_batch(self, obs: Any, sessions: Any) -> list[Act | Exception]:
        acts: list[Act | Exception] = []
        for act in super().act_batch(obs, sessions):
            if isinstance(act, Act):
                act.info["batch"] = len(obs)
            acts.append(act)
        return acts

    def told(self) -> dict[str, Any]:
        """Return the properties of this process and of this session."""
        try:
            ray = importlib.metadata.version("ray")
        except importlib.metadata.PackageNotFoundError:
            ray = None
        return {
            "python": platform.python_version(),
            "numpy": np.__version__,
            "ray": ray,
            self.needs: self.version,
            "prefix": sys.prefix,
            "pid": os.getpid(),
            "parent": os.getppid(),
            "variable": os.environ.get("VARIABLE"),
            "gpus": os.environ.get("CUDA_VISIBLE_DEVICES"),
            "instruction": self.instruction,
            "acts": self.acts,
            "seen": list(self.seen),
            "alive": len(ALIVE),
        }


class Compiling(Telling):
    """A policy that reports the compilation of two sizes, one of which fails."""

    def initialize(self) -> None:
        super().initialize()
        report_progress("compiling 1 rows (1 of 2)")
        report_progress("compiling 2 rows (2 of 2)")
        report_uncompiled("2 rows")
        report_device({"kind": "cuda", "name": "a GPU"})


class Unpicklable(Telling):
    """A policy whose sessions cannot be moved."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        told = super().reset(obs, instruction, **kwargs)
        self.lock = open(os.devnull)  # noqa: SIM115
        return told


class Broken(Telling):
    """A policy that fails to load."""

    def initialize(self) -> None:
        raise FileNotFoundError("no checkpoint here")


class Dying(Telling):
    """A policy whose process ends while it loads."""

    def initialize(self) -> None:
        print("the driver is too old", file=sys.stderr, flush=True)
        os._exit(3)


class Able(Agent):
    """A policy with the abilities whose protocols its config names. Each method returns its name,
    the episode's instruction and its arguments.
    """

    def __new__(cls, protocols: Sequence[str] = ()) -> Able:
        body: dict[str, Any] = {}
        for name in protocols:
            protocol = named_class(name)
            for member in members(protocol):
                is_method = inspect.isfunction(getattr(protocol, member, None))
                body[member] = _described(member) if is_method else value_of(member)
        able: Able = object.__new__(type("Able", (cls,), body) if body else cls)
        return able

    def __init__(self, protocols: Sequence[str] = ()) -> None:
        self.instruction: str | None = None

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.instruction = instruction
        return {}

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(1, np.float32))


@dataclass(frozen=True, eq=False)
class PreparedValue:
    """A value that `Preparing` prepares from an observation."""

    value: float
    at_s: float  # time of the preparation, from `time.monotonic`


# living prepared values of this process
PREPARED: weakref.WeakSet[PreparedValue] = weakref.WeakSet()


class Preparing(Agent):
    """A policy with slow batches. It returns the value prepared for each observation, and the time
    between the preparation and the batch.
    """

    contract = Contract(action=ActionSpec(dim=1))

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {"alive": len(PREPARED)}

    def prepare(self, obs: Obs) -> PreparedValue:
        if obs.info.get("wrong"):
            raise ValueError("not an observation")
        prepared = PreparedValue(obs.info["value"], time.monotonic())
        PREPARED.add(prepared)
        return prepared

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        begun_s = time.monotonic()
        time.sleep(max(one.info.get("batch_s", 0.02) for one in obs))
        acts: list[Act | Exception] = []
        for one in obs:
            prepared = one.prepared
            told = {"pixel": int(one.cameras["front"][0, 0, 0]), "value": one.info["value"]}
            if prepared is not None:
                told |= {"prepared": prepared.value, "ahead_s": begun_s - prepared.at_s}
            acts.append(Act(np.zeros(1), info=told))
        return acts


class OnGpu(Agent):
    """A policy that reports like a policy on a GPU: passes with the duration in the observation,
    replays of a CUDA graph, and exhausted memory.
    """

    shared: ClassVar[tuple[str, ...]] = ("report",)
    contract = Contract(action=ActionSpec(dim=1))

    def initialize(self) -> None:
        with current_report() as self.report:
            pass

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {}

    def act(self, obs: Obs) -> Act:
        if obs.info.get("full"):
            self.report.on_out_of_memory()
        self.report.on_gpu_ms(obs.info["value"])
        CudaGraph.replays += 2
        return Act(np.zeros(1))


def value_of(member: str) -> dict[str, Any]:
    """Return the value of an attribute of `Able`, in a form that a server accepts as an id of
    weights.
    """
    return {"digest": f"value of {member}", "revision": None}


def _described(member: str) -> Callable[..., Any]:
    def method(self: Able, *args: Any, **kwargs: Any) -> list[Any]:
        seen = [value.info if isinstance(value, Obs) else value for value in args]
        return [member, self.instruction, seen, kwargs]

    return method
