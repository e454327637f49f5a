"""openpi's π0 and π0.5, on small random checkpoints made with openpi itself."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from jax_compiles import jax_compiles
from pushed_weights import check_pushed_weights

from plugins.vlagents_ray_models.tests.families.openpi.conftest import MARKS
from vlagents_ray import Act, Obs
from vlagents_ray.errors import ConfigError, InvalidObservation, MissingCamera
from vlagents_ray.interface import DELAY, DISTRIBUTION, LEFTOVER, SAMPLES
from vlagents_ray.policies.base import policy as base_policy
from vlagents_ray.robot.fit import Trained
from vlagents_ray.serve.config.dialects import presets
from vlagents_ray.testing import check_agent

pytestmark = MARKS

WORDS = ("pick up the cube", "push", "open the upper drawer")
# Largest difference between the actions of a row in a batch and alone, in float32 on a CPU.
BATCHED = 1e-5
KINDS = ("pi0", "pi05", "aloha")
PROGRAMS = {"pi0": ("_encode", "_follow"), "fast": ("_sample",)}
# The mapping of the client of each policy, from openpi's observation to ours.
MAPPINGS = {
    "pi0": "openpi-libero",
    "pi05": "openpi-droid",
    "aloha": "openpi-aloha",
    "fast": "openpi-droid",
}


def theirs(kind: str, seed: int) -> dict[str, Any]:
    """Return the observation that openpi's own client would send."""
    rng = np.random.default_rng(seed)

    def picture() -> np.ndarray:
        return rng.integers(0, 256, (96, 128, 3), dtype=np.uint8)

    def numbers(dim: int) -> np.ndarray:
        return rng.uniform(0, 1, dim).astype(np.float32)

    if kind == "pi0":
        state = np.concatenate([numbers(6), 0.04 * numbers(2)])
        return {
            "observation/image": picture(),
            "observation/wrist_image": picture(),
            "observation/state": state,
        }
    if kind in ("pi05", "fast"):
        return {
            "observation/exterior_image_1_left": picture(),
            "observation/wrist_image_left": picture(),
            "observation/joint_position": numbers(7),
            "observation/gripper_position": numbers(1),
        }
    cameras = ("cam_high", "cam_left_wrist", "cam_right_wrist")
    return {
        "images": {name: picture().transpose(2, 0, 1) for name in cameras},
        "state": numbers(14),
    }


def seen(kind: str, seed: int, **info: Any) -> Obs:
    """Return the same observation as the policy gets it, through the mapping of that client."""
    obs, _ = presets()[MAPPINGS[kind]].obs({**theirs(kind, seed), "prompt": "as reset says"})
    obs.info.update(info)
    return obs


def begun(policy: Any, kind: str, i: int) -> Any:
    session = copy.copy(policy)
    session.reset(seen(kind, i), WORDS[i % len(WORDS)], seed=i)
    return session


@pytest.mark.verifies("parity")
@pytest.mark.parametrize("kind", KINDS)
def test_actions_are_those_of_openpis_own_policy(
    kind: str, loaded: Any, upstream: Any, checkpoint: Any
) -> None:
    policy = loaded(kind)
    theirs_policy = upstream(kind, checkpoint(kind))
    for i in range(2):
        noise = np.random.default_rng([0, i]).standard_normal(
            policy.model.model.noise_shape, dtype=np.float32
        )
        theirs_obs = {**theirs(kind, i), "prompt": WORDS[i]}
        expected = theirs_policy.infer(theirs_obs, noise=noise)["actions"]
        action = begun(policy, kind, i).act(seen(kind, i)).action
        np.testing.assert_allclose(action, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("kind", "known"), [("pi0", (8, 1)), ("pi05", (8, 8)), ("aloha", (12, 2)), ("fast", (8, 8))]
)
def test_the_ranges_of_the_training_are_in_the_robots_units(
    kind: str, known: tuple[int, int], loaded: Any
) -> None:
    trained = Trained.from_statistics(loaded(kind).statistics)
    assert trained.state is not None
    assert trained.action is not None
    assert (np.isfinite(trained.state[0]).sum(), np.isfinite(trained.action[0]).sum()) == known
    state = trained.vector(seen(kind, 0), [])
    assert state is not None
    assert len(state) == len(trained.state[0])


@pytest.mark.verifies("batches")
@pytest.mark.parametrize("kind", ["pi0", "pi05"])
def test_neighbours_change_nothing(kind: str, loaded: Any) -> None:
    policy = loaded(kind)
    alone = [begun(policy, kind, i).act(seen(kind, i)).action for i in range(6)]
    for size in (2, 3, 6):  # of batches of 1 and 4
        acts = policy.act_batch(
            [seen(kind, i) for i in range(size)], [begun(policy, kind, i) for i in range(size)]
        )
        for expected, act in zip(alone, acts, strict=False):
            np.testing.assert_allclose(act.action, expected, atol=BATCHED, rtol=1e-5)


@pytest.mark.parametrize("kind", ["pi0", "pi05"])
def test_the_samples_of_an_observation_are_of_one_reading_of_it(
    kind: str, loaded: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = type(loaded(kind))(loaded(kind).config.model_copy(update={"batch_sizes": [2, 8]}))
    policy.initialize()
    model, encoded_rows = policy.model.model, []
    encode, follow = model._encode, model._follow

    def counted(state: Any, batch: Any) -> Any:
        encoded_rows.append(len(batch["state"]))
        return encode(state, batch)

    monkeypatch.setattr(model, "_encode", counted)
    plan = begun(policy, kind, 1).act(seen(kind, 1)).action[1:]
    # There are seven rows, of which the last two follow a plan, and one row of padding.
    views = [seen(kind, 0, **{SAMPLES: 4}), seen(kind, 1, **{SAMPLES: 1, LEFTOVER: plan, DELAY: 2})]
    encoded_rows.clear()
    shared = policy.act_batch(views, [begun(policy, kind, i) for i in range(2)])
    monkeypatch.setattr(base_policy, "shared_frames", lambda rows: (list(range(len(rows))),) * 2)
    separate = policy.act_batch(views, [begun(policy, kind, i) for i in range(2)])
    assert encoded_rows == [2, 8]

    for act, expected in zip(shared, separate, strict=True):
        np.testing.assert_allclose(act.action, expected.action, atol=BATCHED, rtol=1e-5)
        samples = [result.info[DISTRIBUTION]["samples"] for result in (act, expected)]
        np.testing.assert_allclose(*samples, atol=BATCHED, rtol=1e-5)
    # The programs of both sizes are compiled at the start.
    assert (encode._cache_size(), follow._cache_size()) == (2, 2)


def test_no_act_compiles_a_program(loaded: Any) -> None:
    policy = type(loaded("pi0"))(loaded("pi0").config.model_copy(update={"batch_sizes": [1, 2, 4]}))
    policy.initialize()
    plan = begun(policy, "pi0", 1).act(seen("pi0", 1)).action[1:]
    batches = [[{}] * count for count in range(1, 7)]
    for samples in (1, 2, 3, 5):
        batches += [[{SAMPLES: samples}, *[{}] * neighbours] for neighbours in range(3)]
    batches += [[{LEFTOVER: plan, DELAY: 2}, {SAMPLES: 1}]]
    with jax_compiles() as compiled:
        for batch in batches:
            sessions = [begun(policy, "pi0", i) for i in range(len(batch))]
            acts = policy.act_batch(
                [seen("pi0", i, **info) for i, info in enumerate(batch)], sessions
            )
            assert all(isinstance(act, Act) for act in acts)
    assert compiled == []

    with jax_compiles() as compiled:  # the count includes other sizes
        policy.config = policy.config.model_copy(update={"batch_sizes": None})
        policy.act_batch(
            [seen("pi0", i) for i in range(3)], [begun(policy, "pi0", i) for i in range(3)]
        )
    assert len(compiled) >= 2


def test_its_programs_never_call_the_host(loaded: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, texts = loaded("pi0"), list[str]()
    model = policy.model.model
    for name in ("_encode", "_follow"):
        program = getattr(model, name)

        def lowered(*args: Any, program: Any = program) -> Any:
            texts.append(program.lower(*args).compile().as_text())
            return program(*args)

        monkeypatch.setattr(model, name, lowered)
    begun(policy, "pi0", 0).act(seen("pi0", 0))
    assert len(texts) == 2
    for text in texts:
        for word in ("callback", "infeed", "outfeed", "send("):
            assert word not in text


def test_it_keeps_what_an_agent_promises(loaded: Any, checkpoint: Any) -> None:
    policy = type(loaded("pi0"))(loaded("pi0").config)
    check_agent(
        policy, obs=[seen("pi0", i) for i in range(3)], instructions=WORDS, steps=2, atol=BATCHED
    )


def test_contracts_fit_the_mappings_of_their_clients(loaded: Any) -> None:
    for kind, mapping in MAPPINGS.items():
        assert presets()[mapping].lacks(loaded(kind).contract) == []


@pytest.mark.verifies("isolation")
def test_a_session_that_fails_leaves_its_neighbours_alone(loaded: Any) -> None:
    policy = loaded("pi0")
    without_wrist = seen("pi0", 0)
    del without_wrist.cameras["wrist"]
    long_instruction = copy.copy(policy)
    long_instruction.reset(seen("pi0", 1), "pick up the cube " * 50, seed=1)
    acts = policy.act_batch(
        [without_wrist, seen("pi0", 1), seen("pi0", 2)],
        [begun(policy, "pi0", 0), long_instruction, begun(policy, "pi0", 2)],
    )
    assert isinstance(acts[0], MissingCamera)
    assert isinstance(acts[1], InvalidObservation)
    assert "shorten it" in str(acts[1])
    np.testing.assert_allclose(
        acts[2].action, begun(policy, "pi0", 2).act(seen("pi0", 2)).action, atol=BATCHED
    )


@pytest.mark.parametrize("kind", KINDS)
def test_chunks_follow_the_plan_also_where_actions_are_relative(kind: str, loaded: Any) -> None:
    policy = loaded(kind)
    plan = begun(policy, kind, 1).act(seen(kind, 1)).action[1:]
    free = begun(policy, kind, 0).act(seen(kind, 0)).action
    guided = begun(policy, kind, 0).act(seen(kind, 0, **{LEFTOVER: plan, DELAY: 2})).action
    assert np.abs(guided[:2] - plan[:2]).max() < 0.2 * np.abs(free[:2] - plan[:2]).max()
    assert np.abs(guided[2] - plan[2]).mean() < np.abs(free[2] - plan[2]).mean()


def test_a_config_with_its_own_prompt_needs_no_instruction(loaded: Any) -> None:
    policy = loaded("aloha")
    assert policy.contract.instruction is False
    actions = []
    for instruction in (None, "uncap"):
        session = copy.copy(policy)
        session.reset(seen("aloha", 0), instruction, seed=0)
        actions.append(session.act(seen("aloha", 0)).action)
    np.testing.assert_array_equal(*actions)


@pytest.mark.verifies("parity")
def test_fast_says_what_openpis_own_policy_says_alone_and_in_company(
    loaded: Any, upstream: Any, checkpoint: Any
) -> None:
    policy, theirs_policy = loaded("fast"), upstream("fast", checkpoint("fast"))
    acts = policy.act_batch(
        [seen("fast", i) for i in range(3)], [begun(policy, "fast", i) for i in range(3)]
    )
    for i, act in enumerate(acts):
        expected = theirs_policy.infer({**theirs("fast", i), "prompt": WORDS[i]})["actions"]
        alone = begun(policy, "fast", i).act(seen("fast", i)).action
        np.testing.assert_allclose(alone, expected, rtol=1e-5)
        np.testing.assert_array_equal(act.action, alone)


def test_what_a_row_says_after_its_end_is_dropped() -> None:
    from vlagents_ray_models.openpi import JaxTokens

    tokens = np.array([[5, 1, 7, 1], [5, 6, 7, 8]])
    np.testing.assert_array_equal(JaxTokens.ended(tokens), [[5, 1, 0, 0], [5, 6, 7, 8]])


@pytest.mark.parametrize("kind", ["pi0", "fast"])
def test_it_acts_with_pushed_weights(kind: str, loaded: Any, checkpoint: Any) -> None:
    from flax.traverse_util import flatten_dict
    from openpi.models.model import restore_params

    policy = loaded(kind)
    params = restore_params(checkpoint(kind) / "params")
    assert policy.parameters().keys() == flatten_dict(params, sep="/").keys()
    programs = [getattr(policy.model.model, name) for name in PROGRAMS[kind]]
    compiled_sizes = [program._cache_size() for program in programs]
    check_pushed_weights(policy, lambda: begun(policy, kind, 0).act(seen(kind, 0)).action)
    assert [program._cache_size() for program in programs] == compiled_sizes


def test_a_learner_of_adapters_pushes_these_alone(loaded: Any) -> None:
    policy = loaded("lora")
    check_pushed_weights(
        policy, lambda: begun(policy, "pi0", 0).act(seen("pi0", 0)).action, part="lora"
    )


def test_a_compiled_loop_has_no_random_steps(loaded: Any) -> None:
    assert loaded("pi0").contract.behaviour is None
    settings = loaded("pi0").config.model_copy(update={"noise_level": 0.5})
    with pytest.raises(
        ConfigError, match=r"noise_level: expected 0 for a JAX checkpoint.*got 0\.5"
    ):
        type(loaded("pi0"))(settings).initialize()
