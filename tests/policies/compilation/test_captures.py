"""CUDA graphs on a simulated GPU: what they record, and which work must not run during a
capture.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from fake_cuda import FakeCuda, HostCopies
from in_flight import checked, submit
from torch.overrides import _get_current_function_mode_stack

from vlagents_ray import Obs
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, PolicyFailed, PolicyUnavailable
from vlagents_ray.interface import Act, Agent
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row
from vlagents_ray.policies.capturable import Capturable
from vlagents_ray.policies.compilation import (
    ACT_PRIORITY,
    CAPTURES,
    Compilation,
    CompileMode,
    CudaGraph,
    GraphMemory,
    held,
)
from vlagents_ray.policies.flow import FlowPasses
from vlagents_ray.policies.loading import loading_report, report_device
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.queue.preparation import Preparations
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


def compiled(
    cuda: FakeCuda, function: Callable[..., Any], index: int = 0, mode: CompileMode = "require"
) -> tuple[Callable[..., Any], Compilation]:
    compilation = Compilation(mode)
    core = compilation.core("core", function)
    for size in (4, 2, 1):
        compilation.add_size(size, lambda size=size: core(numbers(cuda, size, index)))  # type: ignore[misc]
    return core, compilation


MODES = ("graphs", "require")


@pytest.mark.parametrize("mode", MODES)
def test_policies_on_two_devices_are_each_captured_on_their_own(
    cuda: FakeCuda, mode: CompileMode
) -> None:
    cores = []
    for index in (0, 1):
        w = weight(cuda, index)
        core, compilation = compiled(cuda, lambda x, w=w: (x @ w).tanh(), index, mode)  # type: ignore[misc]
        assert [device.index for device in compilation.memories] == [index]
        cores.append((core, w, index))
    for rows in (1, 2, 3, 4):
        for core, w, index in cores:
            x = numbers(cuda, rows, index)
            same(core(x), (x @ w).tanh())


@pytest.mark.parametrize("mode", MODES)
def test_a_held_argument_is_changed_in_place_and_not_copied_again(
    cuda: FakeCuda, mode: CompileMode
) -> None:
    def function(x: Any, cache: Any) -> Any:
        return x + cache.sum(1)

    compilation = Compilation(mode)
    core = compilation.core("next token", function)

    def call(rows: int) -> Any:
        return core(numbers(cuda, rows), cuda.tensor(torch.randn(rows, 5, DIM)))

    for size in (4, 2):
        compilation.add_size(size, lambda size=size: call(size))  # type: ignore[misc]

    for rows in (1, 2, 3, 4):
        cache = cuda.tensor(torch.randn(rows, 5, DIM))
        in_graph = held(core, 1, cache)
        assert in_graph.data_ptr() != cache.data_ptr()
        for entry in range(3):
            x = numbers(cuda, rows)
            same(core(x, in_graph), function(x, in_graph))
            in_graph[:, entry] = float(entry)
        assert held(core, 1, in_graph).data_ptr() == in_graph.data_ptr()

    for other in (torch.randn(5, 5, DIM), torch.randn(2, 6, DIM)):  # no graph has these sizes
        cache = cuda.tensor(other)
        assert held(core, 1, cache) is cache
    cache = cuda.tensor(torch.randn(2, 5, DIM))
    assert held(function, 1, cache) is cache  # nothing is compiled


def elsewhere(cuda: FakeCuda, function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a version of a function that runs on another stream than the current one, which a
    capture does not record.
    """
    side = torch.cuda.Stream()

    def run(x: Any) -> Any:
        with torch.cuda.stream(side):
            return function(x)

    return run


NAMES = {"graphs": "CUDA graph", "require": "torch.compile"}


def compiles_to(
    monkeypatch: pytest.MonkeyPatch, change: Callable[[Callable[..., Any]], Callable[..., Any]]
) -> None:
    monkeypatch.setattr(torch, "compile", lambda function, **_: change(function))


def refused(
    cuda: FakeCuda, monkeypatch: pytest.MonkeyPatch, mode: CompileMode, function: Callable[..., Any]
) -> str:
    """Return the report of a mode whose last stage has this function in place of the core."""
    eager = (lambda x: x.tanh() + x) if mode == "require" else function
    compiles_to(monkeypatch, lambda _: function)
    with loading_report(lambda _: None) as report:
        core, compilation = compiled(cuda, eager, mode=True if mode == "require" else mode)
    x = numbers(cuda)
    same(core(x), eager(x))
    assert len(report.uncompiled) == 3
    # The graph of the eager core remains.
    assert compilation.sizes == ([1, 2, 4] if mode == "require" else [])
    return report.uncompiled[0]


@pytest.mark.parametrize("mode", MODES)
def test_a_graph_that_recorded_nothing_is_refused(
    cuda: FakeCuda, monkeypatch: pytest.MonkeyPatch, mode: CompileMode
) -> None:
    said = refused(cuda, monkeypatch, mode, elsewhere(cuda, lambda x: x.tanh() + x))
    assert said.startswith(
        f"4 rows: 'core' by {NAMES[str(mode)]}: RuntimeError: the CUDA graph is empty"
    )
    with pytest.raises(
        ConfigError,
        match="compile: require: 'core' by CUDA graph: RuntimeError: the CUDA graph is em",
    ):
        compiled(cuda, elsewhere(cuda, lambda x: x.tanh()))


@pytest.mark.parametrize("mode", MODES)
def test_a_graph_that_missed_a_part_is_refused(
    cuda: FakeCuda, monkeypatch: pytest.MonkeyPatch, mode: CompileMode
) -> None:
    part = elsewhere(cuda, lambda x: x.tanh())
    said = refused(cuda, monkeypatch, mode, lambda x: part(x) + x)
    assert said.startswith(f"4 rows: 'core' by {NAMES[str(mode)]}: expected results within")
    with pytest.raises(ConfigError, match="'core' by CUDA graph: expected results within"):
        compiled(cuda, lambda x: part(x) + x)


def test_without_a_compiler_the_graphs_of_eager_cores_stay(
    cuda: FakeCuda, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(function: Any) -> Any:
        raise RuntimeError("Cannot find a working triton installation")

    compiles_to(monkeypatch, missing)
    for mode in ("graphs", True):
        cuda.replays.clear()
        with loading_report(lambda _: None) as report:
            core, _ = compiled(cuda, torch.tanh, mode=mode)
        x = numbers(cuda)
        np.testing.assert_array_equal(core(x).values, x.values.tanh())
        assert cuda.replays
        reasons = [
            f"{n} rows: 'core' by torch.compile: RuntimeError: Cannot find a working triton"
            for n in (4, 2, 1)
        ]
        assert [said[: len(reasons[0])] for said in report.uncompiled] == (
            reasons if mode is True else []
        )
    with pytest.raises(
        ConfigError, match=r"require: 'core' by torch.compile: RuntimeError: Cannot find"
    ):
        compiled(cuda, torch.tanh)


@pytest.mark.parametrize(
    ("eager", "compiled_ones", "used"), [(100, 97, 97), (100, 98, 100), (100, 120, 100), (2, 1, 1)]
)
def test_what_torch_compiles_is_used_if_it_is_faster_by_three_percent(
    cuda: FakeCuda, monkeypatch: pytest.MonkeyPatch, eager: int, compiled_ones: int, used: int
) -> None:
    def doubled(times: int) -> Callable[[Any], Any]:
        def function(x: Any) -> Any:
            for _ in range(times - 1):
                x = -x
            return x.abs()

        return function

    compiles_to(monkeypatch, lambda _: doubled(compiled_ones))
    core, _ = compiled(cuda, doubled(eager))
    cuda.replays.clear()
    core(numbers(cuda))
    assert [len(graph.calls) for graph in cuda.replays] == [used]  # number of operations


def test_the_graphs_of_a_policy_share_memory_and_the_largest_is_made_first(cuda: FakeCuda) -> None:
    compilation, w = Compilation("graphs"), weight(cuda)
    halves = [
        compilation.core("a", lambda x: x @ w),
        compilation.core("b", lambda x: (x * 2, x - 1)),
    ]

    def act(x: Any) -> Any:
        return [core(x) for core in (*halves, *halves)]

    for size in (4, 2):
        compilation.add_size(size, lambda size=size: act(numbers(cuda, size)))  # type: ignore[misc]
    assert (
        len({id(graph.pool) for graph in cuda.captures})
        == len({graph.stream for graph in cuda.captures})
        == 1
    )
    assert [len(graph.calls[0][1]) for graph in cuda.captures] == [4, 4, 2, 2]
    assert {graph.stream.priority for graph in cuda.captures} == {ACT_PRIORITY}
    assert cuda.reserved[0] == (4 + 2) * 3 * DIM * 4
    assert compilation.graph_bytes > cuda.reserved[0], "the inputs also take memory"
    compiled(cuda, torch.tanh)
    assert len({id(graph.pool) for graph in cuda.captures}) == 2
    # Each replay overwrites the results of all other graphs in the pool.
    for rows in (1, 2, 3, 4, 2):
        x = numbers(cuda, rows)
        first, (second, third), again, _ = act(x)
        for got, wanted in ((first, x @ w), (second, x * 2), (third, x - 1), (again, x @ w)):
            same(got, wanted)


def test_constants_from_the_host_are_copied_before_the_capture(cuda: FakeCuda) -> None:
    def masked(x: Any) -> Any:
        mask = torch.tensor([1.0] + [0.0] * (DIM - 1), device=x.device)
        return x * mask + torch.tensor(2.0, device=x.device)

    with HostCopies(cuda):
        core, compilation = compiled(cuda, masked, mode="graphs")
        x = numbers(cuda)
        assert compilation.sizes == [1, 2, 4]
        same(core(x), masked(x))
        with pytest.raises(
            torch.AcceleratorError, match="operation failed due to a previous error"
        ):
            CudaGraph(masked, [x])


def test_only_a_core_with_constants_from_the_host_is_watched_while_it_is_captured(
    cuda: FakeCuda,
) -> None:
    """Observing each operation slows down the capture, for which other policies wait."""
    modes: list[int] = []

    def without_constants(x: Any) -> Any:
        modes.append(len(_get_current_function_mode_stack()))
        return torch.cat([x, torch.tensor([], device=x.device).view(0, DIM)])

    def with_constants(x: Any) -> Any:
        modes.append(len(_get_current_function_mode_stack()))
        return x * torch.tensor([2.0] * DIM, device=x.device)

    with HostCopies(cuda):
        for function, watched in ((without_constants, [2, 1, 1, 1]), (with_constants, [2] * 4)):
            modes.clear()
            x = numbers(cuda)
            graph = CudaGraph(Capturable(function), [x.clone()])
            assert modes == watched
            same(graph(x), function(x))


def test_casts_of_autocast_are_not_kept_beyond_it() -> None:
    """The cache ends with the context in which a graph was captured, but the graph still reads this
    memory.
    """
    layer, cached = torch.nn.Linear(DIM, DIM), list[bool]()

    def function(x: Any) -> Any:
        cached.append(torch.is_autocast_cache_enabled())
        return layer(x)

    with torch.autocast("cpu", torch.bfloat16):
        assert Capturable(function)(torch.ones(1, DIM)).dtype == torch.bfloat16
        assert torch.is_autocast_cache_enabled()
    assert cached == [False]


STEPS = 3


class Passes(FlowPasses):
    """The passes of a model without layers."""

    def encode(
        self, tokens: Any, mask: Any, cameras: Any, state: Any, *images: Any
    ) -> tuple[Any, Any]:
        return tokens.float()[:, :1] + state, mask.long()

    def velocity(self, constants: Sequence[Any], actions: Any, times: Any) -> Any:
        encoded, seen, _ = constants
        return (actions * times[:, None, None] + (encoded * seen.float()[:, :1])[:, None]).tanh()


def drawn(cuda: FakeCuda, rows: int) -> dict[str, Any]:
    """Return random arguments for `sample`."""
    return {
        "images": [],
        "cameras": [cuda.tensor(torch.ones(rows, dtype=torch.bool))],
        "tokens": cuda.tensor(torch.randint(9, (rows, 4))),
        "mask": cuda.tensor(torch.ones(rows, 4, dtype=torch.bool)),
        "state": numbers(cuda, rows),
        "noise": cuda.tensor(torch.randn(rows, 2, DIM)),
        "owners": range(rows),
        "steps": STEPS,
    }


@pytest.mark.parametrize("mode", MODES)
def test_a_flow_is_one_graph_and_one_of_each_step_if_steps_are_changed(
    cuda: FakeCuda, mode: CompileMode
) -> None:
    compilation = Compilation(mode)
    passes, plain = Passes(cuda, compilation), Passes(cuda, Compilation(False))
    for size in (4, 1):
        compilation.add_size(size, lambda size=size: passes.sample(**drawn(cuda, size)))  # type: ignore[misc]
    assert [core.name for core in compilation.cores] == ["encode", "velocity", "flow"]
    assert [core.tier(size) for core in compilation.cores for size in (1, 4)] == ["CUDA graph"] * 6
    for rows in (1, 2, 4):
        for changes, replays in (
            ((), 2),
            ([lambda velocity, actions, time: velocity - time * actions], 1 + STEPS),
        ):
            inputs = drawn(cuda, rows) | {"changes": changes}
            wanted = plain.sample(**inputs)
            cuda.replays.clear()
            same(passes.sample(**inputs), wanted)
            assert len(cuda.replays) == replays
    cuda.replays.clear()
    # No graph has so many rows.
    same(passes.sample(**(inputs := drawn(cuda, 5))), plain.sample(**inputs))
    assert cuda.replays == []


def test_the_graph_of_a_flow_has_the_compiled_steps(
    cuda: FakeCuda, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiles_to(
        monkeypatch,
        lambda function: (
            lambda *tensors: tanh_alone(*tensors) if len(tensors) == 5 else function(*tensors)
        ),
    )

    def tanh_alone(encoded: Any, seen: Any, state: Any, actions: Any, times: Any) -> Any:
        """Compute the velocity in fewer operations, for a mask of ones."""
        return torch.addcmul(encoded[:, None], actions, times[:, None, None]).tanh()

    compilation = Compilation(True)
    passes, plain = Passes(cuda, compilation), Passes(cuda, Compilation(False))
    compilation.add_size(2, lambda: passes.sample(**drawn(cuda, 2)))
    assert [core.tier(2) for core in compilation.cores] == [
        "CUDA graph",
        "torch.compile",
        "torch.compile",
    ]
    cuda.replays.clear()
    same(passes.sample(**(inputs := drawn(cuda, 2))), plain.sample(**inputs))
    assert len(cuda.replays) == 2


def test_after_a_capture_that_failed_the_thread_is_on_its_stream_again(cuda: FakeCuda) -> None:
    before = torch.cuda.current_stream()

    def waits(x: Any) -> Any:
        if cuda.capture is not None:
            torch.cuda.synchronize()
        return x.tanh()

    with pytest.raises(
        torch.AcceleratorError, match="operation failed due to a previous error during capture"
    ):
        CudaGraph(waits, [numbers(cuda)])
    assert torch.cuda.current_stream() is before


class Waiting(Agent):
    """A policy that waits for its whole device in each call."""

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
    """Capture a graph, begin something on another thread during the capture, and return the result
    of that work, which must end after the capture.
    """
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
def test_an_act_that_waits_for_the_device_waits_for_the_end_of_a_capture(
    cuda: FakeCuda, op: Any
) -> None:
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


class OnStreams(Waiting):
    """A policy that records the stream of each of its calls."""

    shared: ClassVar[tuple[str, ...]] = ("streams",)

    def initialize(self) -> None:
        self.streams: dict[str, list[Any]] = {}
        self._note("initialize")

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self._note("reset")
        return {}

    def prepare(self, obs: Obs) -> None:
        self._note("prepare")

    def act(self, obs: Obs) -> Act:
        self._note("act")
        return Act(np.zeros(1, np.float32))

    def load_parameters(self, values: Any) -> None:
        self._note("load")

    def _note(self, call: str) -> None:
        self.streams.setdefault(call, []).append(torch.cuda.current_stream())


def test_all_calls_of_a_policy_are_on_one_stream_which_has_priority_over_pushes(
    cuda: FakeCuda,
) -> None:
    agent = OnStreams()
    engine = Engine(agent)
    engine.start()
    replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
    default, preparations = torch.cuda.current_stream(), Preparations()
    try:
        for op in ("reset", "act"):
            submit(engine, "a", Request(op, Obs()), replies.put)  # type: ignore[arg-type]
            assert replies.get(timeout=10).error is None
        acts = engine.model.require_loaded().acts
        assert acts is not None
        preparation = preparations.begin(agent, Obs(), acts)
        assert preparation is not None
        preparation.future.result(timeout=10)
    finally:
        preparations.close()
        engine.close()
    assert agent.streams.pop("initialize") == [default]
    assert agent.streams.keys() == {"reset", "prepare", "act"}
    assert {stream for streams in agent.streams.values() for stream in streams} == {acts._stream}
    assert acts._stream.priority < default.priority == 0
    # Work of the policy outside of its calls is ordered relative to them.
    assert default in acts._stream.waited_for
    assert acts._stream in default.waited_for


def test_a_push_waits_for_the_end_of_a_capture(cuda: FakeCuda) -> None:
    weights = ModelWeights(Waiting(), threading.Lock())
    pushed = {"w": np.zeros(2, np.float32)}
    assert (
        captured_beside(cuda, lambda: on_a_thread(lambda: weights.stage(1, pushed, PushOptions())))
        == weights._staged.fingerprint
    )  # type: ignore[union-attr]
    weights.drop(1)


def test_memory_for_another_process_is_finished_without_a_wait_for_the_device(
    cuda: FakeCuda,
) -> None:
    def function(x: Any) -> Any:
        if cuda.capture is not None:
            assert on_a_thread(lambda: _GpuMemory().finish(x.device)).get(timeout=10) is None
        return x.tanh()

    CudaGraph(function, [numbers(cuda)])


def test_a_capture_that_waits_for_a_push_delays_no_act_and_is_not_starved_by_acts(
    cuda: FakeCuda,
) -> None:
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


def test_a_capture_waits_for_its_warm_up_and_frees_memory_before_it_blocks_acts(
    cuda: FakeCuda,
) -> None:
    memory = GraphMemory(torch.device("cuda", 0))
    emptied, deadline = cuda.emptied, time.monotonic() + 10
    with CAPTURES:
        graph = on_a_thread(lambda: CudaGraph(lambda x: x.tanh(), [numbers(cuda)], memory))
        while not CAPTURES._capturing:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert (cuda.emptied - emptied, memory.stream.synchronized) == (1, 1)
        assert not cuda.captures
    assert isinstance(graph.get(timeout=10), CudaGraph)


def test_a_capture_may_not_begin_within_an_act_of_its_thread(cuda: FakeCuda) -> None:
    with CAPTURES, pytest.raises(RuntimeError, match="within an act"):
        CudaGraph(lambda x: x.tanh(), [numbers(cuda)])


class OnGpu(ModelPolicy):
    """A model on the simulated GPU, whose actions are a linear layer of noise."""

    Config = ModelConfig
    cuda: ClassVar[FakeCuda]
    kind = "cuda"  # the reported kind

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=DIM), chunk=self.chunk(1))

    def load(self) -> Any:
        report_device({"kind": self.kind})
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


def test_a_model_that_sleeps_frees_its_graphs_and_weights_and_acts_the_same_when_it_wakes(
    cuda: FakeCuda,
) -> None:
    OnGpu.cuda = cuda
    policy = OnGpu.from_config({"checkpoint": "none", "compile": "require", "batch_sizes": [1, 2]})
    policy.initialize()

    def act() -> Any:
        policy.reset(Obs(), "go", seed=3)
        return policy.act(Obs()).action

    first, made = act(), len(cuda.captures)
    policy.sleep()
    moved: list[tuple[Any, Any]] = []
    to_host([policy.model, policy.model], moved)
    assert [memory.nbytes() for memory, _ in moved] == [0]
    assert (policy.compilation.sizes, policy.compilation.memories) == ([], {})
    from_host(moved)
    policy.wake()
    assert (len(cuda.captures), policy.compilation.sizes) == (2 * made, [1, 2])
    replayed = len(cuda.replays)
    np.testing.assert_array_equal(act(), first)
    assert len(cuda.replays) == replayed + 1, "the result must come from a graph"


def test_a_model_on_a_gpu_acts_from_graphs_in_less_memory_and_until_the_gpu_fails(
    cuda: FakeCuda,
) -> None:
    OnGpu.cuda = cuda
    policy = OnGpu.from_config(
        {"checkpoint": "none", "compile": "require", "batch_sizes": [1, 2, 4]}
    )
    engine = Engine(policy)
    engine.start()

    def act(rows: int) -> list[Reply]:
        replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
        tickets = []
        for op in ("reset", "act"):
            given: dict[str, Any] = {"instruction": "go"} if op == "reset" else {}
            tickets = []
            for seed in range(rows):
                request = Request(
                    op, Obs(), **given, kwargs={"seed": seed} if op == "reset" else {}
                )  # type: ignore[arg-type]
                tickets.append(checked(engine, str(seed), request, replies.put))
            engine.queue.put(*tickets)
            found = [replies.get(timeout=10) for _ in tickets]
        return found

    def actions(replies: Sequence[Reply]) -> list[Any]:
        return sorted(reply.act.action.tolist() for reply in replies if reply.act is not None)

    try:
        assert engine.model.devices == [{"kind": "cuda", "matmul": "high", "graphs_mib": 0.0}]
        alone = actions(act(4))
        assert len(alone) == 4
        cuda.most_rows = 2
        assert actions(act(4)) == alone
        assert policy.most_rows == 2
        engine.health.check()
        cuda.fail()
        assert all(isinstance(reply.error, PolicyFailed) for reply in act(4))
        with pytest.raises(PolicyUnavailable, match="device-side assert"):
            engine.health.check()
    finally:
        engine.close()


class OnCpu(OnGpu):
    """The same model on a CPU."""

    kind = "cpu"


class WithoutCores(OnGpu):
    """A model on the simulated GPU without compiled cores."""

    def load(self) -> Any:
        loaded = super().load()
        self.compilation.cores.clear()
        return loaded


@pytest.mark.parametrize(
    ("kind", "mode", "decided"),
    [
        (OnGpu, "auto", "graphs"),
        (OnCpu, "auto", False),
        (WithoutCores, "auto", False),
        (OnGpu, False, False),
        (OnGpu, "graphs", "graphs"),
        (OnGpu, True, True),
        (OnCpu, True, True),
    ],
)
def test_the_device_and_the_family_decide_unless_the_settings_do(
    cuda: FakeCuda, caplog: pytest.LogCaptureFixture, kind: type[OnGpu], mode: Any, decided: Any
) -> None:
    OnGpu.cuda = cuda
    caplog.set_level("INFO")
    policy = kind.from_config(
        {"checkpoint": "none"} | ({} if mode == "auto" else {"compile": mode})
    )
    with loading_report(lambda _: None, [1, 2]):
        policy.initialize()
    assert (policy.config.compile, policy.compilation.mode) == (decided, decided)
    assert policy.config.batch_sizes == ([1, 2] if decided else None)
    assert policy.compilation.sizes == ([1, 2] if decided else [])
    assert ("compile: auto:" in caplog.text) == (mode == "auto")


def test_graphs_alone_are_for_gpus(cuda: FakeCuda) -> None:
    OnGpu.cuda = cuda
    with pytest.raises(
        ConfigError, match="compile: graphs: expected a model on 'cuda', got one on 'cpu'"
    ):
        OnCpu.from_config({"checkpoint": "none", "compile": "graphs"}).initialize()
