"""Policies that integration tests serve. Ray's workers import this module through PYTHONPATH."""

from __future__ import annotations

import ctypes
import gc
import os
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from eval_fakes import ToZero, wait_for
from open_resources import unpooled_threads
from shared_cpu_memory import SharedCpuMemory

from vlagents_ray import Act, Agent, Obs, TrainableAgent
from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.policies.scripted import Scripted


class Reacher(Agent):
    """A policy written as in the paper, without regard to sessions: its state is in attributes,
    some of them mutable.
    """

    def __init__(self, scale: float = 1.0) -> None:
        self.scale = scale
        self.history: list[int] = []

    def initialize(self) -> None:
        self.counts = {"act": 0}

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        self.instruction = instruction
        self.first = int(obs.cameras["front"][0, 0, 0])
        return {"pid": os.getpid(), "instruction": instruction}

    def act(self, obs: Obs) -> Act:
        self.counts["act"] += 1
        self.history.append(obs.info["value"])
        total = sum(self.history) * self.scale
        return Act(
            np.array([self.counts["act"], total, self.first], np.float32),
            info={"instruction": self.instruction, "pid": os.getpid(), "value": obs.info["value"]},
        )


class Trainable(TrainableAgent):
    """A policy whose action is its one parameter, which is large enough for Ray's object store."""

    trainable = "tree"

    def initialize(self) -> None:
        self.tree = {"gain": np.zeros(200_000, np.float32)}

    def act(self, obs: Obs) -> Act:
        return Act(self.tree["gain"][:2].copy())


class OnOneGpu(TrainableAgent):
    """A torch policy on the same GPU as its learner; on the CPU, shared memory takes the place of
    the GPU's memory.
    """

    trainable = "layer"

    def __init__(self, device: str = "cpu") -> None:
        self.device = device

    def initialize(self) -> None:
        import torch

        if self.device == "cpu":
            SharedCpuMemory().install()
        self.layer = torch.nn.Linear(500, 400, device=self.device).requires_grad_(False)

    def act(self, obs: Obs) -> Act:
        return Act(np.array(self.layer.weight[:2, 0].cpu()))


class Remembering(Agent):
    """A policy that uses the last three observations, which its contract declares."""

    contract = Contract(history=3)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        self.instruction, self.seed = instruction, kwargs.get("seed")
        self.seen = deque([obs.info["value"]], maxlen=3)
        return {"pid": os.getpid()}

    def observe(self, obs: Obs) -> None:
        self.seen.append(obs.info["value"])

    def act(self, obs: Obs) -> Act:
        self.observe(obs)
        info = {"instruction": self.instruction, "seed": self.seed, "pid": os.getpid()}
        return Act(np.array(self.seen, np.float32), info=info)


class Ledger(Agent):
    """A policy that writes each act to a file of its process when the batch begins, with the
    episode and the number of the observation.
    """

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        self.episode, self.acts = instruction, 0
        return {"pid": os.getpid()}

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        begun = time.monotonic_ns()
        with open(f"{self.folder}/{os.getpid()}", "a") as file:
            for one, session in zip(obs, sessions, strict=True):
                print(begun, session.episode, one.info["episode"], one.info["number"], file=file)  # type: ignore[attr-defined]
        return super().act_batch(obs, sessions)

    def act(self, obs: Obs) -> Act:
        time.sleep(obs.info.get("slow_s", 0.002))
        self.acts += 1
        info = {
            "episode": self.episode,
            "number": obs.info["number"],
            "acts": self.acts,
            "pid": os.getpid(),
        }
        return Act(np.zeros(7, np.float32), info=info)


class Located(Agent):
    """A policy that counts the acts of a session, and returns its process id."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        self.acts = 0
        return {"pid": os.getpid()}

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        return Act(np.array([self.acts], np.float32), info={"pid": os.getpid()})


class Hanging(Agent):
    """A policy that never returns from an act if the observation requests it: it waits ("sleep"),
    or also keeps the GIL ("lock").
    """

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        self.acts = 0
        return {"pid": os.getpid()}

    def act(self, obs: Obs) -> Act:
        if obs.info.get("hang") == "sleep":
            threading.Event().wait()
        if obs.info.get("hang") == "lock":
            ctypes.PyDLL(None).sleep(10_000)
        self.acts += 1
        return Act(np.array([self.acts], np.float32), info={"pid": os.getpid()})


class Gated(Agent):
    """A policy that loads when the file GATE appears, and creates the file GATE.loading while it
    waits.
    """

    def __init__(self, gate: str) -> None:
        self.gate = gate

    def initialize(self) -> None:
        Path(f"{self.gate}.loading").touch()
        while not Path(self.gate).exists():
            time.sleep(0.02)

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(1))


class Broken(Agent):
    """A policy that fails to load."""

    def initialize(self) -> None:
        raise FileNotFoundError("no checkpoint here")

    def act(self, obs: Obs) -> Act:
        raise AssertionError("it does not load")


class Accountant(Agent):
    """A policy that, on request, reports the resources of its process: descriptors, threads,
    mappings of clients' memory, and bytes.
    """

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        if not kwargs.get("count"):
            return {}
        gc.collect()
        # Return free memory to the system, so that only memory in use is counted.
        ctypes.CDLL(None).malloc_trim(0)
        process = psutil.Process()
        return {
            "descriptors": process.num_fds(),
            "threads": len(unpooled_threads()),
            "maps": Path("/proc/self/maps").read_text().count("memfd:vlagents-ray"),
            "resident": process.memory_info().rss,
        }

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(7, np.float32))


class Echo(Agent):
    """A policy that returns the values that it received, and the resources of its process. If the
    observation names a `gate`, it first waits until that file exists.
    """

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        self.instruction = instruction
        return {"pid": os.getpid()}

    def act(self, obs: Obs) -> Act:
        if (gate := obs.info.get("gate")) is not None:
            wait_for(Path(gate).exists)
        info = {
            "instruction": self.instruction,
            "echo": obs.info.get("echo"),
            "big": bytes(obs.info.get("reply_bytes", 0)),
            "threads": threading.active_count(),
            "descriptors": len(os.listdir("/proc/self/fd")),
        }
        return Act(
            np.array([float(image[-1, -1, -1]) for image in obs.cameras.values()]), info=info
        )


class Ticking(Agent):
    """A policy that returns after 0.2 s. Each row contains the tick of its observation and the
    row's number.
    """

    contract = Contract(
        state={"tick": StateSpec(1)}, action=ActionSpec(dim=2, delta=False), chunk=50
    )

    def act(self, obs: Obs) -> Act:
        time.sleep(0.2)
        rows = np.arange(50.0)
        return Act(
            np.stack([np.full(50, obs.state["tick"][0]), rows], 1).astype(np.float32),
            info={"pid": os.getpid()},
        )


class Witness(Agent):
    """A policy whose action has a pixel of the first camera, the first state, the gripper, the
    length of the instruction, and the number of the act in its session. It returns two rows; the
    second has the next number.
    """

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        self.instruction, self.acts = instruction or "", 0
        return {"instruction": instruction, "options": dict(kwargs)}

    def act(self, obs: Obs) -> Act:
        time.sleep(obs.info.get("sleep_s", 0.0))
        self.acts += 1
        image = next(iter(obs.cameras.values()), np.zeros((1, 1, 3), np.uint8))
        joints = next(iter(obs.state.values()), np.zeros(1))
        seen = [
            image[0, -1, 0],
            joints[0],
            -1.0 if obs.gripper is None else obs.gripper,
            len(self.instruction),
        ]
        info = {"cameras": sorted(obs.cameras), "state": sorted(obs.state), "pid": os.getpid()}
        return Act(np.array([[*seen, self.acts], [*seen, self.acts + 1]], np.float32), info=info)


class Mirror(Agent):
    """A policy whose actions identify the observation: a pixel, the sum of the first state, the
    number of calls, and the number in the instruction.

    A white picture takes it two seconds, or, if the instruction begins with a path, until that file
    exists.
    """

    contract = Contract(
        instruction=True, action=ActionSpec(dim=7, gripper_open=1.0, gripper_closed=0.0)
    )

    def __init__(self, chunk: int = 1, slow_s: float = 0.0) -> None:
        self.chunk = chunk
        self.slow_s = slow_s

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        self.gate, self.number, self.acts = (
            Path(instruction.split()[0]),
            float(instruction.split()[-1]),
            0,
        )
        return {"pid": os.getpid()}

    def act(self, obs: Obs) -> Act:
        if obs.info.get("unnorm_key") == "broken":
            raise RuntimeError("/no/path/of/ours")
        pixel = float(obs.cameras["front"][-1, -1, -1])
        white = obs.cameras["front"].min() == 255
        if white and self.gate.is_absolute():
            wait_for(self.gate.exists)
        else:
            time.sleep(2.0 if white else self.slow_s)
        self.acts += 1
        total = float(next(iter(obs.state.values())).sum()) if obs.state else 0.0
        row = [
            pixel,
            total,
            self.acts,
            self.number,
            0.0,
            0.0,
            0.0 if obs.gripper is None else obs.gripper,
        ]
        rows = np.tile(np.array(row, np.float32), (self.chunk, 1))
        rows[:, 4] = np.arange(self.chunk)
        return Act(rows)


class BatchedMirror(Mirror):
    """`Mirror` with batches; it records their sizes."""

    def __init__(self) -> None:
        super().__init__(chunk=2)
        self.sizes: list[int] = []

    def shared_objects(self) -> list[object]:
        return [self.sizes]

    def act_batch(self, obs: list[Obs], sessions: list[Any]) -> list[Act]:
        self.sizes.append(len(obs))
        return [
            session.act(observation) for session, observation in zip(sessions, obs, strict=True)
        ]


class TwoArms(Mirror):
    """`Mirror` for two arms with six joints and a gripper each."""

    contract = replace(
        Mirror.contract, action=ActionSpec(dim=14, gripper_open=1.0, gripper_closed=0.0)
    )

    def act(self, obs: Obs) -> Act:
        return Act(np.pad(super().act(obs).action, ((0, 0), (0, 7))))


class Stored(Agent):
    """A policy whose checkpoint is a file with a number, which its actions contain. It waits to
    load while the file "….held" exists next to it, and creates the files "….begun" and "….closed".
    """

    def __init__(
        self, checkpoint: str, checkpoint_step: int | None = None, scale: float = 1.0
    ) -> None:
        self.path = checkpoint.replace("{step}", str(checkpoint_step))
        self.scale = scale

    def initialize(self) -> None:
        Path(f"{self.path}.begun").touch()
        while Path(f"{self.path}.held").exists():
            time.sleep(0.02)
        self.number = float(Path(self.path).read_text()) * self.scale
        find_checkpoint(self.path)  # computes the digest by which the checkpoint is known

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        self.steps = 0
        return {"pid": os.getpid(), "options": kwargs}

    def act(self, obs: Obs) -> Act:
        self.steps += 1
        return Act(np.array([self.number], np.float32), info={"step": self.steps})

    def close(self) -> None:
        Path(f"{self.path}.closed").touch()


class Stochastic(ToZero):
    """A policy that returns the version of its weights, read from a file, and on request the
    log-probability and the value of its actions.
    """

    def __init__(self, version: str) -> None:
        super().__init__()
        self._version = Path(version)

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=1), behaviour=("logprob", "value"))

    def act(self, obs: Obs) -> Act:
        act, position = super().act(obs), float(obs.state["position"][0])
        said = {
            "logprob": float(-0.5 * ((act.action[0, 0] + position) / 0.1) ** 2),
            "value": -abs(position),
        }
        act.info["policy"] = {"version": int(self._version.read_text()), "fingerprint": "of a test"}
        act.info["behaviour"] = {name: said[name] for name in obs.info.get("want", ())}
        return act


class Hesitant(Scripted):
    """The expert, but with random pauses drawn for each session, so that some episodes run out of
    time.
    """

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.rng = np.random.default_rng(kwargs["seed"])
        return super().reset(obs, instruction, **kwargs)

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        actions = np.stack([act.action for act in super().act_batch(obs, sessions)])  # type: ignore[union-attr]
        dice = np.array([session.rng.random() for session in sessions])  # type: ignore[attr-defined]
        actions[dice < 0.4, :3] = 0.0
        return [Act(row) for row in actions]


class Proportional(TrainableAgent, ToZero):
    """A policy that steps to zero with a gain that a learner trains."""

    trainable = "tree"

    def initialize(self) -> None:
        self.tree = {"gain": np.ones(1, np.float32)}

    def act(self, obs: Obs) -> Act:
        act = super().act(obs)
        return Act(act.action * self.tree["gain"])
