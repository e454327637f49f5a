"""The reference policy with random weights: properties that do not depend on its training."""

from __future__ import annotations

import copy
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from batch_bits import differing_acts, invariant
from counting_compiler import counting_compiler
from normal_steps import logprob_of_steps
from pushed_weights import check_pushed_weights
from shared_readings import check_shared_readings

from vlagents_ray.errors import ConfigError, InvalidObservation, MissingCamera
from vlagents_ray.interface import (
    BEHAVIOUR,
    DELAY,
    DISTRIBUTION,
    GIVEN,
    LEFTOVER,
    SAMPLES,
    WANT,
    Act,
    Obs,
)
from vlagents_ray.policies.base import Row
from vlagents_ray.policies.base.adapter import CONFIG as ADAPTER_CONFIG
from vlagents_ray.policies.base.adapter import WEIGHTS as ADAPTER_WEIGHTS
from vlagents_ray.policies.flow import logprob_of_chain
from vlagents_ray.policies.reference import Reference, policy
from vlagents_ray.policies.reference.checkpoint import (
    CONFIG,
    WEIGHTS,
    Checkpoint,
    Embodiment,
    NetworkSizes,
    words_of,
)
from vlagents_ray.testing import check_agent
from vlagents_ray.weights.safetensors import write_values

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

network = pytest.importorskip("vlagents_ray.policies.reference.network")

WORDS = ("put the red puck on the blue pad", "lift the blue puck", "open the drawer")
ROBOTS = {
    "tabletop": Embodiment(
        cameras={"scene": "front", "wrist": "wrist"},
        state=["xyzrpy", "gripper"],
        state_mean=[0.0] * 7,
        state_std=[0.1] * 6 + [0.0],
        action={"dim": 4, "space": "ee_position", "delta": True},
    ),
    "sawyer": Embodiment(
        cameras={"scene": "corner2", "wrist": "gripperPOV"},
        state=["xyz", "gripper"],
        state_mean=[0.0] * 4,
        state_std=[0.1] * 4,
        action={"dim": 4, "space": "ee_position", "delta": True},
    ),
}
ALL = ["logprob", "entropy", "replay"]
LEVEL = 0.5
LONGEST = 3  # longest prefix of a policy that was trained with prefixes, rows
# largest difference between the actions of a batch and of a single row, in float32 on a CPU
BATCHED = 1e-5
SUMMED = 2e-3  # largest error of a sum of 5 log-probabilities, in float32


def written(path: Path, longest_prefix: int = 0) -> Path:
    """Write a checkpoint with random weights, which are the same for each `longest_prefix`."""
    words = sorted({word for text in WORDS for word in words_of(text)})
    small: dict[str, Any] = {"width": 32, "head": 32, "queries": 4, "blocks": 1, "token_width": 16}
    sizes = NetworkSizes(words=len(words), longest_prefix=longest_prefix, **small)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        built = network.ReferenceNetwork(sizes)
        if longest_prefix:  # as if it had been trained
            torch.nn.init.normal_(built.given[2].weight)
            torch.nn.init.normal_(built.given[2].bias)
        values = built.state_dict()
    checkpoint = Checkpoint(sizes=sizes, words=words, embodiments=ROBOTS)
    (path / CONFIG).write_text(checkpoint.model_dump_json())
    with (path / WEIGHTS).open("wb") as file:
        write_values(file, {name: value.numpy() for name, value in values.items()})
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("reference"))


@pytest.fixture(scope="module")
def prefixed_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("prefixed"), LONGEST)


@pytest.fixture(scope="module")
def prefixed(prefixed_folder: Path) -> Any:
    return made(prefixed_folder)


def made(folder: Path, **config: Any) -> Any:
    policy = Reference.from_config({"checkpoint": str(folder), "embodiment": "tabletop", **config})
    policy.initialize()
    return policy


@pytest.fixture(scope="module")
def loaded(folder: Path) -> Any:
    return made(folder)


@pytest.fixture(scope="module")
def learnt(folder: Path) -> Any:
    return made(folder, noise_level=LEVEL)


def seen(seed: int, side: tuple[int, int] = (64, 64), **info: Any) -> Obs:
    rng = np.random.default_rng(seed)
    cameras = {
        name: rng.integers(0, 256, (*side, 3), dtype=np.uint8) for name in ("front", "wrist")
    }
    return Obs(
        cameras, float(rng.random()), {"xyzrpy": rng.normal(0, 0.1, 6).astype(np.float32)}, info
    )


def begun(policy: Any, seed: int, words: str = WORDS[0], **options: Any) -> Any:
    session = copy.copy(policy)
    session.reset(seen(seed), words, seed=seed, **options)
    return session


def acted(policy: Any, views: Sequence[Obs], **options: Any) -> list[np.ndarray]:
    acts = policy.act_batch(views, [begun(policy, i, **options) for i in range(len(views))])
    assert all(isinstance(act, Act) for act in acts)
    return [act.action for act in acts]


def test_it_keeps_what_an_agent_promises(folder: Path) -> None:
    views = [seen(0), seen(1, (120, 60)), seen(2)]
    config = {"checkpoint": str(folder), "embodiment": "tabletop"}
    check_agent(Reference.from_config(config), obs=views, instructions=WORDS[:2])


def test_each_robot_has_its_own_contract(folder: Path, loaded: Any) -> None:
    contract = loaded.contract
    assert (set(contract.cameras), set(contract.state), contract.gripper) == (
        {"front", "wrist"},
        {"xyzrpy"},
        True,
    )
    assert (contract.action.dim, contract.chunk, contract.instruction) == (4, 8, True)
    other = made(folder, embodiment="sawyer").contract
    assert (set(other.cameras), set(other.state), other.chunk) == (
        {"corner2", "gripperPOV"},
        {"xyz"},
        8,
    )
    with pytest.raises(ConfigError, match=r"expected one of \['sawyer', 'tabletop'\].*, got None"):
        made(folder, embodiment=None)


@pytest.mark.parametrize("size", [2, 5])
def test_neighbours_change_nothing(loaded: Any, size: int) -> None:
    alone = [begun(loaded, i).act(seen(i)).action for i in range(size)]
    np.testing.assert_allclose(acted(loaded, [seen(i) for i in range(size)]), alone, atol=BATCHED)


def test_images_state_words_and_their_order_all_matter(loaded: Any) -> None:
    def of(obs: Obs, words: str = WORDS[0]) -> np.ndarray:
        return begun(loaded, 0, words).act(obs).action  # type: ignore[no-any-return]

    base, other = seen(0), seen(1)
    changed = [
        of(base, "put the blue puck on the red pad"),
        of(base, WORDS[1]),
        of(Obs(base.cameras, base.gripper, other.state)),
        of(Obs({**base.cameras, "front": other.cameras["front"]}, base.gripper, base.state)),
        of(Obs({**base.cameras, "wrist": other.cameras["wrist"]}, base.gripper, base.state)),
    ]
    assert min(np.abs(actions - of(base)).max() for actions in changed) > 5 * BATCHED


def test_what_it_was_not_trained_with_is_refused(loaded: Any) -> None:
    for words, said in (
        ("lift the pink puck", "expected words of .*, got 'pink' in"),
        ("puck " * 17, "expected 1 to 16 words, got 17"),
    ):
        with pytest.raises(InvalidObservation, match=said):
            begun(loaded, 0, words)
    with pytest.raises(MissingCamera, match="wrist"):
        begun(loaded, 0).act(Obs({"front": seen(0).cameras["front"]}, 0.5, seen(0).state))


def test_a_checkpoint_that_is_damaged_is_refused(folder: Path, tmp_path: Path) -> None:
    for name in (CONFIG, WEIGHTS):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    whole = (folder / WEIGHTS).read_bytes()
    (tmp_path / WEIGHTS).write_bytes(whole[:-5])
    with pytest.raises(ConfigError, match=r"model.safetensors"):
        made(tmp_path)
    (tmp_path / WEIGHTS).write_bytes(whole)
    stated = json.loads((folder / CONFIG).read_text())
    (tmp_path / CONFIG).write_text(json.dumps(stated | {"sizes": {**stated["sizes"], "head": 64}}))
    with pytest.raises(ConfigError, match=r"model.safetensors: cannot be read: .*size mismatch"):
        made(tmp_path)
    (tmp_path / CONFIG).write_text("{}")
    with pytest.raises(ConfigError, match="expected a checkpoint of the reference policy"):
        made(tmp_path)


def test_chunks_follow_the_plan(loaded: Any) -> None:
    plan, free = begun(loaded, 1).act(seen(1)).action[2:], begun(loaded, 0).act(seen(0)).action
    guided = begun(loaded, 0).act(seen(0, **{LEFTOVER: plan, DELAY: 3})).action
    off, without = (
        np.abs(guided[: len(plan)] - plan).mean(1),
        np.abs(free[: len(plan)] - plan).mean(1),
    )
    assert (off < without).all()


PLAN = np.random.default_rng(9).uniform(-1, 1, (6, 4)).astype(np.float32)


def planned(seed: int, delay: int, plan: np.ndarray = PLAN) -> Obs:
    return seen(seed, **{LEFTOVER: plan, DELAY: delay})


@pytest.mark.parametrize("settings", [{}, {"dtype": "bfloat16"}, {"compile": True}])
@pytest.mark.parametrize("delay", [1, LONGEST, LONGEST + 2])
def test_a_trained_policy_returns_its_prefix_unchanged_and_continues_it(
    prefixed_folder: Path, delay: int, settings: dict[str, Any]
) -> None:
    with counting_compiler():
        policy = made(prefixed_folder, **settings)
        act = begun(policy, 0).act(planned(0, delay))
        other = begun(policy, 0).act(planned(0, delay, -PLAN)).action
    length = min(delay, LONGEST)
    assert policy.longest_prefix == LONGEST
    assert act.info[GIVEN] == length
    np.testing.assert_array_equal(act.action[:length], PLAN[:length])
    assert np.abs(act.action[length:] - other[length:]).max() > 100 * BATCHED


def test_only_the_rows_of_the_prefix_are_read(prefixed: Any) -> None:
    expected = begun(prefixed, 0).act(planned(0, 2)).action
    changed = np.concatenate([PLAN[:2], 5 + PLAN[2:]])
    np.testing.assert_array_equal(begun(prefixed, 0).act(planned(0, 2, changed)).action, expected)
    act = begun(prefixed, 0).act(planned(0, 3, PLAN[:1]))  # a plan that is shorter than the delay
    assert act.info[GIVEN] == 1


def test_without_a_prefix_a_trained_policy_computes_as_if_it_had_no_input_for_one(
    loaded: Any, prefixed: Any
) -> None:
    assert loaded.longest_prefix == 0
    expected = begun(loaded, 0).act(seen(0)).action
    for obs in (seen(0), planned(0, 0), planned(0, 2, PLAN[:0])):
        act = begun(prefixed, 0).act(obs)
        assert GIVEN not in act.info
        np.testing.assert_array_equal(act.action, expected)


def test_prefixes_of_other_sessions_change_nothing(prefixed: Any) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        views = []
        for seed in range(int(rng.integers(2, 6))):
            plan = rng.uniform(-1, 1, (int(rng.integers(1, 8)), 4)).astype(np.float32)
            delay = int(rng.integers(0, 8))
            views.append(planned(seed, delay, plan) if rng.random() < 0.7 else seen(seed))
        acts = prefixed.act_batch(views, [begun(prefixed, i) for i in range(len(views))])
        for i, (obs, act) in enumerate(zip(views, acts, strict=True)):
            alone = begun(prefixed, i).act(obs)
            length = alone.info.get(GIVEN, 0)
            assert act.info.get(GIVEN, 0) == length
            np.testing.assert_allclose(act.action, alone.action, atol=BATCHED)
            if length:
                np.testing.assert_array_equal(act.action[:length], obs.info[LEFTOVER][:length])


def test_the_log_probability_is_the_one_that_a_learner_computes(learnt: Any) -> None:
    views, sessions = (
        [seen(i, **{WANT: ALL, SAMPLES: 2}) for i in range(2)],
        [begun(learnt, i) for i in range(2)],
    )
    rows = []
    for session, obs in zip(sessions, views, strict=True):
        frame = session.perceive(obs)
        rows.append(Row((frame,), WORDS[0], np.random.default_rng(0)))
    inputs = {name: value.clone() for name, value in learnt._inputs(rows).items()}
    acts = learnt.act_batch(views, sessions)
    said = [act.info[BEHAVIOUR] for act in acts]
    chains = torch.from_numpy(np.stack([one["replay"]["chain"] for one in said]))
    with torch.no_grad():
        velocity = network.flow_velocity(learnt.model.network, inputs)
        again = logprob_of_chain(velocity, chains, LEVEL)
        first = network.flow_velocity(
            learnt.model.network, {name: value[:1] for name, value in inputs.items()}
        )
        total = logprob_of_steps(first, said[0]["replay"]["chain"], LEVEL)
    np.testing.assert_allclose(again, np.stack([one["logprob"] for one in said]), atol=SUMMED)
    np.testing.assert_allclose(said[0]["logprob"], total, atol=SUMMED)
    assert acts[0].info[DISTRIBUTION]["logprob"].shape == (2, 8, 4)


def test_the_samples_of_an_observation_are_of_one_reading_of_it(learnt: Any) -> None:
    check_shared_readings(
        learnt, [seen(0, **{SAMPLES: 4, WANT: ALL}), seen(1)], begun, policy, BATCHED
    )


def test_a_flow_without_initial_noise_has_one_chunk_for_an_observation(
    folder: Path, loaded: Any
) -> None:
    still = made(folder, initial_noise=0.0)
    views = [seen(0, **{SAMPLES: 3}), seen(1)]

    def chunks(policy: Any, seed: int) -> list[Any]:
        sessions = [begun(policy, seed + number) for number in range(len(views))]
        return list(policy.act_batch(views, sessions))

    first, second = chunks(still, 0), chunks(still, 5)
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.action, other.action)
    assert np.abs(first[0].action - first[1].action).max() > 0, "the observation matters"
    samples = first[0].info[DISTRIBUTION]["samples"]
    assert np.abs(samples - second[0].info[DISTRIBUTION]["samples"]).max() > 0

    usual = chunks(made(folder, initial_noise=1.0), 0)
    for one, other in zip(chunks(loaded, 0), usual, strict=True):
        np.testing.assert_array_equal(one.action, other.action)
    assert np.abs(usual[0].action - first[0].action).max() > 0


def test_compiled_in_bfloat16_and_with_pushed_weights_it_stays_itself(
    folder: Path, loaded: Any
) -> None:
    views = [seen(i) for i in range(3)]
    with counting_compiler() as compiler:
        compiled = made(folder, compile="require", batch_sizes=[3])
        assert compiler.rows == [3, 3]  # the encoder and one step of the flow
        np.testing.assert_allclose(acted(compiled, views), acted(loaded, views), atol=BATCHED)
        assert compiler.calls > 0
    np.testing.assert_allclose(
        acted(made(folder, dtype="bfloat16"), views), acted(loaded, views), atol=0.02
    )
    policy = made(folder)
    check_pushed_weights(policy, lambda: begun(policy, 0).act(seen(0)).action)


def test_the_policy_with_an_adapter_acts_with_merged_weights(
    folder: Path, tmp_path: Path, loaded: Any
) -> None:
    rng, layer = np.random.default_rng(0), "context"
    weight = loaded.model.network.state_dict()[f"{layer}.weight"]
    low, high = (
        rng.normal(0, 0.1, shape).astype(np.float32)
        for shape in ((2, weight.shape[1]), (weight.shape[0], 2))
    )
    own = tmp_path / "adapter"
    own.mkdir()
    settings = {"peft_type": "LORA", "r": 2, "lora_alpha": 2, "target_modules": [layer]}
    (own / ADAPTER_CONFIG).write_text(
        json.dumps({**settings, "base_model_name_or_path": str(folder)})
    )
    with (own / ADAPTER_WEIGHTS).open("wb") as file:
        write_values(file, {f"base_model.model.{layer}.lora_{name}.weight": value for name, value in
                            (("A", low), ("B", high))})  # fmt: skip
    adapted, merged = made(folder, adapter=str(own)), made(folder)
    with torch.no_grad():
        merged.model.network.context.weight += torch.from_numpy(high @ low)
    views = [seen(0), seen(1)]
    actions = acted(adapted, views)
    np.testing.assert_allclose(actions, acted(merged, views), atol=BATCHED)
    assert not np.allclose(actions, acted(loaded, views), atol=BATCHED)
    check_pushed_weights(adapted, lambda: begun(adapted, 0).act(seen(0)).action)


@pytest.mark.parametrize("rows", [1, 4, 16])
def test_no_bit_of_an_action_depends_on_its_batch(folder: Path, rows: int) -> None:
    with invariant(rows) as report:
        policy = made(folder, noise_level=LEVEL)
    assert report.variation is None

    def observe(robot: int, tick: int) -> Obs:
        kinds: list[dict[str, Any]] = [
            {},
            {SAMPLES: 1 + robot % 3},
            {LEFTOVER: np.zeros((3, 4), np.float32), DELAY: 1 + robot % 2},
            {WANT: ALL},
        ]
        return seen(100 * tick + robot, (64 + robot, 64), **kinds[(robot + tick) % 4])

    def begin(robot: int) -> Any:
        return begun(policy, robot, WORDS[robot % 2])

    compared, differing = differing_acts(policy, begin, observe, ticks=4)
    assert compared == 4 * 4 * 11
    assert differing == []
