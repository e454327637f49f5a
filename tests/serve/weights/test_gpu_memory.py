"""The memory that pushes of weights need on a simulated GPU, and the streams of their copies."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from fake_cuda import FakeCuda

from vlagents_ray.interface import Act, Obs, TrainableAgent
from vlagents_ray.serve.weights import ModelWeights, PushOptions, WeightsVersion
from vlagents_ray.weights import trainable
from vlagents_ray.weights.trainable import are_apart, copy, fingerprint, portable, set_values

pytestmark = pytest.mark.torch

SIZE = 100_000  # number of elements in a value
MODEL = 4 * 4 * SIZE  # bytes of four values, one of which has two names
KEEP, PARTIAL = PushOptions("keep"), PushOptions(partial=True, allow_same=True)
PART = 4 * 10_000  # bytes that operations on a version need in addition
WORDS = 500  # number of words in a piece of a value, for the fingerprint


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> FakeCuda:
    fake = FakeCuda()
    fake.install(monkeypatch)
    monkeypatch.setattr(trainable, "_AT_ONCE", PART // 4)
    monkeypatch.setattr(trainable, "_WORDS", WORDS)
    monkeypatch.setattr(trainable, "_BUFFER_BYTES", PART)
    monkeypatch.setattr(trainable, "_COPY_BUFFERS", {})
    monkeypatch.setattr(trainable, "_BESIDE", {})
    return fake


class Module(torch.nn.Module):
    """Four values on a GPU; the first has a second name."""

    def __init__(self, cuda: FakeCuda) -> None:
        super().__init__()
        for name in "abcd":
            setattr(self, name, torch.nn.Parameter(cuda.tensor(torch.zeros(SIZE))))
        self.tied = self.a


class OnGpu(TrainableAgent):
    """A policy with its parameters on a GPU."""

    trainable: ClassVar[str | None] = "module"

    def __init__(self, cuda: FakeCuda) -> None:
        self.module = Module(cuda)

    def act(self, obs: Obs) -> Act:
        return Act(
            np.array([float(getattr(self.module, name).detach().values[-1]) for name in "abcd"])
        )


class SelfLoading(OnGpu):
    """A policy with its own method for loading parameters."""

    def load_parameters(self, values: Any) -> None:
        super().load_parameters(values)


class Robot:
    """A session."""

    def __init__(self) -> None:
        self.weights: WeightsVersion | None = None
        self.follows = True


class Pushed:
    """The weights of one model, with a learner and sessions."""

    def __init__(self, cuda: FakeCuda, agent: OnGpu) -> None:
        self.cuda, self.agent = cuda, agent
        self.weights = ModelWeights(agent, threading.Lock())
        self.sessions: list[Robot] = []
        cuda.memory.peak = cuda.memory.allocated

    def begin(self, *, follows: bool, session: Robot | None = None) -> Robot:
        session = session or Robot()
        session.weights = None  # like an engine before a reset
        self.sessions = [*{session: None, **dict.fromkeys(self.sessions)}]
        self.weights.begin(session, follows=follows)
        return session

    def push(self, number: int, options: PushOptions = KEEP) -> None:
        values = {name: np.full(SIZE, number, np.float32) for name in [*"abcd", "tied"]}
        self.weights.stage(number, values, options, lambda: self.sessions)
        self.weights.commit(number, options, lambda: self.sessions)

    def act(self, session: Robot) -> int:
        assert session.weights is not None
        self.weights.use(session.weights)
        [number] = set(self.agent.act(Obs()).action)
        return int(number)

    def peak(self) -> int:
        """Return the peak memory since the last call, in bytes."""
        peak, self.cuda.memory.peak = self.cuda.memory.peak, self.cuda.memory.allocated
        return peak


def test_a_push_needs_the_model_twice_and_gives_one_back(cuda: FakeCuda) -> None:
    pushed = Pushed(cuda, OnGpu(cuda))
    session = pushed.begin(follows=True)
    for number in range(1, 5):
        pushed.push(number)
        assert pushed.act(session) == number
        assert 2 * MODEL <= pushed.peak() <= 2 * MODEL + 2 * PART
        if number > 1:  # the loaded checkpoint is pinned, and has moved to host memory
            assert cuda.memory.allocated == MODEL
    assert cuda.emptied == 0, (
        "torch keeps the memory for the next push, since freeing it would wait for the GPU"
    )
    assert pushed.act(pushed.begin(follows=False)) == 0
    assert pushed.act(session) == 4


def test_sessions_with_two_versions_swap_them_in_their_memory(cuda: FakeCuda) -> None:
    pushed = Pushed(cuda, OnGpu(cuda))
    old, new = pushed.begin(follows=False), pushed.begin(follows=True)
    pushed.push(1)
    pushed.peak()
    before = len(cuda.transfers)
    for _ in range(3):
        assert [pushed.act(one) for one in (old, new)] == [0, 1]
    assert pushed.peak() <= 2 * MODEL + 2 * PART
    assert len(cuda.transfers) == before, "neither of the two is copied to the host"
    pushed.begin(follows=True, session=old)
    pushed.push(2, PushOptions("keep", pin=True))
    assert [pushed.act(one) for one in (old, new)] == [2, 2]
    assert cuda.memory.allocated == MODEL
    assert cuda.emptied == 0


def test_two_pushes_without_an_act_between_them_need_no_more(cuda: FakeCuda) -> None:
    pushed = Pushed(cuda, OnGpu(cuda))
    session = pushed.begin(follows=True)
    pushed.push(1, PushOptions())
    pushed.push(2, PushOptions())
    pushed.push(3, PushOptions())
    assert pushed.peak() <= 2 * MODEL + 2 * PART
    assert pushed.act(session) == 0
    pushed.begin(follows=True, session=session)
    assert pushed.act(session) == 3


def test_a_dropped_version_gives_its_memory_back(cuda: FakeCuda) -> None:
    pushed = Pushed(cuda, OnGpu(cuda))
    pushed.weights.stage(1, {"a": np.ones(SIZE)}, PushOptions(partial=True))
    assert cuda.memory.allocated == 2 * MODEL
    assert pushed.peak() <= 2 * MODEL + 2 * PART, "values of missing names are copied once"
    pushed.weights.drop(1)
    assert (cuda.memory.allocated, cuda.emptied) == (MODEL, 1)


@pytest.mark.parametrize("kind", [OnGpu, SelfLoading])
@pytest.mark.parametrize(
    ("values", "options"),
    [
        ("abcd", PushOptions("keep", allow_same=True)),
        ("abcd", PushOptions("keep")),
        ("d", PushOptions("keep", partial=True)),
        ("d", PushOptions("keep", partial=True, allow_same=True)),
    ],
)
def test_no_push_waits_for_an_act(
    cuda: FakeCuda, kind: type[OnGpu], values: str, options: PushOptions
) -> None:
    pushed = Pushed(cuda, kind(cuda))
    session = pushed.begin(follows=True)
    for number in (1, 2):  # the second push moved the loaded checkpoint to the host, once
        pushed.push(number)
        assert pushed.act(session) == number
    names = [*values, *(["tied"] if "a" in values else [])]
    acting = pushed.weights._busy
    with ThreadPoolExecutor(1) as executor:
        with acting:
            staged = executor.submit(
                lambda: pushed.weights.stage(
                    3, {name: np.full(SIZE, 3, np.float32) for name in names}, options
                )
            )
            done, _ = wait([staged], 60)
            values_of_the_newest = executor.submit(
                lambda: pushed.weights.portable_values(pushed.weights.newest)
            )
            read, _ = wait([values_of_the_newest], 60)
        assert done
        assert read
    assert {float(value[0]) for value in values_of_the_newest.result().values()} == {2.0}
    pushed.weights.commit(3, options, lambda: pushed.sessions)
    assert session.weights is not None
    pushed.weights.use(session.weights)
    assert pushed.agent.act(Obs()).action.tolist() == [3 if name in names else 2 for name in "abcd"]


@pytest.mark.parametrize("kind", [OnGpu, SelfLoading])
def test_a_push_that_reads_values_while_another_version_takes_their_place_reads_them_again(
    cuda: FakeCuda, kind: type[OnGpu], monkeypatch: pytest.MonkeyPatch
) -> None:
    pushed = Pushed(cuda, kind(cuda))
    old, new = pushed.begin(follows=False), pushed.begin(follows=True)
    pushed.push(1)
    assert [pushed.act(old), pushed.act(new)] == [0, 1]
    completed, calls = trainable.completed, []

    def interrupted(held: Any, *args: Any, **options: Any) -> Any:
        calls.append(held)
        if len(calls) == 1:
            with pushed.weights._busy:
                # Version 0 takes the memory of version 1, whose missing values are read.
                pushed.act(old)
        return completed(held, *args, **options)

    monkeypatch.setattr(trainable, "completed", interrupted)
    pushed.weights.stage(2, {"d": np.full(SIZE, 9, np.float32)}, PARTIAL)
    assert len(calls) == 2
    pushed.weights.commit(2, KEEP, lambda: pushed.sessions)
    assert new.weights is not None
    pushed.weights.use(new.weights)
    assert pushed.agent.act(Obs()).action.tolist() == [1, 1, 1, 9]


def test_a_value_with_two_names_is_pushed_by_either(cuda: FakeCuda) -> None:
    pushed = Pushed(cuda, OnGpu(cuda))
    session = pushed.begin(follows=True)
    for number, name in enumerate(["a", "tied"], 1):
        pushed.weights.stage(
            number, {name: np.full(SIZE, number, np.float32)}, PushOptions(partial=True)
        )
        pushed.weights.commit(number, KEEP, lambda: pushed.sessions)
        assert session.weights is not None
        pushed.weights.use(session.weights)
        assert pushed.agent.act(Obs()).action.tolist() == [number, 0, 0, 0]


def test_a_part_of_the_values_completes_a_version_in_the_memory_of_the_host(cuda: FakeCuda) -> None:
    pushed = Pushed(cuda, OnGpu(cuda))
    session = pushed.begin(follows=True)
    pushed.push(1, PushOptions())
    for number in (2, 3):
        pushed.weights.stage(
            number, {"d": np.full(SIZE, 9, np.float32)}, PARTIAL, lambda: pushed.sessions
        )
        pushed.weights.commit(number, PushOptions(), list)
    assert pushed.act(session) == 0
    new = pushed.begin(follows=True)
    for _ in range(2):
        assert pushed.act(session) == 0
        assert new.weights is not None
        pushed.weights.use(new.weights)
        assert pushed.agent.act(Obs()).action.tolist() == [1, 1, 1, 9]
        assert float(pushed.agent.module.tied.detach().values[0]) == 1


def test_an_agent_that_loads_parameters_itself_gets_those_of_a_version(cuda: FakeCuda) -> None:
    pushed = Pushed(cuda, SelfLoading(cuda))
    old, new = pushed.begin(follows=False), pushed.begin(follows=True)
    pushed.push(1)
    for _ in range(2):
        assert [pushed.act(one) for one in (old, new)] == [0, 1]


def test_copies_to_and_from_the_host_run_on_a_stream_of_their_own(cuda: FakeCuda) -> None:
    pushed = Pushed(cuda, OnGpu(cuda))
    session = pushed.begin(follows=True)
    for number in (1, 2):
        pushed.push(number)
        assert pushed.act(session) == number
    [stream] = {stream for stream, _ in cuda.transfers}
    assert stream is not torch.cuda.current_stream()
    assert max(size for _, size in cuda.transfers) <= PART


def test_no_operation_of_a_push_is_on_the_stream_of_the_acts(
    cuda: FakeCuda, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, streams = cuda.run, set()

    def noted(index: int, call: Any, inputs: Any) -> Any:
        streams.add(cuda.current_stream(index))
        return run(index, call, inputs)

    pushed = Pushed(cuda, OnGpu(cuda))
    sessions = [pushed.begin(follows=True), pushed.begin(follows=False)]
    monkeypatch.setattr(cuda, "run", noted)
    for number in (1, 2):
        pushed.push(number)
        for session in sessions:
            pushed.weights.use(session.weights)  # type: ignore[arg-type]
    assert streams
    assert torch.cuda.current_stream() not in streams


def test_a_push_from_the_host_does_not_wait_for_acts_and_a_switch_does(cuda: FakeCuda) -> None:
    pushed, acts = Pushed(cuda, OnGpu(cuda)), torch.cuda.current_stream()
    session = pushed.begin(follows=True)
    pushed.push(1)
    pushed.weights.portable_values(pushed.weights.newest)
    [stream] = trainable._BESIDE.values()
    assert acts not in stream.waited_for
    assert pushed.act(session) == 1
    assert acts in stream.waited_for


def test_a_push_of_a_learner_in_this_process_waits_for_its_computation(cuda: FakeCuda) -> None:
    pushed, learner = Pushed(cuda, OnGpu(cuda)), torch.cuda.Stream()
    values = {name: cuda.tensor(torch.ones(SIZE)) for name in [*"abcd", "tied"]}
    with torch.cuda.stream(learner):
        pushed.weights.stage(1, values, KEEP, lambda: pushed.sessions)
    [stream] = trainable._BESIDE.values()
    assert learner in stream.waited_for


def test_values_of_the_same_gpu_arrive_in_any_layout(cuda: FakeCuda) -> None:
    pushed = Pushed(cuda, OnGpu(cuda))
    session = pushed.begin(follows=True)
    wide = cuda.tensor(torch.arange(2.0 * SIZE).view(SIZE, 2))
    values = {
        name: wide[:, 1].double() if name == "b" else wide[:, 1] for name in [*"abcd", "tied"]
    }
    pushed.weights.stage(1, values, KEEP, lambda: pushed.sessions)
    pushed.weights.commit(1, KEEP, lambda: pushed.sessions)
    assert pushed.act(session) == 2 * SIZE - 1


def test_a_matrix_that_is_transposed_on_the_same_gpu_is_loaded(cuda: FakeCuda) -> None:
    class Square(TrainableAgent):
        trainable: ClassVar[str | None] = "tree"
        tree: ClassVar[dict[str, Any]] = {"w": cuda.tensor(torch.zeros(3, 3))}

    matrix = torch.arange(9.0).view(3, 3)
    weights = ModelWeights(Square(), threading.Lock())
    weights.stage(1, {"w": cuda.tensor(matrix).t()}, KEEP)
    weights.commit(1, KEEP, list)
    weights.use(weights.newest)
    assert torch.equal(Square.tree["w"].values, matrix.t())


def test_the_fingerprint_is_the_same_on_a_gpu(cuda: FakeCuda) -> None:
    for dtype in (torch.float32, torch.bfloat16, torch.uint8, torch.int64):
        values = {
            str(length): (100 * torch.randn(length)).to(dtype)
            for length in (0, 1, 9, WORDS - 1, WORDS, WORDS + 1, 2 * WORDS + 1, 9 * WORDS, 50_003)
        }
        values["500 again"] = values["500"].clone()
        values["tied"] = values["50003"]
        found = fingerprint(values)
        assert fingerprint({name: cuda.tensor(value) for name, value in values.items()}) == found
        assert (
            fingerprint(
                {name: value.numpy() for name, value in values.items() if dtype != torch.bfloat16}
                or values
            )
            == found
        )
        values["500"][[3, 400]] = values["500"][[400, 3]] + 1
        assert fingerprint({name: cuda.tensor(value) for name, value in values.items()}) != found


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.int64])
def test_values_of_any_length_and_type_arrive_bit_for_bit(
    cuda: FakeCuda, dtype: torch.dtype
) -> None:
    for length in (0, 1, 99, 100, 500, 12_345):
        values = (100 * torch.randn(length)).to(dtype)
        target = cuda.tensor(torch.empty(length, dtype=dtype), length % 2)
        copy(values, target)
        assert torch.equal(target.values, values)
        back = torch.empty(length, dtype=dtype)
        copy(target, back)
        assert torch.equal(back, values)
    whole = torch.randn(3, 50, 7)
    halves = cuda.tensor(torch.empty(3, 50, 7, dtype=torch.bfloat16))
    copy(whole, halves)
    assert torch.equal(halves.values, whole.bfloat16())
    assert torch.equal(
        torch.from_numpy(portable(halves).view(np.int16)).view(torch.bfloat16), whole.bfloat16()
    )


def test_tensors_in_each_others_memory_are_not_swapped() -> None:
    memory = torch.randn(12, 4)
    assert are_apart({"a": memory[:6], "b": memory[6:], "tied": memory[:6]})
    assert not are_apart({"a": memory, "b": memory[6:]})
    assert not are_apart({"a": memory, "b": memory.t()})


def test_tensors_of_a_tree_keep_their_addresses(cuda: FakeCuda) -> None:
    held = cuda.tensor(torch.zeros(SIZE))
    tree = {"head": {"weight": held}}
    set_values(tree, {"head/weight": cuda.tensor(torch.ones(SIZE))})
    assert tree["head"]["weight"] is held
    assert held.values.tolist() == [1] * SIZE
