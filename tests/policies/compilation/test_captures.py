"""CUDA graphs on a GPU of a fake torch: what they record, and what may not run beside a capture."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from fake_cuda import FakeCuda
from in_flight import checked, submit

from vlagents_ray import Obs
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, PolicyFailed, PolicyUnavailable
from vlagents_ray.interface import Act, Agent
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row
from vlagents_ray.policies.compilation import CAPTURES, Compilation, CudaGraph
from vlagents_ray.policies.loading import report_device
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.weights import ModelWeights, PushOptions
from vlagents_ray.weights.shared_values import _GpuMemory
from vlagents_ray.weights.trainable import from_host, to_host

pytestmark = pytest.mark.torch

DIM = 3


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeCuda]:
    fake = FakeCuda()
    fake.install(monkeypatch)
    with torch.inference_mode():
        yield fake


def numbers(cuda: FakeCuda, rows: int = 2, index: int = 0) -> Any:
    return cuda.tensor(torch.randn(rows, DIM), index)


def weight(cuda: FakeCuda, index: int = 0) -> Any:
    return cuda.tensor(torch.randn(DIM, DIM), index)


def same(got: Any, wanted: Any) -> None:
    torch.testing.assert_close(got.values, wanted.values)


def test_a_replay_computes_with_its_own_inputs_in_memory_of_its_own(cuda: FakeCuda) -> None:
    w = weight(cuda)
    graph = CudaGraph(lambda x, y: ((x @ w).tanh()[:, :2], x * y), [numbers(cuda), numbers(cuda)])
    inputs = [(numbers(cuda), numbers(cuda)) for _ in range(3)]
    results = [graph(x, y) for x, y in inputs]
    for (x, y), (first, second) in zip(inputs, results, strict=True):
        same(first, (x @ w).tanh()[:, :2])
        same(second, x * y)


def compiled(cuda: FakeCuda, function: Callable[[Any], Any], index: int = 0) -> Callable[[Any], Any]:
    compilation = Compilation("require")
    core = compilation.core("core", function)
    for size in (1, 2):
        compilation.add_size(size, lambda size=size: core(numbers(cuda, size, index)))  # type: ignore[misc]
    return core


def test_policies_on_two_devices_are_each_captured_on_their_own(cuda: FakeCuda) -> None:
    for index in (0, 1):
        w = weight(cuda, index)
        core = compiled(cuda, lambda x, w=w: (x @ w).tanh(), index)  # type: ignore[misc]
        for rows in (1, 2):
            x = numbers(cuda, rows, index)
            same(core(x), (x @ w).tanh())


def elsewhere(cuda: FakeCuda, function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Run a function on another stream than the current one, which a capture does not record."""
    side = torch.cuda.Stream()

    def run(x: Any) -> Any:
        with torch.cuda.stream(side):
            return function(x)

    return run


def test_a_graph_that_recorded_nothing_is_refused(cuda: FakeCuda) -> None:
    with pytest.raises(
        ConfigError, match="compile: require: 'core' by CUDA graph: RuntimeError: the CUDA graph is empty"
    ):
        compiled(cuda, elsewhere(cuda, lambda x: x.tanh()))


def test_a_graph_that_missed_a_part_is_refused(cuda: FakeCuda) -> None:
    part = elsewhere(cuda, lambda x: x.tanh())
    with pytest.raises(ConfigError, match="'core' by CUDA graph: its results are off by"):
        compiled(cuda, lambda x: part(x) + x)


def test_after_a_capture_that_failed_the_thread_is_on_its_stream_again(cuda: FakeCuda) -> None:
    before = torch.cuda.current_stream()

    def waits(x: Any) -> Any:
        if cuda.capture is not None:
            torch.cuda.synchronize()
        return x.tanh()

    with pytest.raises(torch.AcceleratorError, match="operation failed due to a previous error during capture"):
        CudaGraph(waits, [numbers(cuda)])
    assert torch.cuda.current_stream() is before


class Waiting(Agent):
    """Waits for its whole device in each call."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        torch.cuda.synchronize()
        return {}

    def act(self, obs: Obs) -> Act:
        torch.cuda.synchronize()
        return Act(np.zeros(1, np.float32))

    def parameters(self) -> dict[str, Any]:
        torch.cuda.synchronize()
        return {"w": np.ones(2, np.float32)}

    def load_parameters(self, values: Any) -> None:
        torch.cuda.synchronize()


def captured_beside(cuda: FakeCuda, begin: Callable[[], queue.SimpleQueue[Any]]) -> Any:
    """Capture a graph, begin something on another thread meanwhile, and return its result, which comes afterwards."""
    begun: list[queue.SimpleQueue[Any]] = []

    def function(x: Any) -> Any:
        if cuda.capture is not None:
            begun.append(begin())
            with pytest.raises(queue.Empty):
                begun[0].get(timeout=0.2)
        return x.tanh()

    graph, x = CudaGraph(function, [numbers(cuda)]), numbers(cuda)
    same(graph(x), x.tanh())
    return begun[0].get(timeout=10)


def on_a_thread(call: Callable[[], Any]) -> queue.SimpleQueue[Any]:
    results: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def run() -> None:
        try:
            results.put(call())
        except Exception as error:  # noqa: BLE001 - the test asserts on it
            results.put(error)

    threading.Thread(target=run, daemon=True).start()
    return results


@pytest.mark.parametrize("op", ["reset", "act"])
def test_an_act_that_waits_for_the_device_waits_for_the_end_of_a_capture(cuda: FakeCuda, op: Any) -> None:
    engine = Engine(Waiting())
    engine.start()

    def ask(op: Any) -> queue.SimpleQueue[Reply]:
        replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
        submit(engine, "a", Request(op, Obs()), replies.put)
        return replies

    try:
        assert ask("reset").get(timeout=10).error is None
        assert captured_beside(cuda, lambda: ask(op)).error is None
    finally:
        engine.close()


def test_a_push_waits_for_the_end_of_a_capture(cuda: FakeCuda) -> None:
    weights = ModelWeights(Waiting(), threading.Lock())
    pushed = {"w": np.zeros(2, np.float32)}
    assert (
        captured_beside(cuda, lambda: on_a_thread(lambda: weights.stage(1, pushed, PushOptions())))
        == weights._staged.fingerprint
    )  # type: ignore[union-attr]
    weights.drop(1)


def test_memory_for_another_process_is_finished_without_a_wait_for_the_device(cuda: FakeCuda) -> None:
    def function(x: Any) -> Any:
        if cuda.capture is not None:
            assert on_a_thread(lambda: _GpuMemory().finish(x.device)).get(timeout=10) is None
        return x.tanh()

    CudaGraph(function, [numbers(cuda)])


def test_a_capture_that_waits_for_a_push_delays_no_act_and_is_not_starved_by_acts(cuda: FakeCuda) -> None:
    acting, stop = threading.Event(), threading.Event()

    def acts() -> int:
        count = 0
        while not stop.is_set():
            with CAPTURES:
                count += 1
                acting.set()
        return count

    with CAPTURES.pushes:
        graph = on_a_thread(lambda: CudaGraph(lambda x: x.tanh(), [numbers(cuda)]))
        with pytest.raises(queue.Empty):
            graph.get(timeout=0.1)
        acting.clear()
        count = on_a_thread(acts)
        assert acting.wait(10)
    made = graph.get(timeout=10)
    stop.set()
    assert isinstance(made, CudaGraph)
    assert count.get(timeout=10) > 0


def test_a_capture_may_not_begin_within_an_act_of_its_thread(cuda: FakeCuda) -> None:
    with CAPTURES, pytest.raises(RuntimeError, match="within an act"):
        CudaGraph(lambda x: x.tanh(), [numbers(cuda)])


class OnGpu(ModelPolicy):
    """A model on the fake GPU, whose actions are a linear layer of noise."""

    Config = ModelConfig
    cuda: ClassVar[FakeCuda]

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=DIM), chunk=self.chunk(1))

    def load(self) -> Any:
        report_device({"kind": "cuda"})
        w = self.cuda.tensor(torch.eye(DIM))
        self.core = self.compilation.core("layer", lambda x: x @ w)
        return {"w": w}

    def perceive(self, obs: Obs) -> None:
        return None

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        noise = self.cuda.tensor(torch.from_numpy(np.stack([row.noise(1, DIM)[0] for row in rows])))
        with torch.inference_mode():
            chunks = self.core(noise)
        torch.cuda.current_stream().synchronize()
        return [Prediction(chunk[None]) for chunk in chunks.values.numpy()]


def test_a_model_that_sleeps_frees_its_graphs_and_weights_and_acts_the_same_when_it_wakes(cuda: FakeCuda) -> None:
    OnGpu.cuda = cuda
    policy = OnGpu.from_config({"checkpoint": "none", "compile": "require", "batch_sizes": [1, 2]})
    policy.initialize()

    def act() -> Any:
        policy.reset(Obs(), "go", seed=3)
        return policy.act(Obs()).action

    first, made = act(), len(cuda.captures)
    policy.sleep()
    moved = to_host([policy.model, policy.model])
    assert [memory.nbytes() for memory, _ in moved] == [0]
    assert (policy.compilation.sizes, policy.compilation.memories) == ([], {})
    from_host(moved)
    policy.wake()
    assert (len(cuda.captures), policy.compilation.sizes) == (2 * made, [1, 2])
    replayed = len(cuda.replays)
    np.testing.assert_array_equal(act(), first)
    assert len(cuda.replays) == replayed + 1, "from a graph"


def test_a_model_on_a_gpu_acts_from_graphs_in_less_memory_and_until_the_gpu_fails(cuda: FakeCuda) -> None:
    OnGpu.cuda = cuda
    policy = OnGpu.from_config({"checkpoint": "none", "compile": "require", "batch_sizes": [1, 2, 4]})
    engine = Engine(policy)
    engine.start()

    def act(rows: int) -> list[Reply]:
        replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
        tickets = []
        for op in ("reset", "act"):
            given: dict[str, Any] = {"instruction": "go"} if op == "reset" else {}
            tickets = []
            for seed in range(rows):
                request = Request(op, Obs(), **given, kwargs={"seed": seed} if op == "reset" else {})  # type: ignore[arg-type]
                tickets.append(checked(engine, str(seed), request, replies.put))
            engine.queue.put(*tickets)
            found = [replies.get(timeout=10) for _ in tickets]
        return found

    def actions(replies: Sequence[Reply]) -> list[Any]:
        return sorted(reply.act.action.tolist() for reply in replies if reply.act is not None)

    try:
        assert engine.models.devices == [{"kind": "cuda"}]
        alone = actions(act(4))
        assert len(alone) == 4
        cuda.most_rows = 2
        assert actions(act(4)) == alone
        assert policy.most_rows == 2
        engine.check_health()
        cuda.fail()
        assert all(isinstance(reply.error, PolicyFailed) for reply in act(4))
        with pytest.raises(PolicyUnavailable, match="device-side assert"):
            engine.check_health()
    finally:
        engine.close()
