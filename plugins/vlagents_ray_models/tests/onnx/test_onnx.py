"""Policies from ONNX files: the source of each input, the result of a call, and the memory of each
session.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from batch_bits import ROBOTS, differing_acts, invariant
from in_flight import asked
from in_process_replicas import Replicas
from onnx import numpy_helper
from onnx.parser import parse_model

from vlagents_ray import Act, Obs
from vlagents_ray.contract import CameraSpec, StateSpec
from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.policies.base import accelerator
from vlagents_ray.policies.base.checkpoint import used_checkpoints
from vlagents_ray.policies.base.model_inputs import resize_with_pad
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.models.loaded_model import PolicySource
from vlagents_ray.testing import check_agent
from vlagents_ray_models.onnx import Onnx

SESSIONS = 32
RNG = np.random.default_rng(0)
RECURRENT = """g (float[N, 4] x, float[2, N, 8] h) => (float[N, 3] action, float[2, N, 8] h_out) {
    zero = Constant <value_int = 0> ()
    first = Gather <axis = 0> (h, zero)
    drive = MatMul(x, w)
    fed = MatMul(first, u)
    mixed = Add(drive, fed)
    new = Tanh(mixed)
    axes = Constant <value_ints = [0]> ()
    front = Unsqueeze(new, axes)
    h_out = Concat <axis = 0> (front, front)
    action = MatMul(new, v)
}"""
WEIGHTS = {
    name: RNG.normal(size=shape).astype(np.float32) / 2
    for name, shape in (("w", (4, 8)), ("u", (8, 8)), ("v", (8, 3)))
}


def exported(folder: Path, graph: str, /, **weights: np.ndarray) -> Path:
    """Write a model from ONNX's text, and return its file."""
    model = parse_model(f'<ir_version: 8, opset_import: ["": 17, "ai.onnx.ml": 3]> {graph}')
    model.graph.initializer.extend(
        numpy_helper.from_array(value, name) for name, value in weights.items()
    )
    file = folder / "policy.onnx"
    onnx.save(model, file)
    return file


def loaded(file: Path, **settings: Any) -> Onnx:
    policy = Onnx.from_config({"checkpoint": str(file), **settings})
    policy.initialize()
    return policy


def acts(
    policy: Onnx, observations: list[Obs], instruction: str | None = None, **options: Any
) -> list[Act]:
    """Return the results for the observations of a new session."""
    session = AgentCopies(policy).make()
    session.reset(observations[0], instruction, **options)
    return [session.act(obs) for obs in observations]


def action(policy: Onnx, obs: Obs, instruction: str | None = None) -> np.ndarray:
    """Return the first action of a new session, (D,)."""
    return acts(policy, [obs], instruction)[0].action[0]


def state_obs(**state: Any) -> Obs:
    """Return an observation of the state alone."""
    arrays = {}
    for name, values in state.items():
        arrays[name] = np.atleast_1d(np.asarray(values, np.float32))
    return Obs(state=arrays)


def random_joints(count: int, length: int = 4, seed: int = 1) -> list[Obs]:
    rng = np.random.default_rng(seed)
    return [state_obs(joints=rng.normal(size=length)) for _ in range(count)]


@pytest.fixture
def recurrent(tmp_path: Path) -> Path:
    return exported(tmp_path, RECURRENT, **WEIGHTS)


MEMORY = {"state": ["joints"], "recurrent": {"h": "h_out"}}


def test_a_session_acts_to_the_bit_as_onnx_runtime_called_directly(recurrent: Path) -> None:
    runtime, hidden = onnxruntime.InferenceSession(recurrent), np.zeros((2, 1, 8), np.float32)
    observations = random_joints(20)
    results = acts(loaded(recurrent, **MEMORY), observations)
    for obs, act in zip(observations, results, strict=True):
        expected, hidden = runtime.run(None, {"x": obs.state["joints"][None], "h": hidden})
        np.testing.assert_array_equal(act.action, expected)


def test_sessions_of_a_batch_keep_their_own_memory_also_where_some_begin_again(
    recurrent: Path,
) -> None:
    policy, steps = loaded(recurrent, **MEMORY), 12
    assert policy.model.batched
    # The steps at which a session begins an episode.
    begins = [[0, 5 + i % 3] if i % 4 == 0 else [0] for i in range(SESSIONS)]
    observations = [random_joints(steps, seed=i) for i in range(SESSIONS)]
    copies = AgentCopies(policy)
    sessions = [copies.make() for _ in range(SESSIONS)]

    for step in range(steps):
        for i in range(SESSIONS):
            if step in begins[i]:
                sessions[i] = copies.make()
                sessions[i].reset(observations[i][step], None)
        together = policy.act_batch([of_session[step] for of_session in observations], sessions)
        for i, act in enumerate(together):
            assert isinstance(act, Act)
            last_begin = max(begin for begin in begins[i] if begin <= step)
            alone = acts(policy, observations[i][last_begin : step + 1])[-1]
            np.testing.assert_allclose(act.action, alone.action, atol=1e-6)


def test_a_session_that_moves_takes_its_memory_along_and_a_lost_one_computes_it_anew(
    recurrent: Path,
) -> None:
    observations = random_joints(10)
    expected = [act.action for act in acts(loaded(recurrent, **MEMORY), observations)]
    settings = {"checkpoint": str(recurrent), **MEMORY, "burn_in": 9}
    replicas = Replicas([Onnx.from_config(settings) for _ in range(3)])
    try:
        agent = replicas.agent()
        agent.reset(observations[0], None)
        results = [agent.act(obs) for obs in observations[:4]]

        assert replicas.hand_over(0) == 1
        replicas.dead.add(0)
        results += [agent.act(obs) for obs in observations[4:7]]
        assert not any("resumed" in act.info for act in results)

        replicas.dead.add(1)
        results += [agent.act(obs) for obs in observations[7:]]
        assert "resumed" in results[7].info
        agent.close()
    finally:
        replicas.close()
    np.testing.assert_array_equal([act.action for act in results], expected)


def test_a_padded_or_sampled_row_leaves_the_memory_as_it_is(recurrent: Path) -> None:
    policy, observations = loaded(recurrent, **MEMORY, batch_sizes=[4]), random_joints(5)
    with_samples = [Obs(state=obs.state, info={"samples": 3}) for obs in observations]
    for plain, sampled in zip(acts(policy, observations), acts(policy, with_samples), strict=True):
        np.testing.assert_allclose(plain.action, sampled.action, atol=1e-6)


@pytest.mark.parametrize("rows", [1, 3, 16])
def test_no_bit_of_an_action_depends_on_its_batch(recurrent: Path, rows: int) -> None:
    with invariant(rows) as report:
        policy = loaded(recurrent, **MEMORY)
    assert report.variation is None

    def begin(robot: int) -> Onnx:
        session = AgentCopies(policy).make()
        session.reset(observe(robot, 0), None, seed=robot)
        # A session that continues on another replica observes without acting.
        session.observe(observe(robot, -1))
        return session

    def observe(robot: int, tick: int) -> Obs:
        [obs] = random_joints(1, seed=1000 * tick + robot + 1000)
        return Obs(state=obs.state, info={"samples": 2} if (robot + tick) % 3 == 0 else {})

    compared, differing = differing_acts(policy, begin, observe, ticks=5)
    assert compared == 4 * 5 * ROBOTS
    assert differing == []


def test_a_suite_of_the_interface_accepts_it(recurrent: Path) -> None:
    check_agent(Onnx.from_config({"checkpoint": str(recurrent), **MEMORY}))


PIXELS = {
    "NCHW": "g (float[N, 3, 4, 6] image) => (float[N, 72] action) { action = Flatten(image) }",
    "NHWC": "g (float[N, 4, 6, 3] image) => (float[N, 72] action) { action = Flatten(image) }",
    "uint8": """g (uint8[1, 4, 6, 3] image) => (float[1, 72] action) {
        flat = Flatten(image)
        action = Cast <to = 1> (flat)
    }""",
}


@pytest.mark.parametrize(
    ("graph", "option", "convert"),
    [
        ("NCHW", {}, lambda image: image.transpose(2, 0, 1) / np.float32(255)),
        ("NHWC", {"range": [-1, 1]}, lambda image: image * np.float32(2) / np.float32(255) - 1),
        ("NHWC", {"range": [0, 255]}, lambda image: image),
        ("uint8", {}, lambda image: image),
        (
            "NCHW",
            {"mean": [0.5, 0.25, 0.125], "std": [0.5, 1, 2], "clip": [-0.25, 0.5]},
            lambda image: (
                (
                    (image / np.float32(255) - np.float32([0.5, 0.25, 0.125]))
                    / np.float32([0.5, 1, 2])
                )
                .clip(-0.25, 0.5)
                .transpose(2, 0, 1)
            ),
        ),
    ],
)
def test_an_image_gets_the_models_layout_and_range(
    tmp_path: Path, graph: str, option: Any, convert: Any
) -> None:
    file = exported(tmp_path, PIXELS[graph])
    policy = loaded(file, cameras={"image": "front"}, inputs={"image": option})
    image = RNG.integers(0, 256, (4, 6, 3), np.uint8)
    assert policy.contract.cameras == {"front": CameraSpec(4, 6)}
    expected = convert(image.astype(np.float32)).astype(np.float32).ravel()
    np.testing.assert_array_equal(action(policy, Obs({"front": image})), expected)


def test_an_image_of_another_size_is_refused_or_padded_as_set(tmp_path: Path) -> None:
    file, image = exported(tmp_path, PIXELS["uint8"]), RNG.integers(0, 256, (12, 12, 3), np.uint8)
    with pytest.raises(
        InvalidObservation,
        match=r"'front': expected 4x6, got 12x12; .* `resize: true` for the input 'image'",
    ):
        action(loaded(file, cameras={"image": "front"}), Obs({"front": image}))

    policy = loaded(file, cameras={"image": "front"}, inputs={"image": {"resize": True}})
    assert policy.contract.cameras == {"front": CameraSpec()}
    np.testing.assert_array_equal(
        action(policy, Obs({"front": image})), resize_with_pad(image, 4, 6).ravel()
    )


SAME = "g (float[N, {0}] x) => (float[N, {0}] action) {{ action = Identity(x) }}"


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ({}, [1, 2, 3, 0.5]),
        ({"mean": 1, "std": 2}, [0, 0.5, 1, -0.25]),
        ({"mean": [1, 2, 3, 4], "std": [1, 1, 1, 0.5]}, [0, 0, 0, -7]),
        ({"min": 0, "max": [1, 2, 4, 1]}, [1, 1, 0.5, 0]),
        ({"mean": {"joints": [1, 1]}, "std": {"joints": 0.5, "speed": 2}}, [0, 2, 1.5, 0.5]),
        ({"std": {"joints": 0.5}, "clip": [-1, 2.5]}, [2, 2.5, 2.5, 0.5]),
    ],
)
def test_the_state_is_put_together_in_order_and_scaled(
    tmp_path: Path, option: Any, expected: list[float]
) -> None:
    state = ["joints", "speed", "gripper"]
    policy = loaded(exported(tmp_path, SAME.format(4)), state=state, inputs={"x": option})
    assert set(policy.contract.state or {}) == {"joints", "speed"}
    assert policy.contract.gripper
    obs = Obs(state=state_obs(joints=[1, 2], speed=3).state, gripper=0.5)
    np.testing.assert_array_equal(action(policy, obs), np.float32(expected))


def test_the_previous_output_is_that_before_offset_and_scale(tmp_path: Path) -> None:
    graph = "g (float[1, 5] obs) => (float[1, 2] action) { action = MatMul(obs, w) }"
    weights = RNG.normal(size=(5, 2)).astype(np.float32)
    policy = loaded(
        exported(tmp_path, graph, w=weights),
        state=["speed", "previous_output", "joints"],
        action={"mean": [0.5, -0.5], "std": 0.25, "clip": [-1, 1]},
    )
    speed = np.float32([3.0])
    observations = [state_obs(speed=speed, joints=RNG.normal(size=2)) for _ in range(6)]

    previous = np.zeros(2, np.float32)
    for obs, act in zip(observations, acts(policy, observations), strict=True):
        vector = np.concatenate([speed, previous, obs.state["joints"]])
        previous = (vector[None] @ weights).clip(-1, 1)[0]
        expected = np.float32([0.5, -0.5]) + np.float32(0.25) * previous
        np.testing.assert_allclose(act.action[0], expected, rtol=1e-6)


def test_constants_and_a_counter_of_steps_are_inputs(tmp_path: Path) -> None:
    graph = """g (float[N, 1] x, float[1, 1] time_step, int64 rate) => (float[N, 1] action, float[N, 1] target) {
        wide = Cast <to = 1> (rate)
        sum = Add(x, time_step)
        action = Add(sum, wide)
        target = Identity(time_step)
    }"""
    policy = loaded(
        exported(tmp_path, graph),
        state=["x"],
        inputs={"time_step": {"step": 10}, "rate": {"constant": 1000}},
        action={"output": "action"},
        info=["target"],
    )
    results = acts(policy, [state_obs(x=1)] * 3)
    assert [float(act.action[0, 0]) for act in results] == [1011, 1012, 1013]
    assert [float(act.info["target"][0, 0]) for act in results] == [10, 11, 12]


def test_a_history_begins_with_the_first_observation_again(tmp_path: Path) -> None:
    graph = "g (float[N, 3, 2] x) => (float[N, 6] action) { action = Flatten(x) }"
    policy = loaded(exported(tmp_path, graph), state=["joints"], inputs={"x": {"history": 3}})
    assert (policy.contract.history, policy.contract.state) == (3, {"joints": StateSpec(2)})
    results = acts(policy, [state_obs(joints=[i, i]) for i in range(4)])
    assert [act.action[0, ::2].tolist() for act in results] == [
        [0, 0, 0],
        [0, 0, 1],
        [0, 1, 2],
        [1, 2, 3],
    ]


def test_a_history_has_the_previous_output_of_each_observation(tmp_path: Path) -> None:
    graph = """g (float[N, 2, 2] x) => (float[N, 1] action) {
        flat = Flatten(x)
        axes = Constant <value_ints = [1]> ()
        action = ReduceSum(flat, axes)
    }"""
    policy = loaded(
        exported(tmp_path, graph), state=["speed", "previous_output"], inputs={"x": {"history": 2}}
    )
    results = acts(policy, [state_obs(speed=1)] * 4)
    assert [float(act.action[0, 0]) for act in results] == [
        2,
        1 + 0 + 1 + 2,
        1 + 2 + 1 + 4,
        1 + 4 + 1 + 8,
    ]


def test_a_chunk_of_actions_is_one_act(tmp_path: Path) -> None:
    graph = """g (float[N, 6] x) => (float[N, 3, 2] action) {
        shape = Constant <value_ints = [-1, 3, 2]> ()
        action = Reshape(x, shape)
    }"""
    policy = loaded(
        exported(tmp_path, graph),
        state=["joints"],
        contract={
            "control_hz": 20,
            "state": {"joints": {"dim": 6, "unit": "rad"}},
            "action": {"space": "joint"},
        },
    )
    contract = policy.contract
    assert (contract.chunk, contract.control_hz) == (3, 20)
    assert (contract.action.dim, contract.action.space) == (2, "joint")
    assert contract.state == {"joints": StateSpec(6, "rad")}
    assert action(policy, state_obs(joints=range(6))).tolist() == [0, 1]
    assert acts(policy, [state_obs(joints=range(6))])[0].action.tolist() == [[0, 1], [2, 3], [4, 5]]


def test_the_instruction_is_a_string_or_its_tokens(tmp_path: Path) -> None:
    text = """g (string[N, 1] task) => (float[N, 1] action) {
        action = ai.onnx.ml.LabelEncoder <keys_strings = ["lift", "push"], values_floats = [1.0, 2.0]> (task)
    }"""
    policy = loaded(exported(tmp_path, text), inputs={"task": {"instruction": "text"}})
    assert policy.contract.instruction
    assert action(policy, Obs(), "push") == 2

    from tokenizers import Tokenizer, models, pre_tokenizers

    words = Tokenizer(models.WordLevel({"[PAD]": 7, "lift": 1, "push": 2}, unk_token="[PAD]"))  # noqa: S106
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    words.enable_padding(pad_id=7, pad_token="[PAD]", length=8)  # noqa: S106
    words.save(str(tmp_path / "tokenizer.json"))

    ids = """g (int64[N, 4] ids, int64[N, 4] mask) => (float[N, 8] action) {
        both = Concat <axis = 1> (ids, mask)
        action = Cast <to = 1> (both)
    }"""
    inputs = {"ids": {"instruction": "tokens"}, "mask": {"instruction": "mask"}}
    policy = loaded(exported(tmp_path, ids), inputs=inputs)
    assert action(policy, Obs(), "lift push").tolist() == [1, 2, 7, 7, 1, 1, 0, 0]
    with pytest.raises(InvalidObservation, match="expected at most 4 tokens, got 5"):
        action(policy, Obs(), "lift lift lift lift lift")

    (tmp_path / "tokenizer.json").unlink()
    with pytest.raises(ConfigError, match=r"tokenizer.json: expected the instruction's tokenizer"):
        loaded(tmp_path / "policy.onnx", inputs=inputs)


def test_noise_is_the_sessions_own_and_samples_differ(tmp_path: Path) -> None:
    graph = (
        "g (float[N, 2] x, float[N, 2] noise) => (float[N, 2] action) { action = Add(x, noise) }"
    )
    policy = loaded(exported(tmp_path, graph), state=["joints"], inputs={"noise": {"noise": True}})
    [obs] = random_joints(1, 2)
    first, repeated, different = (acts(policy, [obs], seed=seed)[0].action for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, repeated)
    assert (first != different).all()

    sampled = acts(policy, [Obs(state=obs.state, info={"samples": 2})], seed=1)[0]
    np.testing.assert_array_equal(sampled.action, first)
    assert len(np.unique(sampled.info["distribution"]["samples"])) == 4


def test_rows_of_a_sequence_are_not_taken_for_a_batch(tmp_path: Path) -> None:
    graph = """g (float[T, 2] x) => (float[T, 2] action) {
        axis = Constant <value_int = 0> ()
        action = CumSum(x, axis)
    }"""
    policy = loaded(exported(tmp_path, graph), state=["joints"])
    assert not policy.model.batched
    check_agent(
        Onnx.from_config({"checkpoint": str(tmp_path / "policy.onnx"), "state": ["joints"]})
    )


TWO = """g (float[N, 2] x, float[N, 2] y, float[N, 5] h) => (float[N, 2] action, float[N, 2] h_out) {
    action = Add(x, y)
    h_out = Identity(x)
}"""
NOISY = """g (float[N, 2] x) => (float[N, 2] action) {
    noise = RandomNormalLike(x)
    action = Add(x, noise)
}"""
OPEN = "g (float[N, T] x) => (float[N, T] action) { action = Identity(x) }"


@pytest.mark.parametrize(
    ("graph", "settings", "message"),
    [
        (TWO, {"state": ["joints"]}, r"inputs without a source: \['x', 'y', 'h'\]"),
        (TWO, {"cameras": {"rgb": "front"}}, r"unknown: \['rgb'\]"),
        (TWO, {"recurrent": {"h": "c"}}, r"unknown: \['c'\]"),
        (
            TWO,
            {"state": ["joints"], "cameras": {"x": "front"}, "recurrent": {"x": "h_out"}},
            r"named twice: \['x'\]",
        ),
        (
            SAME.format(4),
            {"cameras": {"x": "front"}},
            r"cameras: x: expected an input \(-1, 3, H, W\).*got \(-1, 4\)",
        ),
        (
            TWO,
            {"state": ["joints"], "inputs": {"y": {"constant": 1}}, "recurrent": {"h": "h_out"}},
            r"expected an output of the input's shape, \(1, 5\), got \(1, 2\)",
        ),
        (
            TWO,
            {
                "state": ["a"],
                "inputs": {"y": {"constant": 1}, "h": {"constant": [1, 2]}},
                "info": ["h_out"],
            },
            r"inputs: h: constant: expected numbers of shape \(1, 5\), got \[1, 2\]",
        ),
        (
            TWO,
            {"state": ["a"], "inputs": {"y": {"state": ["b"]}, "h": {"constant": 0}}},
            r"one of them the action: \['action', 'h_out'\]",
        ),
        (
            SAME.format(4),
            {"state": ["a"], "inputs": {"x": {"mean": [1, 2]}}},
            "inputs: x: expected statistics of 4 numbers",
        ),
        (
            SAME.format(4),
            {"state": ["a"], "action": {"std": [1, 2]}},
            "action: expected statistics of 4 numbers",
        ),
        (
            SAME.format(4),
            {"state": ["previous_output", "previous_output"]},
            "previous_output has 4 numbers",
        ),
        (
            SAME.format(4),
            {"state": ["a"], "info": ["action"]},
            r"one of them the action: \['none of the outputs'\]",
        ),
        (
            SAME.format(4).replace("x", "state"),
            {"state": ["a"], "inputs": {"state": {"state": ["b"]}}},
            r"parts in `state` without an input: \['a'\]",
        ),
        (
            SAME.format(4),
            {"state": ["a"], "inputs": {"x": {"state": ["b"]}}},
            r"parts in `state` without an input: \['a'\]",
        ),
        (
            SAME.format(4),
            {"state": ["a"], "contract": {"hz": 3}},
            r"contract: expected only .*, got \['hz'\]",
        ),
        (
            SAME.format(4),
            {"state": ["a"], "inputs": {"x": {"std": {"b": 2}}}},
            r"inputs: x: expected names that are used, got \['b'\]",
        ),
        (
            SAME.format(4),
            {"state": ["a"], "inputs": {"x": {"range": [0, 1]}}},
            r"inputs: x: expected names that are used, got \['range'\]",
        ),
        (
            SAME.format(4),
            {"state": ["a"], "action": {"std": {"a": 2}}},
            r"action: expected names that are used, got \['a'\]",
        ),
        (NOISY, {"state": ["joints"]}, "draws noise, or keeps a state"),
        (
            OPEN,
            {"state": ["joints"]},
            r"inputs: x: shape: expected all lengths .*got None, and \[-1, -1\] in the file",
        ),
        (
            SAME.format(4),
            {"state": ["a"], "inputs": {"x": {"shape": [-1, 5]}}},
            r"fails on x \(1, 5\) float32: .*invalid dimensions",
        ),
    ],
)
def test_a_wrong_mapping_says_what_the_file_has(
    tmp_path: Path, graph: str, settings: Any, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        loaded(exported(tmp_path, graph), **settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"inputs": {"x": {"step": 0, "constant": 1}}}, "expected one source of an input"),
        ({"inputs": {"x": {"min": 0}}}, "expected min and max, or mean and std"),
        ({"action": {"min": 0, "max": 1, "mean": 2}}, "expected min and max, or mean and std"),
        ({"inputs": {"x": {"scale": 2}}}, "scale"),
    ],
)
def test_contradictory_settings_are_refused(settings: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Onnx.from_config({"checkpoint": "policy.onnx", **settings})


def test_an_open_length_is_that_of_the_settings(tmp_path: Path) -> None:
    policy = loaded(exported(tmp_path, OPEN), state=["joints"], inputs={"x": {"shape": [-1, 3]}})
    assert policy.contract.state == {"joints": StateSpec(3)}
    with pytest.raises(InvalidObservation, match=r"expected 3 numbers.*got 4"):
        action(policy, state_obs(joints=range(4)))


def test_a_statistic_that_no_part_fits_fails_that_act_alone(tmp_path: Path) -> None:
    file = exported(tmp_path, SAME.format(4))
    policy = loaded(file, state=["a", "b"], inputs={"x": {"mean": {"a": [1, 2, 3]}}})
    assert action(policy, state_obs(a=[1, 2, 3], b=4)).tolist() == [0, 0, 0, 4]
    with pytest.raises(InvalidObservation, match="statistics of 'x' do not fit"):
        action(policy, state_obs(a=[1, 2], b=[3, 4]))


def test_a_device_that_the_runtime_lacks_is_an_error_with_its_cure(
    recurrent: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(ConfigError, match="pip install onnxruntime-gpu"):
        loaded(recurrent, **MEMORY, device="cuda")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    with pytest.raises(ConfigError, match=r"or set device: cpu with resources: \{num_gpus: 0\}"):
        loaded(recurrent, **MEMORY)
    assert action(loaded(recurrent, **MEMORY, device="cpu"), random_joints(1)[0]).shape == (3,)


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Make a runtime that claims to have CUDA.

    Returns:
        The `providers` that a session was created with, and those that it reports as `started`.
    """
    inference_session = onnxruntime.InferenceSession
    providers_by_kind: dict[str, Any] = {"started": ["CUDAExecutionProvider"]}

    def session(path: str, options: Any, providers: Any) -> Any:
        providers_by_kind["providers"] = providers
        on_cpu = inference_session(path, options, providers=["CPUExecutionProvider"])
        on_cpu.get_providers = lambda: providers_by_kind["started"]
        return on_cpu

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CUDAExecutionProvider"])
    monkeypatch.setattr(onnxruntime, "InferenceSession", session)
    monkeypatch.setattr(accelerator, "driver_version", lambda: "580.65.06")
    return providers_by_kind


def test_a_gpu_is_used_where_there_is_one_with_the_precision_that_is_set(
    recurrent: Path, cuda: dict[str, Any]
) -> None:
    policy = loaded(recurrent, **MEMORY, max_rows=4)
    assert cuda["providers"] == [("CUDAExecutionProvider", {"device_id": "0", "use_tf32": "1"})]
    assert (policy.report.accelerated, set(policy.report.pass_s)) == (True, {1, 4})
    assert action(policy, random_joints(1)[0]).shape == (3,)
    loaded(recurrent, **MEMORY, device="cuda:1", matmul="highest")
    assert cuda["providers"] == [("CUDAExecutionProvider", {"device_id": "1", "use_tf32": "0"})]


def test_a_gpu_that_does_not_start_is_not_replaced_by_the_cpu(
    recurrent: Path, cuda: dict[str, Any]
) -> None:
    cuda["started"] = ["CPUExecutionProvider"]
    with pytest.raises(
        ConfigError, match=r"CUDAExecutionProvider did not start, .* set device: cpu"
    ):
        loaded(recurrent, **MEMORY)


def large(folder: Path, location: str) -> Path:
    """Write a model whose weights are in a file next to it, and return its file."""
    file = exported(
        folder,
        "g (float[N, 64] x) => (float[N, 64] action) { action = MatMul(x, w) }",
        w=np.eye(64, dtype=np.float32),
    )
    onnx.save(onnx.load(file), file, save_as_external_data=True, location=location)
    return file


def test_weights_beside_the_file_count_for_its_digest(tmp_path: Path) -> None:
    file = large(tmp_path, "policy.onnx.data")
    with used_checkpoints() as used:
        loaded(file, state=["x"])
    assert {path.name for path in used} == {"policy.onnx", "policy.onnx.data"}
    with used_checkpoints() as used:
        loaded(tmp_path, state=["x"])
    assert used == [tmp_path]


def test_a_file_reads_no_other_folder(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    file = large(tmp_path / "inner", "weights.bin")
    model = onnx.load(file, load_external_data=False)
    (tmp_path / "inner" / "weights.bin").rename(tmp_path / "weights.bin")
    for entry in model.graph.initializer[0].external_data:
        entry.value = "../weights.bin" if entry.key == "location" else entry.value
    file.write_bytes(model.SerializeToString())
    with pytest.raises(ConfigError, match="ONNX Runtime cannot read it"):
        loaded(file, state=["x"])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("policy.onnx", "ONNX Runtime cannot read it"),
        ("policy.pt", "trust_checkpoint"),
        ("policy.bin", r"one file with"),
    ],
)
def test_a_file_that_is_no_model_is_refused(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / name).write_bytes(b"PK nothing")
    with pytest.raises(ConfigError, match=message):
        loaded(tmp_path / name, state=["x"])
    (tmp_path / name).unlink()
    with pytest.raises(ConfigError, match=r"expected one file .*got \[\]"):
        loaded(tmp_path, state=["x"])


def test_a_replica_replaces_its_file_by_another_one(tmp_path: Path) -> None:
    graph = "g (float[N, 1] x) => (float[N, 1] action) { action = MatMul(x, w) }"
    for step in (1, 2):
        (tmp_path / f"{step}").mkdir()
        exported(tmp_path / f"{step}", graph, w=np.full((1, 1), step, np.float32))
    config = {"checkpoint": str(tmp_path / "{step}" / "policy.onnx"), "state": ["x"]}
    policy = PolicySource(Onnx.from_config, {**config, "checkpoint_step": 1})
    engine = Engine(policy)
    engine.start()
    obs = Obs(state={"x": np.ones(1, np.float32)})
    actions, digests = [], []
    for step in (1, 2):
        engine.swap({**config, "checkpoint_step": step})
        for op in ("reset", "act"):
            reply = asked(engine, "s", Request(op, obs)).get(timeout=10)
            assert reply.error is None
        assert reply.act is not None
        actions.append(reply.act.action.tolist())
        digests.append((engine.model.weights or {})["digest"])
    engine.close()
    assert actions == [[[1.0]], [[2.0]]]
    assert digests[0] != digests[1]
