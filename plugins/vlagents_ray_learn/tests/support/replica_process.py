"""A replica of a torch policy in a separate process, which a push in this process reaches."""

from __future__ import annotations

import multiprocessing
import threading
from types import TracebackType
from typing import Any, ClassVar

import numpy as np
from shared_cpu_memory import SharedCpuMemory, files_of_torch

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.interface import Act, Obs, TrainableAgent
from vlagents_ray.serve.weights import (
    FollowingSession,
    HeldVersion,
    ModelWeights,
    NewestVersion,
    PushOptions,
    Rest,
    WeightUpdates,
)
from vlagents_ray.weights.trainable import portable
from vlagents_ray_learn.weight_push import Values, WeightsReplica


def model(device: str) -> Any:
    """Values of many kinds: tied, transposed, of one element, of two precisions, whole numbers,
    on the CPU.
    """
    import torch

    torch.manual_seed(0)
    found = torch.nn.Module()
    found.layer = torch.nn.Linear(64, 32, device=device)
    found.tied = found.layer.weight
    found.turned = torch.nn.Parameter(torch.randn(8, 4, device=device).T)
    found.part = torch.nn.Parameter(torch.randn(16, device=device)[3:7])
    found.rough = torch.nn.Parameter(torch.randn(5, device=device, dtype=torch.bfloat16))
    found.register_buffer("steps", torch.tensor(7, device=device))
    found.register_buffer("mean", torch.randn(3))
    found.register_buffer("empty", torch.zeros(0, device=device))
    return found


class Served(TrainableAgent):
    """Replaces its weights where they are, as on a GPU."""

    trainable: ClassVar[str | None] = "model"

    def __init__(self, device: str) -> None:
        self.device = device

    def initialize(self) -> None:
        self.model = model(self.device)

    def load_parameters(self, values: Any) -> None:
        for name, value in self.parameters().items():
            value.copy_(values[name])

    def act(self, obs: Obs) -> Act:
        raise NotImplementedError


class _Replica:
    """What runs in the other process."""

    def __init__(self, device: str, gpu: str) -> None:
        if gpu:
            SharedCpuMemory(*gpu.split()).install()
        self.agent = Served(device)
        self.agent.initialize()
        self.left_open: set[str] = set()
        self.weights = ModelWeights(self.agent, threading.Lock())
        self.updates = WeightUpdates(self, self)

    @property
    def own_weights(self) -> ModelWeights:
        """The versions of its weights."""
        return self.weights

    def all(self) -> list[FollowingSession]:
        """Its sessions, of which it has none."""
        return []

    def values(self) -> dict[str, np.ndarray]:
        """Act with the newest version, and return its values."""
        self.weights.use(self.weights.newest)
        return {name: portable(value) for name, value in self.agent.parameters().items()}

    def memory(self) -> tuple[int, set[str]]:
        """Bytes of GPU memory in use, and the files of shared memory that were open at any
        answer.
        """
        import torch

        return torch.cuda.memory_allocated() if torch.cuda.is_available() else 0, self.left_open


def _serve(pipe: Any, device: str, gpu: str) -> None:
    replica = _Replica(device, gpu)
    while (asked := pipe.recv()) is not None:
        method, args = asked
        try:
            found = getattr(replica, method, None) or getattr(replica.updates, method)
            answer = found(*args)
        except VLAgentsError as error:
            answer = error  # which holds all local variables of its frames
        replica.left_open |= files_of_torch()
        pipe.send(answer)


class ReplicaProcess(WeightsReplica):
    """The replica in the other process, as the target of a push."""

    name = "replica"

    def __init__(self, device: str, gpu: str = "") -> None:
        """Start it; with a `gpu`, memory of the CPU takes the place of that GPU's."""
        # Forked from a process that has imported torch, which takes 2 s, and used no GPU.
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["torch"])
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, device, gpu), daemon=True)
        self._process.start()

    def ask(self, method: str, *args: Any) -> Any:
        """The result of a method in the other process."""
        self._pipe.send((method, args))
        answer = self._pipe.recv()
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def newest(self) -> NewestVersion:
        newest: NewestVersion = self.ask("newest")
        return newest

    async def stage(self, number: int, values: Values, options: PushOptions) -> str:
        if isinstance(values, list):
            values = await values[0]
        fingerprint: str = self.ask("stage", number, values, options)
        return fingerprint

    async def commit(self, number: int, options: PushOptions) -> None:
        self.ask("commit", number, options)

    async def drop(self, number: int) -> None:
        self.ask("drop", number)

    async def pushed_versions(self) -> list[HeldVersion]:
        versions: list[HeldVersion] = self.ask("pushed_versions")
        return versions

    async def rest(self, rest: Rest) -> None:
        self.ask("rest", rest)

    def __enter__(self) -> ReplicaProcess:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._pipe.send(None)
        self._process.join(60)
