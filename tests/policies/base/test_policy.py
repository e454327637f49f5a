"""The inherited features of all model families: sessions, chunks, samples and batches, tested with
a model of three lines.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from vlagents_ray import Obs
from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.errors import (
    ConfigError,
    InvalidAction,
    InvalidObservation,
    MissingState,
    NotReset,
    NotTrainable,
)
from vlagents_ray.interface import BEHAVIOUR, DELAY, DISTRIBUTION, LEFTOVER, SAMPLES, WANT, Act
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row, shared_frames
from vlagents_ray.policies.base.model_inputs import MOST_SAMPLES, state_specs, state_vector
from vlagents_ray.policies.base.policy import fastest_split
from vlagents_ray.policies.loading import report_device
from vlagents_ray.testing import check_agent

HORIZON, DIM = 4, 2


class Wobble(ModelPolicy):
    """A model whose row h of a chunk is the sum of the last two states, plus h, plus a little of
    the session's noise.
    """

    Config = ModelConfig

    @property
    def history(self) -> int:
        return 2

    @property
    def contract(self) -> Contract:
        chunk = self.chunk(HORIZON)
        return Contract(
            state={"joints": StateSpec(DIM)}, action=ActionSpec(dim=DIM), chunk=chunk, history=2
        )

    def load(self) -> Any:
        return {"batches": []}

    def perceive(self, obs: Obs) -> np.ndarray:
        return state_vector(obs, ["joints"], DIM)

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        self.model["batches"].append(len(rows))
        ramp = np.arange(HORIZON, dtype=np.float32)[:, None]
        return [
            Prediction(sum(row.history(2)) + ramp + 0.01 * row.noise(HORIZON, DIM)) for row in rows
        ]


def made(**config: Any) -> Wobble:
    return Wobble.from_config({"checkpoint": "none", **config})


def at(x: float, **info: Any) -> Obs:
    return Obs(state={"joints": np.full(DIM, x, np.float32)}, info=info)


def begun(policy: Wobble, seed: int = 0) -> Wobble:
    session = made(**policy.config.model_dump(exclude_unset=True, exclude={"checkpoint"}))
    session.model = policy.model
    session.reset(at(0.0), "go", seed=seed)
    return session


def loaded(**config: Any) -> Wobble:
    policy = made(**config)
    policy.initialize()
    return policy


@pytest.mark.slow
@pytest.mark.parametrize(
    "config", [{"actions": "queue"}, {"actions": "ensemble"}, {"batch_sizes": [1, 2, 4]}]
)
def test_keeps_the_contract(config: dict[str, Any]) -> None:
    check_agent(made(**config), steps=2 * HORIZON)


class Stepping(Wobble):
    """A model that draws noise for all rows of a pass twice, like flows with random steps."""

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        first = [row.noise(HORIZON, DIM) for row in rows]
        return [
            Prediction(one - row.noise(HORIZON, DIM)) for one, row in zip(first, rows, strict=True)
        ]


def test_samples_do_not_depend_on_how_a_batch_is_cut_into_passes() -> None:
    found = []
    for most in (64, 3, 2, 1):
        policy = Stepping.from_config({"checkpoint": "none", "max_rows": most})
        policy.initialize()
        sessions = [copy.copy(policy) for _ in range(2)]
        for seed, session in enumerate(sessions):
            session.reset(at(0.0), "go", seed=seed)
        acts = policy.act_batch([at(0.0, **{SAMPLES: 3})] * 2, sessions)
        found.append([act.info[DISTRIBUTION]["samples"] for act in acts if isinstance(act, Act)])
    for other in found[1:]:
        np.testing.assert_array_equal(found[0], other)
    assert np.abs(found[0][0][0] - found[0][0][1]).max() > 0.01


def test_one_forward_pass_for_a_batch_and_padding_to_the_sizes_that_were_warmed_up() -> None:
    policy = loaded(batch_sizes=[2, 4])
    assert policy.model["batches"] == [2, 4]
    policy.act_batch([at(0.0)] * 3, [begun(policy, seed) for seed in range(3)])
    assert policy.model["batches"] == [2, 4, 4]


def test_rows_that_share_observations_are_encoded_in_a_size_of_their_own_or_each() -> None:
    policy = loaded(batch_sizes=[2, 4, 8])
    one, other, third = (Row((seed,), "", np.random.default_rng(seed)) for seed in range(3))
    assert policy.observations_of([one, other, third, third]) == ([0, 1, 2, 3], [0, 1, 2, 3])
    assert policy.observations_of([one, one, one, one]) == ([0, 0], [0, 0, 0, 0])
    assert policy.observations_of([one, one, other, other] * 2) == ([0, 2], [0, 0, 1, 1] * 2)


class Compiled(Wobble):
    """A model that JAX computes."""

    def load(self) -> Any:
        report_device({"kind": "cpu", "jax": "0.5.3"})
        return {"batches": [], "read": set()}

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        self.model["read"].add((len(shared_frames(rows)[0]), len(rows)))
        return super().predict(rows)


def test_sizes_of_rows_that_share_observations_run_while_a_model_of_jax_loads() -> None:
    policy = Compiled.from_config({"checkpoint": "none", "batch_sizes": [1, 2, 4]})
    policy.initialize()
    assert policy.model["read"] == {(1, 1), (1, 2), (1, 4), (2, 2), (2, 4), (4, 4)}


def test_nine_rows_are_a_pass_of_eight_and_one_of_one_where_that_is_faster() -> None:
    policy = loaded(batch_sizes=[1, 8, 16])
    batches, report = policy.model["batches"], policy.report
    sessions = [begun(policy, seed) for seed in range(9)]

    def passes(on: str, **pass_s: float) -> list[int]:
        report.pass_s = {int(size[1:]): took for size, took in pass_s.items()}
        report.splits_by_time = on == "cuda"
        batches.clear()
        acts = policy.act_batch([at(0.0)] * 9, [copy.deepcopy(session) for session in sessions])
        found.append([act.action for act in acts if isinstance(act, Act)])
        return list(batches)

    found: list[list[np.ndarray]] = []
    assert passes("cuda", _1=8.0, _8=8.0, _16=9.0) == [16]
    assert sorted(passes("cuda", _1=1.0, _8=1.0, _16=9.0)) == [1, 8]
    assert passes("cpu", _1=1.0, _8=1.0, _16=9.0) == [16]
    assert passes("cuda", _1=1.0, _8=1.0) == [16], "the pass has not been measured yet"
    for actions in found:
        np.testing.assert_array_equal(actions, found[0])


@pytest.mark.parametrize(
    ("rows", "pass_s", "want"),
    [
        (9, {1: 2.0, 8: 5.0, 16: 9.0}, [1, 8]),
        (9, {1: 4.0, 8: 5.0, 16: 9.0}, [9]),  # one pass takes as long as two
        (16, {1: 1.0, 8: 5.0, 16: 12.0}, [8, 8]),
        (11, {1: 1.0, 2: 1.5, 8: 5.0, 16: 12.0}, [1, 2, 8]),
        (3, {4: 1.0, 8: 5.0}, [3]),
        (1, {1: 1.0}, [1]),
    ],
)
def test_the_split_with_the_shortest_time_is_found(
    rows: int, pass_s: dict[int, float], want: list[int]
) -> None:
    found = fastest_split(rows, tuple(pass_s.items()))
    assert (sorted(found), sum(found)) == (want, rows)


class CountsViews(Wobble):
    """A model whose actions change with the number of encoded views."""

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        firsts, _ = shared_frames(rows)
        return [Prediction(np.full((HORIZON, DIM), len(firsts), np.float32)) for _ in rows]


def test_a_policy_that_names_no_network_cannot_be_quantized() -> None:
    with pytest.raises(ConfigError, match=r"quantization: .* does not offer it"):
        loaded(quantization="int8")


def test_the_named_network_is_quantized_once_loaded_and_no_weights_can_be_pushed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    torchao = ModuleType("torchao.quantization")
    torchao.Float8WeightOnlyConfig = lambda: "float8"
    torchao.quantize_ = lambda network, config: network.update(weights=config)
    monkeypatch.setitem(sys.modules, "torchao", ModuleType("torchao"))
    monkeypatch.setitem(sys.modules, "torchao.quantization", torchao)

    class Quantizable(Wobble):
        network = trainable = "model"

        def load(self) -> dict[str, Any]:
            return {"weights": "whole"}

    policy = Quantizable.from_config({"checkpoint": "none", "quantization": "float8"})
    policy.initialize()
    assert policy.model == {"weights": "float8"}
    with pytest.raises(
        NotTrainable, match="quantization 'float8': a learner cannot push to 8-bit weights"
    ):
        policy.parameters()


@pytest.mark.parametrize("compiled", [True, "max", "require"])
def test_products_of_8_bits_have_a_scale_for_each_row(
    monkeypatch: pytest.MonkeyPatch, compiled: bool | str
) -> None:
    torchao, used = ModuleType("torchao.quantization"), list[Any]()
    torchao.PerRow = lambda: "per row"
    torchao.Float8DynamicActivationFloat8WeightConfig = dict
    torchao.quantize_ = lambda _, config: used.append(config)
    monkeypatch.setitem(sys.modules, "torchao", ModuleType("torchao"))
    monkeypatch.setitem(sys.modules, "torchao.quantization", torchao)
    monkeypatch.setattr(Wobble, "network", "model")
    loaded(quantization="float8_dynamic", compile=compiled)
    assert used == [{"granularity": "per row"}]


@pytest.mark.parametrize("compiled", ["auto", "graphs", False])
def test_products_of_8_bits_are_refused_unless_they_are_compiled(compiled: bool | str) -> None:
    with pytest.raises(
        ConfigError,
        match=r"quantization float8_dynamic: expected compile true, max or require, got",
    ):
        Wobble.from_config(
            {"checkpoint": "none", "quantization": "float8_dynamic", "compile": compiled}
        )


@pytest.mark.parametrize("kind", ["cuda", "cpu"])
@pytest.mark.parametrize("compiled", ["graphs", False, True, "max", "require"])
def test_weights_of_8_bits_on_a_gpu_need_compiled_products(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    kind: str,
    compiled: bool | str,
) -> None:
    monkeypatch.setattr("vlagents_ray.policies.base.policy.quantize", lambda *_: None)
    monkeypatch.setattr(Wobble, "_decide_on_compiling", lambda _: None)
    monkeypatch.setattr(Wobble, "_warm_up", lambda _, **__: None)
    policy = Wobble.from_config({"checkpoint": "none", "quantization": "int8"})
    policy.compilation.mode = compiled  # type: ignore[assignment]
    monkeypatch.setattr(Wobble, "load", lambda _: report_device({"kind": kind, "onnxruntime": "1"}))
    policy.initialize()
    warned = "quantization 'int8' without compile: true" in caplog.text
    assert warned == (kind == "cuda" and compiled in ("graphs", False))


def test_what_torchao_cannot_quantize_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(network: Any, config: Any) -> None:
        raise NotImplementedError("no such kernel")

    torchao = ModuleType("torchao.quantization")
    torchao.Int8WeightOnlyConfig, torchao.quantize_ = object, fail
    monkeypatch.setitem(sys.modules, "torchao", ModuleType("torchao"))
    monkeypatch.setitem(sys.modules, "torchao.quantization", torchao)
    monkeypatch.setattr(Wobble, "network", "model")
    with pytest.raises(
        ConfigError, match=r"cannot use it on this machine \(NotImplementedError: no such kernel\)"
    ):
        loaded(quantization="int8")


def test_padding_has_no_observations_of_its_own() -> None:
    policy = CountsViews.from_config({"checkpoint": "none", "batch_sizes": [4, 8]})
    policy.initialize()
    sessions = [copy.copy(policy) for _ in range(2)]
    for session in sessions:
        session.reset(at(0.0), "go")
    acts = policy.act_batch([at(0.0, **{SAMPLES: 3}), at(1.0)], sessions)
    # Two views instead of eight rows.
    assert [set(act.action.ravel()) for act in acts] == [{2}, {2}]


def test_a_queue_asks_the_model_every_execute_acts_and_remembers_every_observation() -> None:
    policy = loaded(actions="queue", execute=3)
    session = begun(policy)
    rows = [session.act(at(float(x))).action for x in range(4)]
    assert len(policy.model["batches"]) == 2
    # The chunk of the first observation, which counts twice.
    assert [round(float(row[0])) for row in rows[:3]] == [0, 1, 2]
    # The sum of the last two observations, although the model was not called for either alone.
    assert round(float(rows[3][0])) == 2 + 3


def test_an_ensemble_averages_what_the_chunks_say_of_a_tick() -> None:
    session = begun(loaded(actions="ensemble", ensemble_m=0.0))
    first, second = session.act(at(0.0)).action, session.act(at(10.0)).action
    assert first[0] == pytest.approx(0, abs=0.1)
    assert second[0] == pytest.approx((1 + 10) / 2, abs=0.1)


def test_an_ensemble_of_single_rows_is_refused() -> None:
    with pytest.raises(ConfigError, match="nothing to average"):
        loaded(actions="ensemble", execute=1)


@pytest.mark.parametrize("actions", ["queue", "ensemble"])
def test_a_plan_in_whose_place_others_were_executed_is_dropped(actions: str) -> None:
    session = begun(loaded(actions=actions))
    session.act(at(0.0))
    told = session.act(at(10.0, executed_actions=np.ones((3, DIM), np.float32)))
    assert told.action[0] == pytest.approx(10, abs=0.1), (
        "row 0 of the chunk for the scene that a human left"
    )
    assert session.episode is not None
    assert len(session.episode.frames) == 2, "the policy's history must contain its observations"


def test_samples_come_with_their_mean_and_change_no_action() -> None:
    policy = loaded()
    plain, asked = begun(policy), begun(policy)
    wanted = asked.act(at(1.0, **{SAMPLES: 500}))
    assert np.array_equal(wanted.action, plain.act(at(1.0)).action)
    found = wanted.info[DISTRIBUTION]
    assert found["samples"].shape == (500, HORIZON, DIM)
    assert np.allclose(found["mean"], 2.0 + np.arange(HORIZON)[:, None], atol=0.01)
    assert found["std"].mean() == pytest.approx(0.01, rel=0.2)
    assert np.array_equal(asked.act(at(1.0)).action, plain.act(at(1.0)).action)


class Learnt(Wobble):
    """A model that returns the sum of a chunk as its value, and the chunk as its replay data."""

    @property
    def contract(self) -> Contract:
        return replace(super().contract, behaviour=self.offered(("logprob", "replay")))

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        drawn = [
            prediction for prediction in super().predict(rows) if isinstance(prediction, Prediction)
        ]
        said = [{"logprob": one.actions.sum(), "replay": {"chunk": one.actions}} for one in drawn]
        return [
            replace(one, behaviour={name: about[name] for name in row.want})
            for row, one, about in zip(rows, drawn, said, strict=True)
        ]


def learnt(**config: Any) -> Learnt:
    policy = Learnt.from_config({"checkpoint": "none", **config})
    policy.initialize()
    policy.reset(at(0.0), "go", seed=0)
    return policy


def test_what_is_wanted_is_stated_of_the_act_and_of_each_of_its_samples() -> None:
    act = learnt().act(at(1.0, **{WANT: ["logprob", "replay"], SAMPLES: 3}))
    found = act.info[DISTRIBUTION]
    assert act.info[BEHAVIOUR]["logprob"] == act.action.sum()
    np.testing.assert_array_equal(act.info[BEHAVIOUR]["replay"]["chunk"], act.action)
    np.testing.assert_array_equal(found["logprob"], found["samples"].sum((1, 2)))
    np.testing.assert_array_equal(found["replay"]["chunk"], found["samples"])


def test_nothing_is_stated_unless_it_is_wanted() -> None:
    policy = learnt()
    assert BEHAVIOUR not in policy.act(at(1.0)).info
    assert BEHAVIOUR not in policy.act(at(1.0, **{WANT: []})).info
    assert list(policy.act(at(1.0, **{WANT: ["logprob"]})).info[BEHAVIOUR]) == ["logprob"]


def test_only_whole_chunks_are_offered_to_learners() -> None:
    assert learnt().contract.behaviour == ("logprob", "replay")
    assert learnt(actions="queue").contract.behaviour is None
    assert loaded().offered(()) is None


def test_rows_of_which_something_is_wanted_are_drawn_as_samples_are() -> None:
    class Rows(Wobble):
        def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
            self.model["batches"].append([row.sample for row in rows])
            return super().predict(rows)

    policy = Rows.from_config({"checkpoint": "none"})
    policy.initialize()
    policy.reset(at(0.0), "go")
    policy.act(at(0.0, **{SAMPLES: 1}))
    policy.act(at(0.0, **{SAMPLES: 1, WANT: ["logprob"]}))
    assert policy.model["batches"][::2] == [[False, True], [True, True]]


def test_samples_see_what_their_session_sees() -> None:
    rows = [Row((np.full(2, i),), "go", np.random.default_rng(i)) for i in range(2)]
    rows += [
        replace(rows[0]),
        Row((np.full(2, 2),), "go", np.random.default_rng(2)),
        replace(rows[1]),
    ]
    assert shared_frames(rows) == ([0, 1, 3], [0, 1, 0, 2, 1])


@pytest.mark.parametrize(
    ("config", "obs", "error"),
    [
        ({}, Obs(), MissingState),
        ({}, at(0.0, **{WANT: ["logprob"], LEFTOVER: np.zeros((2, DIM))}), InvalidObservation),
        ({}, Obs(state={"joints": np.zeros(3, np.float32)}), InvalidObservation),
        ({}, at(0.0, **{SAMPLES: -1}), InvalidObservation),
        ({"actions": "queue"}, at(0.0, **{SAMPLES: 2}), InvalidObservation),
        ({}, at(0.0, **{SAMPLES: "many"}), InvalidObservation),
        ({}, at(0.0, **{SAMPLES: MOST_SAMPLES + 1}), InvalidObservation),
        ({}, at(0.0, **{DELAY: "2 ticks"}), InvalidObservation),
        ({}, at(0.0, **{LEFTOVER: np.zeros(3)}), InvalidObservation),
        ({}, at(0.0, **{LEFTOVER: "the plan"}), InvalidObservation),
        ({}, at(0.0, **{LEFTOVER: np.zeros((2, DIM + 1))}), InvalidObservation),
    ],
)
def test_a_bad_observation_fails_its_own_session_alone(
    config: dict[str, Any], obs: Obs, error: type[Exception]
) -> None:
    policy = loaded(**config)
    bad, good = policy.act_batch([obs, at(1.0)], [begun(policy), begun(policy)])
    assert isinstance(bad, error)
    assert isinstance(good, Act)


@pytest.mark.parametrize("actions", ["queue", "ensemble"])
def test_a_broken_chunk_fails_one_tick_and_is_kept_for_no_later_one(actions: str) -> None:
    policy = loaded(actions=actions)
    bad, good = begun(policy), begun(policy)
    broken, whole = policy.act_batch([at(np.nan), at(1.0)], [bad, good])
    assert isinstance(broken, InvalidAction)
    assert isinstance(whole, Act)
    bad.episode.frames.clear()  # otherwise the broken observation would be used once more
    assert np.isfinite(bad.act(at(1.0)).action).all()


def test_warms_up_with_a_state_of_several_parts_whose_lengths_are_not_known() -> None:
    class Parts(Wobble):
        @property
        def contract(self) -> Contract:
            return Contract(state=state_specs(("joints", "gripper", "fingers"), 10), gripper=True)

        @property
        def state_dim(self) -> int:
            return 10

        def perceive(self, obs: Obs) -> np.ndarray:
            return state_vector(obs, ("joints", "gripper", "fingers"), 10)[:DIM]

    policy = Parts.from_config({"checkpoint": "none", "batch_sizes": [1, 2]})
    policy.initialize()
    assert policy.model["batches"] == [1, 2]


def test_nothing_acts_before_its_reset() -> None:
    with pytest.raises(NotReset):
        loaded().act(at(0.0))


@pytest.mark.parametrize(
    "config",
    [
        {"checkpoint": "run/{step}"},
        {"checkpoint": "run", "checkpoint_step": 5},
        {"checkpoint": "run", "batch_sizes": [4, 2]},
        {"checkpoint": "run", "horizon": 4},
    ],
)
def test_settings_that_contradict_are_refused(config: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="policy Wobble"):
        Wobble.from_config(config)
