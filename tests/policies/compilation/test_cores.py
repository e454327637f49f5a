"""Compiled cores: their results, the time of compilation, wrong programs, and the cache of
programs.
"""

from __future__ import annotations

import contextlib
import copy
import gc
import os
import shutil
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from counting_compiler import CountingCompiler, counting_compiler

from vlagents_ray import Obs
from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.interface import SAMPLES, Act
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.model_inputs import state_vector
from vlagents_ray.policies.compilation import Compilation, keep_jax_programs, keep_torch_programs
from vlagents_ray.policies.loading import LoadingReport, loading_report
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings

pytestmark = pytest.mark.torch

DIM, HORIZON = 3, 4
WORDS = "go"


class Linear(ModelPolicy):
    """A model whose chunk is a linear layer of the state and of the session's noise."""

    Config = ModelConfig
    trainable = "model"
    refused = False  # whether each observation is rejected

    @property
    def contract(self) -> Contract:
        return Contract(
            state={"joints": StateSpec(DIM)}, action=ActionSpec(dim=DIM), chunk=self.chunk(HORIZON)
        )

    def load(self) -> Any:
        torch.manual_seed(0)
        model = torch.nn.Linear(DIM, HORIZON * DIM).requires_grad_(False)
        self.pass_of = self.compilation.core("linear", self._layer(model))
        return model

    def _layer(self, model: Any) -> Callable[..., Any]:
        def layer(states: Any, noise: Any) -> Any:
            return model(states).tanh().unflatten(1, (HORIZON, DIM)) + 0.1 * noise

        return layer

    def perceive(self, obs: Obs) -> np.ndarray:
        if self.refused:
            raise InvalidObservation("joints: refused")
        return state_vector(obs, ["joints"], DIM)

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        states = np.stack([row.frames[-1] for row in rows])
        noise = np.stack([row.noise(HORIZON, DIM) for row in rows])
        with torch.inference_mode():
            chunks = self.pass_of(torch.from_numpy(states), torch.from_numpy(noise))
        return [Prediction(chunk) for chunk in chunks.numpy()]


class Breaking(Linear):
    """A model whose code breaks the graph."""

    def _layer(self, model: Any) -> Callable[..., Any]:
        layer = super()._layer(model)

        def breaking(states: Any, noise: Any) -> Any:
            torch._dynamo.graph_break()
            return layer(states, noise)

        return breaking


@pytest.fixture
def compiler() -> Iterator[CountingCompiler]:
    with counting_compiler() as compiler:
        yield compiler


def made(kind: type[Linear] = Linear, **config: Any) -> Linear:
    policy = kind.from_config({"checkpoint": "none", **config})
    policy.initialize()
    return policy


def loaded(kind: type[Linear] = Linear, **config: Any) -> tuple[Linear, LoadingReport, list[str]]:
    steps: list[str] = []
    with loading_report(steps.append) as report:
        return made(kind, **config), report, steps


def acted(policy: Linear, seeds: Sequence[int], **info: Any) -> list[np.ndarray]:
    rng = np.random.default_rng(7)
    views = [
        Obs(state={"joints": rng.normal(size=DIM).astype(np.float32)}, info=info)
        for _ in range(max(seeds) + 1)
    ]
    sessions = [copy.copy(policy) for _ in seeds]
    for session, seed in zip(sessions, seeds, strict=True):
        session.reset(views[seed], WORDS, seed=seed)
    acts = policy.act_batch([views[seed] for seed in seeds], sessions)
    return [act.action for act in acts if isinstance(act, Act)]


def test_batches_of_any_size_act_as_without_compilation(compiler: CountingCompiler) -> None:
    plain, compiled = made(), made(compile="require", batch_sizes=[1, 2, 4])
    for size in (1, 2, 3, 4, 5, 9):
        before = compiler.calls
        for one, other in zip(acted(plain, range(size)), acted(compiled, range(size)), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-6)
        assert compiler.calls > before


def test_programs_are_made_once_while_the_policy_loads(compiler: CountingCompiler) -> None:
    sizes = list(range(1, 13))  # more sizes than torch allows for one function
    policy, report, steps = loaded(compile="require", batch_sizes=sizes)
    assert (compiler.rows, policy.compilation.sizes, report.uncompiled) == (sizes[::-1], sizes, [])
    assert steps == [f"compiling {size} rows ({13 - size} of 12)" for size in sizes[::-1]]
    acted(policy, range(5))
    # The policy's thread may differ from the thread that loads it.
    other = threading.Thread(target=acted, args=(policy, range(7)))
    other.start()
    other.join()
    acted(policy, range(5), **{SAMPLES: 2})
    assert compiler.rows == sizes[::-1]


def test_pushed_weights_act_at_once_without_another_program(compiler: CountingCompiler) -> None:
    plain, compiled = made(), made(compile="require", batch_sizes=[2])
    before = acted(compiled, [0])[0]
    for policy in (plain, compiled):
        policy.load_parameters({name: value + 0.5 for name, value in policy.parameters().items()})
    after = acted(compiled, [0])[0]
    np.testing.assert_allclose(after, acted(plain, [0])[0], atol=1e-6)
    assert np.abs(after - before).max() > 0.1
    assert compiler.rows == [2]


def test_one_program_for_tensors_of_any_kind(compiler: CountingCompiler) -> None:
    compilation, plain = Compilation("require"), torch.arange(12.0).reshape(4, 3)
    core = compilation.core("sum", lambda numbers: numbers.sum(-1))
    with torch.inference_mode():
        compilation.add_size(4, lambda: core(plain))
        for numbers in (plain, plain.clone(), plain.clone().T.contiguous().T, plain[:2]):
            assert core(numbers).tolist() == [3.0, 12.0, 21.0, 30.0][: len(numbers)]
    assert compiler.rows == [4]


def test_rows_of_another_shape_run_without_a_program(compiler: CountingCompiler) -> None:
    compilation = Compilation("require")
    core = compilation.core("sum", lambda numbers: numbers.sum(-1))
    compilation.add_size(2, lambda: core(torch.ones(2, 3)))
    calls = compiler.calls
    assert core(torch.ones(2, 4)).tolist() == [4, 4]
    assert (compiler.rows, compiler.calls) == ([2], calls)
    assert core(torch.ones(1, 3)).tolist() == [3]
    assert compiler.calls == calls + 1


def test_a_closed_policy_keeps_no_weights(compiler: CountingCompiler) -> None:
    policy = made(compile="require", batch_sizes=[2])
    acted(policy, [0, 1])
    weights = weakref.ref(next(policy.model.parameters()))
    del policy.pass_of
    policy.close()
    gc.collect()
    assert weights() is None


def test_usual_sizes_if_neither_the_settings_nor_a_server_name_some(
    compiler: CountingCompiler,
) -> None:
    assert made(compile="require").compilation.sizes == [1, 2, 4, 8, 16]
    assert made().config.batch_sizes is None


@pytest.mark.parametrize(
    ("batch", "own", "sizes"),
    [
        ({"max_batch_size": 1}, None, [1]),
        ({"max_batch_size": 6}, None, [1, 2, 4, 6]),
        ({"max_batch_size": 8}, None, [1, 2, 4, 8]),
        ({"max_batch_size": 5, "batch_sizes": [3, 5]}, None, [3, 5]),
        ({"max_batch_size": 5, "batch_sizes": [3, 5]}, [1, 2], [1, 2]),
    ],
)
def test_the_sizes_are_those_of_the_deployments_batches_unless_the_settings_name_others(
    compiler: CountingCompiler, batch: dict[str, Any], own: list[int] | None, sizes: list[int]
) -> None:
    policy = Linear.from_config({"checkpoint": "none", "compile": "require", "batch_sizes": own})
    with contextlib.closing(Engine(policy, EngineSettings(**batch))) as engine:
        engine.start()
        assert (policy.compilation.sizes, policy.config.batch_sizes) == (sizes, sizes)
        assert sorted(compiler.rows) == sizes


def test_a_policy_that_is_not_compiled_keeps_any_size_in_a_server() -> None:
    policy = Linear.from_config({"checkpoint": "none"})
    with contextlib.closing(Engine(policy, EngineSettings(max_batch_size=6))) as engine:
        engine.start()
        assert policy.config.batch_sizes is None


@pytest.mark.parametrize(
    "wrong", [lambda out: out + 0.01, lambda out: out * float("nan"), lambda out: out.flip(0)]
)
def test_a_program_with_other_results_is_not_used(
    compiler: CountingCompiler, caplog: pytest.LogCaptureFixture, wrong: Callable[[Any], Any]
) -> None:
    compiler.change[2] = wrong
    policy, report, _ = loaded(compile=True, batch_sizes=[1, 2, 3])
    assert policy.compilation.sizes == [1, 3]
    [said] = report.uncompiled
    assert said.startswith("2 rows: 'linear' by torch.compile: expected results within 0.001 of")
    assert "expected results within 0.001 of" in caplog.text
    for one, other in zip(acted(made(), [0, 1]), acted(policy, [0, 1]), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


@pytest.mark.parametrize("kept", [(0,), (1,), (0, 1)])
def test_a_program_that_keeps_an_input_of_its_first_call_is_not_used(
    monkeypatch: pytest.MonkeyPatch, kept: tuple[int, ...]
) -> None:
    """An incomplete CUDA graph behaves like this: it keeps some values from its capture."""

    def stale(graph: Any, examples: Sequence[Any]) -> Callable[..., Any]:
        first: list[Any] = []

        def program(*inputs: Any) -> Any:
            # The model's weights are also inputs; the core's own inputs have as many rows as the
            # batch.
            first.extend([] if first else [one.clone() for one in inputs])
            own = [i for i, one in enumerate(inputs) if not isinstance(one, torch.nn.Parameter)]
            for i in (own[place] for place in kept):
                inputs = (*inputs[:i], first[i], *inputs[i + 1 :])
            return graph(*inputs)

        return program

    monkeypatch.setattr(Compilation, "backend", staticmethod(stale))
    with pytest.raises(
        ConfigError, match=r"compile: require: 'linear' by torch.compile: expected results within"
    ):
        made(compile="require", batch_sizes=[2])
    torch._dynamo.reset()


def test_a_program_is_not_made_with_the_inputs_with_which_it_is_compared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kept: list[Any] = []

    def stale(graph: Any, examples: Sequence[Any]) -> Callable[..., Any]:
        def program(*inputs: Any) -> Any:
            kept.extend([] if kept else [graph(*inputs)])
            return kept[0]

        return program

    monkeypatch.setattr(Compilation, "backend", staticmethod(stale))
    compilation, always = Compilation("require"), torch.ones(2, 3)
    core = compilation.core("sum", lambda numbers: numbers.sum(-1))
    with pytest.raises(ConfigError, match=r"'sum' by torch.compile: expected results within"):
        compilation.add_size(2, lambda: core(always))
    torch._dynamo.reset()


def test_an_action_while_another_model_is_built_makes_no_program(
    compiler: CountingCompiler,
) -> None:
    """transformers sets torch's default dtype for all threads while it builds a model."""
    policy = made(compile="require", batch_sizes=[2])
    expected, calls = acted(policy, range(2)), compiler.calls

    usual = torch.get_default_dtype()
    torch.set_default_dtype(torch.bfloat16)
    try:
        actions = acted(policy, range(2))
    finally:
        torch.set_default_dtype(usual)

    np.testing.assert_array_equal(actions, expected)
    assert (compiler.rows, compiler.calls) == ([2], calls + 1)


def test_each_comparison_has_inputs_of_its_own(compiler: CountingCompiler) -> None:
    """A program that is correct only for the inputs of its compilation is not used."""
    right = iter([True, True])  # the first call, and the first comparison
    compiler.change[2] = lambda out: out if next(right, False) else out + 1
    assert loaded(compile=True, batch_sizes=[2])[0].compilation.sizes == []


def test_the_rounding_of_a_program_is_accepted(compiler: CountingCompiler) -> None:
    compiler.change[1] = lambda out: out * 1.0001
    assert loaded(compile="require", batch_sizes=[1])[0].compilation.sizes == [1]


class Bfloat16Step:
    """A step of a flow in bfloat16. It reads little of the state, and processes both cameras with
    the same layers.
    """

    def __init__(self, steps: int = 1, width: int = 64) -> None:
        torch.manual_seed(0)
        self.steps = steps
        self.layers = torch.nn.ModuleList(
            torch.nn.Linear(width, width) for _ in range(8)
        ).bfloat16()
        self.cameras, self.state, self.actions = (
            torch.randn(n, width) / n**0.5 for n in (16, 8, 6)
        )
        self.output = torch.randn(width, 6) / width**0.5

    def inputs(self, rows: int) -> tuple[Any, ...]:
        return (
            torch.randn(rows, 2, 16).bfloat16(),
            torch.randn(rows, 8).bfloat16(),
            torch.randn(rows, 6),
        )

    def __call__(
        self,
        cameras: Any,
        state: Any,
        actions: Any,
        layers: Any = None,
        dtype: Any = torch.bfloat16,
    ) -> Any:
        layers = layers or self.layers
        for step in range(self.steps):
            front, wrist = (cameras.to(dtype) @ self.cameras.to(dtype)).unbind(1)
            x = front + 0.5 * wrist + 0.2 * state.to(dtype) @ self.state.to(dtype)
            x = x + actions.to(dtype) @ self.actions.to(dtype) + step / self.steps
            for layer in layers:
                x = x + layer(x).tanh()
            actions = actions - (x @ self.output.to(dtype)).float() / self.steps
        return actions


def merged(step: Bfloat16Step) -> Callable[..., Any]:
    """Return the step like kernels that keep float32 between the operations."""
    layers = copy.deepcopy(step.layers).float()
    return lambda *inputs: step(*inputs, layers=layers, dtype=torch.float32)


def sums_in_parts(step: Bfloat16Step) -> Callable[..., Any]:
    """Return the step with sums in another order: two parts, each of which is rounded."""

    def layer_of(layer: Any) -> Callable[[Any], Any]:
        halves = list(zip(layer.weight.chunk(2, 1), (0, 1), strict=True))
        return lambda x: sum(x.chunk(2, 1)[place] @ half.T for half, place in halves) + layer.bias

    layers = [layer_of(layer) for layer in step.layers]
    return lambda *inputs: step(*inputs, layers=layers)


def first_layer_again(step: Bfloat16Step) -> Callable[..., Any]:
    return lambda *inputs: step(*inputs, layers=[step.layers[0], *step.layers[:-1]])


def row_of_the_neighbour(step: Bfloat16Step) -> Callable[..., Any]:
    return lambda cameras, state, actions: step(cameras, torch.cat([state[1:], state[:1]]), actions)


RIGHT: dict[str, Callable[[Bfloat16Step], Any]] = {
    "the same": lambda step: step,
    "merged kernels": merged,
    "other sums": sums_in_parts,
}
WRONG: dict[str, Callable[[Bfloat16Step], Any]] = {
    "velocities too large": lambda step: lambda *inputs: 1.05 * step(*inputs),
    "state never seen": lambda step: (
        lambda cameras, state, actions: step(cameras, 0 * state, actions)
    ),
    "cameras exchanged": lambda step: (
        lambda cameras, state, actions: step(cameras.flip(1), state, actions)
    ),
    "actions too small": lambda step: (
        lambda cameras, state, actions: step(cameras, state, 0.9 * actions)
    ),
    "first layer again": first_layer_again,
    "row of the neighbour": row_of_the_neighbour,
}


CASES = [(name, rows) for name in (*RIGHT, *WRONG) for rows in (1, 3, 8)]
CASES.remove(("row of the neighbour", 1))


@pytest.mark.parametrize("steps", [1, 10])
@pytest.mark.parametrize(("name", "rows"), CASES)
def test_only_programs_within_the_rounding_of_their_checkpoint_are_used(
    monkeypatch: pytest.MonkeyPatch, name: str, rows: int, steps: int
) -> None:
    step, compilation = Bfloat16Step(steps), Compilation(True)
    program = (RIGHT | WRONG)[name](step)
    monkeypatch.setattr(torch, "compile", lambda *_, **__: program)
    core = compilation.core("step", step)
    with torch.inference_mode():
        compilation.add_size(rows, lambda: core(*step.inputs(rows)))
    assert compilation.sizes == ([rows] if name in RIGHT else [])


def test_the_rounding_of_autocast_is_measured_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Inputs and results in float32 hide that the core computes in bfloat16."""
    step = Bfloat16Step()
    layers = copy.deepcopy(step.layers).float()

    def core_of(inputs: Any, dtype: Any = torch.bfloat16) -> Any:
        with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
            for layer in layers:
                inputs = inputs + layer(inputs).tanh()
        return inputs.float()

    for wrong in (False, True):
        compilation = Compilation(True)
        program = (lambda x: 1.05 * core_of(x)) if wrong else (lambda x: core_of(x, torch.float32))
        monkeypatch.setattr(torch, "compile", lambda *_, program=program, **__: program)
        core = compilation.core("step", core_of)
        with torch.inference_mode():
            compilation.add_size(4, lambda core=core: core(torch.randn(4, 64)))  # type: ignore[misc]
        assert compilation.sizes == ([] if wrong else [4])


def test_a_measurement_of_rounding_draws_nothing(compiler: CountingCompiler) -> None:
    """Policies draw from torch's generators, and must act the same with any `compile`."""
    compiler.change[2] = lambda out: out * 1.0015
    before = torch.get_rng_state()
    policy = Linear.from_config({"checkpoint": "none", "compile": True, "batch_sizes": [2]})
    policy.initialize()
    after = torch.get_rng_state()
    torch.set_rng_state(before)
    made()
    assert policy.compilation.sizes == []
    assert torch.equal(after, torch.get_rng_state())


class Candidates(Linear):
    """A model that runs five rows for each row of a batch, at most three at a time, like a planner
    that tries plans.
    """

    def load(self) -> Any:
        model = super().load()
        self.pass_of = partial(
            self._in_passes, self.compilation.core("tried", self._layer(model), rows=3)
        )
        return model

    def _in_passes(self, core: Callable[..., Any], states: Any, noise: Any) -> Any:
        tried = [one.repeat_interleave(5, dim=0).split(3) for one in (states, noise)]
        return torch.cat([core(*each) for each in zip(*tried, strict=True)])[::5]


def test_a_core_of_its_own_number_of_rows_has_one_program_for_all_batches(
    compiler: CountingCompiler,
) -> None:
    policy = made(Candidates, compile="require", batch_sizes=[1, 2])
    assert compiler.rows == [3]
    for seeds in ([0], [0, 1], [0, 1, 2]):
        for one, other in zip(acted(policy, seeds), acted(made(), seeds), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-6)
    assert compiler.rows == [3]


def test_a_program_of_its_own_number_of_rows_that_is_wrong_is_not_used(
    compiler: CountingCompiler,
) -> None:
    compiler.change[3] = lambda out: out + 0.01
    policy, report, _ = loaded(Candidates, compile=True, batch_sizes=[1, 2])
    assert (policy.compilation.sizes, len(report.uncompiled)) == ([], 2)
    np.testing.assert_allclose(acted(policy, [0])[0], acted(made(), [0])[0], atol=1e-6)


def test_what_leaves_the_graph_runs_without_compilation(compiler: CountingCompiler) -> None:
    policy, report, _ = loaded(Breaking, compile=True, batch_sizes=[1, 2])
    assert (policy.compilation.sizes, len(report.uncompiled), compiler.rows) == ([], 2, [])
    np.testing.assert_allclose(acted(policy, [0])[0], acted(made(), [0])[0], atol=1e-6)
    with pytest.raises(ConfigError, match="compile: require: 'linear'"):
        made(Breaking, compile="require", batch_sizes=[1])


def test_an_error_of_the_policy_itself_is_raised(
    compiler: CountingCompiler, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Linear, "refused", True)
    with pytest.raises(InvalidObservation, match="joints: refused"):
        made(compile=True)


LAYERS = 6


class Layer(torch.nn.Module):
    """A layer with its own weights, like the other layers of its model."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.linear = torch.nn.Linear(DIM, DIM).requires_grad_(False)
        self.number = number


def layer_pass(layer: Layer, x: Any) -> Any:
    return x + layer.linear(x).tanh()


@pytest.mark.parametrize("by_regions", [False, True])
def test_layers_share_the_program_of_their_region(
    compiler: CountingCompiler, by_regions: bool
) -> None:
    torch.manual_seed(0)
    compilation = Compilation("require")
    layers = [Layer(number) for number in range(LAYERS)]
    region = compilation.region(layer_pass)

    def model(x: Any) -> Any:
        for layer in layers:
            x = region(layer, x)
        return x

    core = compilation.core("model", model, by_regions=by_regions)
    compilation.add_size(2, lambda: core(torch.randn(2, DIM)))
    assert compiler.rows == [2]

    calls, x = compiler.calls, torch.randn(2, DIM)
    expected = x
    for layer in layers:
        expected = layer_pass(layer, expected)
    torch.testing.assert_close(core(x), expected)
    assert compiler.calls - calls == (LAYERS if by_regions else 1)
    torch.testing.assert_close(model(x), expected)
    assert compiler.calls - calls == (LAYERS if by_regions else 1)  # the model itself stays eager


def test_a_region_with_other_results_is_not_used(compiler: CountingCompiler) -> None:
    compiler.change[2] = lambda result: 1.05 * result
    compilation, layer = Compilation(True), Layer(0)
    region = compilation.region(layer_pass)
    core = compilation.core("model", lambda x: region(layer, x), by_regions=True)
    with loading_report(lambda _: None) as report:
        compilation.add_size(2, lambda: core(torch.randn(2, DIM)))
    [reasons] = report.uncompiled
    assert "'model' by torch.compile: expected results within" in reasons
    x = torch.randn(2, DIM)
    torch.testing.assert_close(core(x), layer_pass(layer, x))


@pytest.mark.parametrize(("mode", "autotunes"), [(True, False), ("require", False), ("max", True)])
def test_torch_measures_kernels_if_that_is_set(
    monkeypatch: pytest.MonkeyPatch, mode: Any, autotunes: bool
) -> None:
    options: list[dict[str, Any]] = []

    def compile_with(function: Callable[..., Any], **settings: Any) -> Callable[..., Any]:
        options.append(settings["options"])
        return function

    monkeypatch.setattr(torch, "compile", compile_with)
    compilation = Compilation(mode)
    core = compilation.core("tanh", torch.tanh)
    compilation.add_size(2, lambda: core(torch.randn(2, DIM)))
    [settings] = options
    assert settings.get("max_autotune", False) == autotunes
    assert not settings.get("triton.cudagraphs", False)
    assert compilation.sizes == [2]


def test_nothing_is_compiled_unless_it_is_set(compiler: CountingCompiler) -> None:
    _, report, steps = loaded(batch_sizes=[1, 2])
    assert (compiler.rows, report.uncompiled) == ([], [])
    assert steps == ["running 1 rows (1 of 2)", "running 2 rows (2 of 2)"]


TORCH = "TORCHINDUCTOR_CACHE_DIR"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Simulate an empty cache of the user."""
    # So that monkeypatch restores the old value: torch and the tested function set it.
    monkeypatch.setenv(TORCH, "")
    monkeypatch.delenv(TORCH)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def jax_with(folder: str | None) -> Any:
    config = SimpleNamespace(jax_compilation_cache_dir=folder)
    config.update = lambda name, value: setattr(config, name, value)
    return SimpleNamespace(config=config)


@pytest.mark.parametrize("chosen", [None, "/tmp/torchinductor_me"])  # unset, or torch's own choice
def test_programs_are_kept_where_only_the_user_may_write(
    cache: Path, monkeypatch: pytest.MonkeyPatch, chosen: str | None
) -> None:
    if chosen is not None:
        monkeypatch.setenv(TORCH, chosen)
    keep_torch_programs()
    keep_jax_programs(jax := jax_with(None), "gpu")
    for folder in (Path(os.environ[TORCH]), Path(jax.config.jax_compilation_cache_dir)):
        assert folder.is_relative_to(cache)
        assert folder.stat().st_mode & 0o777 == 0o700


def test_programs_of_jax_for_a_cpu_are_not_kept(cache: Path) -> None:
    """JAX 0.5.3 computes different results with a program that it has read from the cache."""
    keep_jax_programs(jax := jax_with(None), "cpu")
    assert jax.config.jax_compilation_cache_dir is None
    assert not cache.exists()


def test_a_folder_that_the_user_named_is_kept(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(TORCH, "/mine")
    keep_torch_programs()
    keep_jax_programs(jax := jax_with("/mine"), "gpu")
    assert os.environ[TORCH] == jax.config.jax_compilation_cache_dir == "/mine"
    assert not cache.exists()


def test_a_cache_that_cannot_be_written_is_no_error(
    cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    cache.write_text("a file in the folder's place")
    keep_torch_programs()
    assert TORCH not in os.environ
    assert "compiled programs are not kept" in caplog.text


# A warning of torch's own compiler.
@pytest.mark.filterwarnings("ignore:`torch.jit.:DeprecationWarning")
@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
def test_a_program_is_compiled_once_and_found_at_the_next_start(cache: Path) -> None:
    def start() -> tuple[int, int]:
        """Compile like a new process, and return how many programs were found in the cache and how
        many were not.
        """
        torch._dynamo.reset()
        torch._dynamo.utils.counters.clear()
        compilation = Compilation("require")
        core = compilation.core("core", lambda numbers: (numbers * 2).sin().sum(-1, keepdim=True))
        compilation.add_size(2, lambda: core(torch.ones(2, 3)))
        torch.testing.assert_close(
            core(torch.ones(1, 3)), torch.full((1, 1), 3.0) * torch.tensor(2.0).sin()
        )
        counters = torch._dynamo.utils.counters
        found = (
            counters["aot_autograd"]["autograd_cache_hit"]
            + counters["inductor"]["fxgraph_cache_hit"]
        )
        return min(found, 1), counters["inductor"]["fxgraph_cache_miss"]

    assert start() == (0, 1)
    assert list(cache.rglob("*.so"))
    assert start() == (1, 0)
    torch._dynamo.reset()
