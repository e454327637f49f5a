"""A learner and a replica in two processes that use one GPU, or memory of the CPU in its place."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterator
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from replica_process import ReplicaProcess, model
from shared_cpu_memory import GPU, ReaderCounts, SharedCpuMemory

from vlagents_ray.errors import InvalidWeights, UnchangedWeights
from vlagents_ray.serve.weights import PushOptions
from vlagents_ray.weights import shared_values
from vlagents_ray.weights.shared_values import (
    NotShared,
    SharedValues,
    opened,
    readable_gpus,
    shared,
)
from vlagents_ray.weights.trainable import portable
from vlagents_ray_learn.publisher import AppTarget
from vlagents_ray_learn.weight_push import Values, WeightPusher

pytestmark = pytest.mark.torch

PIN = PushOptions(pin=True)  # otherwise a replica also holds the weights that it loaded


class Application(AppTarget):
    """One of which the only replica is a process of the test, without Ray."""

    def __init__(self, replica: Any) -> None:
        self._app = "Policy"
        self._pusher = WeightPusher(replica, self._others)
        self.sent: list[Any] = []

    async def _others(self) -> list[Any]:
        return []

    def _call(self, method: str, *args: Any, timeout_s: float) -> Any:
        assert method == "push"
        self.sent.append(args[0])
        return asyncio.run(self._pusher.push(*args))


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def memory(device: str, monkeypatch: pytest.MonkeyPatch) -> SharedCpuMemory | None:
    """In place of a GPU's."""
    if device != "cpu":
        return None
    monkeypatch.setattr(shared_values, "_MEMORY", found := SharedCpuMemory())
    return found


@pytest.fixture
def replica(device: str, memory: SharedCpuMemory | None) -> Iterator[ReplicaProcess]:
    with ReplicaProcess(device, gpu=GPU if memory else "") as found:
        yield found


def changed(learner: Any) -> dict[str, np.ndarray]:
    """Take a step, and return copies of the values after it."""
    with torch.no_grad():
        for value in learner.parameters():
            value.add_(1)
    return {name: portable(value).copy() for name, value in learner.state_dict().items()}


def test_a_replica_acts_with_what_was_pushed_whatever_the_learner_does_next(
    replica: ReplicaProcess, device: str
) -> None:
    app, learner = Application(replica), model(device)
    for version in range(1, 5):
        pushed = changed(learner)
        assert app.push(learner.state_dict(), PIN) == version
        changed(learner)  # before the replica acts
        np.testing.assert_equal(replica.ask("values"), pushed)
    assert all(isinstance(values, SharedValues) for values in app.sent)


def test_nobody_holds_more_memory_after_pushes_than_before(
    replica: ReplicaProcess, device: str, memory: SharedCpuMemory | None
) -> None:
    app, learner = Application(replica), model(device)

    def push() -> tuple[Any, int]:
        changed(learner)
        app.push(learner.state_dict(), PIN)
        replica.ask("values")
        return replica.ask("memory"), torch.cuda.memory_allocated() if device == "cuda" else 0

    before = replica.ask("memory")
    first = push()
    assert first[0] == before  # the weights stand there once, and nothing of the learner's is open
    assert [push() for _ in range(5)] == [first] * 5
    if memory is not None:
        assert memory.handles == 0
    else:
        del learner
        assert torch.cuda.memory_allocated() < first[1]  # nothing keeps what was handed over


def test_temporary_values_are_freed_after_each_push(
    replica: ReplicaProcess, device: str, memory: SharedCpuMemory | None
) -> None:
    """Learners push what they gathered or merged for that purpose, as those with FSDP or LoRA."""
    app, learner = Application(replica), model(device)

    def push() -> tuple[int, int]:
        changed(learner)
        merged = {name: value.detach().clone() for name, value in learner.state_dict().items()}
        app.push(merged, PIN)
        replica.ask("values")
        in_limbo = 0 if memory is None else len(memory.counts.limbo)
        del merged
        return in_limbo, torch.cuda.memory_allocated() if device == "cuda" else 0

    first = push()
    assert first[0] == 0
    assert [push() for _ in range(19)] == [first] * 19


@pytest.mark.parametrize("readers", [0, 1, 2, 3])
@pytest.mark.parametrize("late", [False, True])
def test_memory_is_freed_however_often_it_was_read(
    memory: SharedCpuMemory, readers: int, late: bool
) -> None:
    values = {name: value.detach().clone() for name, value in model("cpu").state_dict().items()}
    with ExitStack() as stack:
        with shared(values) as handles:
            for _ in range(readers):
                with opened(handles) as named:
                    if late:  # as the frames of an error keep values, beyond the learner's context
                        stack.callback(list(named.values()).clear)
        assert memory.counts.limbo == []
        assert memory.counts.next == len(handles.storages) > 0
    memory.counts.collect()
    assert memory.counts.limbo == []


def test_counts_with_another_layout_are_released_by_torch_itself(
    memory: SharedCpuMemory, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    released: list[tuple[bytes, int]] = []

    def release(counters: bytes, counter: int) -> None:
        released.append((counters, counter))
        ReaderCounts.release(counters.decode(), counter)

    monkeypatch.setattr(torch.UntypedStorage, "_release_ipc_counter_cuda", release, raising=False)
    monkeypatch.setattr(shared_values, "_FIRST_COUNT", 64 + 8 * 100)
    # An earlier test may have caused the warning, which comes once.
    shared_values._warn_of_counts.cache_clear()
    with shared(model("cpu").state_dict()) as handles:
        assert released == []
    assert [counter for _, counter in released][::-1] == [
        one.counter for one in handles.storages.values()
    ]
    assert caplog.text.count("torch's counts of readers cannot be set (") == 1
    assert memory.counts.limbo == []


def test_the_learner_keeps_its_memory_until_the_replica_has_answered(
    replica: ReplicaProcess, device: str, memory: SharedCpuMemory | None
) -> None:
    if memory is None:
        pytest.skip("handles of CUDA are not counted")
    held: list[int] = []

    class Watched(ReplicaProcess):
        def __init__(self) -> None:
            self._pipe, self._process = replica._pipe, replica._process

        async def stage(self, number: int, values: Values, options: PushOptions) -> str:
            before = memory.handles
            fingerprint = await super().stage(number, values, options)
            held.extend((before, memory.handles))
            return fingerprint

    learner = model(device)
    changed(learner)
    Application(Watched()).push(learner.state_dict(), PIN)
    assert held[0] == held[1] > 0
    assert memory.handles == 0


def test_what_does_not_fit_is_refused_as_ever_and_nothing_stays_open(
    replica: ReplicaProcess, device: str, memory: SharedCpuMemory | None
) -> None:
    app, learner, before = Application(replica), model(device), replica.ask("memory")
    values = learner.state_dict()
    with pytest.raises(UnchangedWeights):
        app.push(values, PIN)
    changed(learner)
    for wrong, message in (
        (
            {**values, "part": torch.full((4,), torch.nan, device=device)},
            "'part': expected finite values, got NaN",
        ),
        ({"part": values["part"]}, "'rough': missing"),
        ({**values, "part": "text"}, "'part': expected an array, got str"),
    ):
        with pytest.raises(InvalidWeights, match=message):
            app.push(wrong, PIN)
    assert replica.ask("memory") == before
    assert replica.ask("newest").number == 0
    assert app.push(values, PIN) == 1
    assert all(isinstance(sent, SharedValues) for sent in app.sent)


def test_without_a_gpu_in_common_the_object_store_is_used_and_the_log_says_why(
    replica: ReplicaProcess,
    device: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    if device != "cpu":
        pytest.skip("one GPU is enough")

    async def found(values: Any) -> Any:
        return values

    monkeypatch.setattr("ray.put", found)
    caplog.set_level(logging.INFO)
    app, learner = Application(replica), model(device)
    monkeypatch.setattr(shared_values, "_MEMORY", another := SharedCpuMemory("GPU-another"))
    pushed = changed(learner)
    assert app.push(learner.state_dict(), PIN) == 1
    np.testing.assert_equal(replica.ask("values"), pushed)
    assert [type(sent) for sent in app.sent] == [SharedValues, list]
    assert (
        f"replica replica can copy only memory of GPU {GPU}, but the learner's memory is on GPU "
        "GPU-another"
    ) in caplog.text
    assert another.handles == 0


def test_memory_that_cannot_be_opened_is_said_to_be_so(
    device: str, memory: SharedCpuMemory | None
) -> None:
    if memory is None:
        pytest.skip("one GPU is enough")
    with shared(model(device).state_dict()) as values:
        memory.uuid = "GPU-another"
        message = (
            f"the learner's memory on GPU {GPU} cannot be opened: this process does not use "
            "that GPU"
        )
        with pytest.raises(NotShared, match=message), opened(values):
            pass


def test_memory_of_a_peer_gpu_is_copied_from_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_values, "_MEMORY", SharedCpuMemory("GPU-of-the-learner"))
    with ReplicaProcess("cpu", gpu=f"{GPU} GPU-of-the-learner") as replica:
        app, learner = Application(replica), model("cpu")
        pushed = changed(learner)
        app.push(learner.state_dict(), PIN)
        np.testing.assert_equal(replica.ask("values"), pushed)
        assert [type(values) for values in app.sent] == [SharedValues]


def test_the_gpus_that_can_be_read_are_the_visible_ones_with_access(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    monkeypatch.setattr(
        torch.cuda, "get_device_properties", lambda device: SimpleNamespace(uuid=f"GPU-{device}")
    )
    monkeypatch.setattr(
        torch.cuda, "can_device_access_peer", lambda own, other: {own, other} == {0, 1}
    )
    assert [readable_gpus(gpu) for gpu in ("GPU-0", "GPU-1", "GPU-2", "")] == [
        ("GPU-0", "GPU-1"),
        ("GPU-0", "GPU-1"),
        ("GPU-2",),
        (),
    ]
