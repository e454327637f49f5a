"""V-JEPA 2-AC as a policy, on a small random checkpoint of upstream's own code."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from counting_compiler import counting_compiler

from plugins.vlagents_ray_models.tests.families.vjepa2_ac.tiny import (
    HEADS,
    SETTINGS,
    SIDE,
    make_checkpoint,
    make_hf_encoder,
    make_models,
)
from vlagents_ray import Act, Obs
from vlagents_ray.errors import ConfigError, InvalidObservation, MissingCamera, MissingState
from vlagents_ray.interface import DISTRIBUTION, GOAL_IMAGE, SAMPLES
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.testing import check_agent
from vlagents_ray_models.vjepa2_ac import VJepa2Ac

pytestmark = [
    pytest.mark.source("VJEPA2_SRC"),
    # The authors' code uses names that timm and torch have since deprecated.
    pytest.mark.filterwarnings(
        "ignore:Importing from timm.models.layers is deprecated:FutureWarning"
    ),
    pytest.mark.filterwarnings("ignore:`torch.backends.cuda.sdp_kernel:FutureWarning"),
]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_checkpoint(tmp_path_factory.mktemp("ac") / "ac.pt")


@pytest.fixture(scope="module")
def policy(checkpoint: Path) -> VJepa2Ac:
    made = VJepa2Ac.from_config({"checkpoint": str(checkpoint), **SETTINGS})
    made.initialize()
    return made


def obs(seed: int, goal: int | None = None) -> Obs:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (40, 60, 3), dtype=np.uint8)
    image.flags.writeable = False  # as a server's are
    return Obs(
        cameras={"front": image},
        gripper=float(rng.uniform()),
        state={"xyzrpy": rng.uniform(-1, 1, 6).astype(np.float32)},
        info={} if goal is None else {GOAL_IMAGE: goal_image(goal)},
    )


def goal_image(seed: int) -> np.ndarray:
    return np.random.default_rng([seed, 1]).integers(0, 256, (48, 48, 3), dtype=np.uint8)


def begun(policy: VJepa2Ac, seed: int, goal: int | None = 0) -> Any:
    session = AgentCopies(policy).make()
    session.reset(obs(seed, goal), None, seed=seed)
    return session


def test_keeps_the_promises_of_an_agent(checkpoint: Path) -> None:
    check_agent(
        VJepa2Ac.from_config({"checkpoint": str(checkpoint), **SETTINGS}),
        obs=[obs(seed, goal=seed) for seed in range(3)],
    )


@pytest.mark.verifies("batches")
def test_a_session_gets_the_same_in_any_company(policy: VJepa2Ac) -> None:
    views = [obs(10 + i) for i in range(8)]
    alone = [begun(policy, i, goal=i).act(view).action for i, view in enumerate(views)]
    for size in (1, 2, 3, 8):
        acts = policy.act_batch(views[:size], [begun(policy, i, goal=i) for i in range(size)])
        for act, expected in zip(acts, alone, strict=False):
            assert isinstance(act, Act)
            assert np.allclose(act.action, expected, atol=1e-5)


def test_an_observation_is_on_the_device_before_its_batch_begins(policy: VJepa2Ac) -> None:
    view = obs(1)
    session = begun(policy, 0)
    view.prepared = staged = session.prepare(view)
    assert staged.block is not None
    act = session.act(view)
    assert staged.block is None, "the copy is freed after the batch"
    np.testing.assert_array_equal(act.action, begun(policy, 0).act(obs(1)).action)


@pytest.mark.parametrize("between", ["act", "observe"])
def test_a_goal_is_taken_from_an_observation_that_no_plan_is_made_for(
    checkpoint: Path, between: str
) -> None:
    queueing = VJepa2Ac.from_config(
        {"checkpoint": str(checkpoint), **SETTINGS, "actions": "queue", "execute": 2}
    )
    queueing.initialize()
    changed, expected = begun(queueing, 0, goal=0), begun(queueing, 0, goal=1)
    for session in (changed, expected):
        session.act(obs(4))
    getattr(changed, between)(obs(5, goal=1))
    expected.act(obs(5))
    if between == "observe":
        changed.act(obs(5))
    assert np.allclose(changed.act(obs(6)).action, expected.act(obs(6)).action, atol=1e-5)


def test_bfloat16_plans_nearly_as_float32(checkpoint: Path, policy: VJepa2Ac) -> None:
    half = VJepa2Ac.from_config({"checkpoint": str(checkpoint), **SETTINGS, "dtype": "bfloat16"})
    half.initialize()
    act, expected = begun(half, 3).act(obs(4)), begun(policy, 3).act(obs(4))
    assert act.info["energy"] == pytest.approx(expected.info["energy"], rel=0.05)
    # Steps are at most 0.05 to each side.
    assert np.allclose(act.action[:, :3], expected.action[:, :3], atol=0.05)


@pytest.mark.verifies("parity")
def test_plans_are_those_of_upstreams_own_planner(
    policy: VJepa2Ac, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Upstream's encoder, predictor, transform and `cem` have the same images, pose and draws."""
    import torch

    ours = begun(policy, seed=3).act(obs(4))
    source = Path(os.environ["VJEPA2_SRC"])
    monkeypatch.syspath_prepend(str(source / "notebooks"))
    for name in [name for name in sys.modules if name.partition(".")[0] == "utils"]:
        monkeypatch.delitem(sys.modules, name)
    from utils.world_model_wrapper import WorldModel

    encoder, predictor = make_models()
    draws = np.random.default_rng([0, 3]).standard_normal(
        (SETTINGS["iterations"], 2, SETTINGS["samples"], 4), dtype=np.float32
    )
    following = iter(torch.from_numpy(draws).flatten(0, 1))
    monkeypatch.setattr(torch, "randn", lambda *_, **__: next(following))
    theirs = WorldModel(
        encoder,
        predictor,
        (SIDE // 16) ** 2,
        upstream_transform(monkeypatch),
        mpc_args={
            "rollout": 2,
            "samples": SETTINGS["samples"],
            "topk": SETTINGS["topk"],
            "cem_steps": SETTINGS["iterations"],
            "momentum_mean": 0.15,
            "momentum_std": 0.15,
            "maxnorm": 0.05,
        },
        device="cpu",
    )
    view = obs(4)
    pose = torch.tensor([[[*view.state["xyzrpy"].tolist(), 1 - view.gripper]]])  # type: ignore[operator]
    with torch.no_grad():
        current = theirs.encode(view.cameras["front"])[:, None]
        goal = theirs.encode(goal_image(0))[:, None]
        steps = theirs.infer_next_action(current, pose, goal).numpy()
    assert np.allclose(ours.action[0, :6], steps[0, :6], atol=1e-5)
    closedness = np.clip(1 - view.gripper + steps[0, 6], 0, 1)  # type: ignore[operator]
    assert ours.action[0, 6] == pytest.approx(1 - closedness, abs=1e-5)


def upstream_transform(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return the transform of upstream's notebook.

    OpenCV, which upstream imports for augmentations in training, is not needed.
    """
    monkeypatch.setitem(sys.modules, "cv2", ModuleType("cv2"))
    import src.datasets.utils.video.transforms as video

    def transform(buffer: np.ndarray) -> Any:
        import torch

        frames = torch.tensor(buffer, dtype=torch.float32).permute(3, 0, 1, 2)
        frames = video.random_resized_crop(frames, SIDE, SIDE, scale=(1.0, 1.0), ratio=(1.0, 1.0))
        mean, std = (
            torch.tensor(values)[:, None, None, None] * 255
            for values in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
        )
        return (frames - mean) / std

    return transform


def test_an_encoder_of_transformers_may_take_the_place_of_the_checkpoints(
    checkpoint: Path, tmp_path: Path
) -> None:
    other = VJepa2Ac.from_config(
        {
            "checkpoint": str(checkpoint),
            **SETTINGS,
            "encoder": str(make_hf_encoder(tmp_path / "encoder")),
        }
    )
    other.initialize()
    assert begun(other, 0).act(obs(1)).action.shape == (1, 7)


def test_the_goal_may_come_later_and_change(policy: VJepa2Ac) -> None:
    session = begun(policy, 0, goal=None)
    with pytest.raises(InvalidObservation, match=r"goal_image.*got none since the reset"):
        session.act(obs(1))
    session.act(obs(1, goal=5))
    goal = session.episode.memory["goal"]
    features = goal.features
    session.act(obs(2, goal=5))
    session.act(obs(2))
    assert session.episode.memory["goal"] is goal  # the same image is not encoded again
    assert goal.features is features
    session.act(obs(2, goal=6))
    assert session.episode.memory["goal"] is not goal


@pytest.mark.verifies("isolation")
def test_a_bad_observation_fails_its_own_session_alone(policy: VJepa2Ac) -> None:
    bad = [
        Obs(cameras=obs(0).cameras, gripper=1.0),
        Obs(state=obs(0).state, gripper=1.0),
        obs(0),
        obs(1),
    ]
    bad[2].info[GOAL_IMAGE] = np.zeros((4, 4), np.uint8)
    no_state, no_camera, odd_goal, good = policy.act_batch(
        bad, [begun(policy, i) for i in range(4)]
    )
    assert isinstance(no_state, MissingState)
    assert isinstance(no_camera, MissingCamera)
    assert isinstance(odd_goal, InvalidObservation)
    assert isinstance(good, Act)


def test_samples_are_other_plans_to_the_same_goal(policy: VJepa2Ac) -> None:
    view = obs(1)
    view.info[SAMPLES] = 3
    distribution = begun(policy, 0).act(view).info[DISTRIBUTION]
    assert distribution["samples"].shape == (3, 1, 7)
    assert distribution["mean"].shape == distribution["std"].shape == (1, 7)
    assert (distribution["std"][:, :3] > 0).all()


def altered(checkpoint: Path, folder: Path, network: str, tensor: str | None) -> Path:
    """Write the checkpoint without a network, or without one of its tensors."""
    import torch

    networks = torch.load(checkpoint, weights_only=True)
    if tensor is None:
        del networks[network]
    else:
        del networks[network][tensor]
    torch.save(networks, folder / "altered.pt")
    return folder / "altered.pt"


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    ("network", "tensor", "says"),
    [
        ("predictor", None, "expected 'predictor', got"),
        ("encoder", None, "it has no 'encoder'"),
        ("predictor", "module.predictor_proj.bias", r"does not fit.*predictor_proj\.bias"),
        (
            "encoder",
            "module.backbone.blocks.1.mlp.fc2.bias",
            r"expected upstream's parameters, got none of .*mlp\.fc2\.bias",
        ),
        (
            "encoder",
            "module.backbone.patch_embed.proj.weight",
            "expected upstream's names, as 'patch_embed.proj.weight'",
        ),
    ],
)
def test_a_checkpoint_that_is_not_whole_is_refused(
    network: str, tensor: str | None, says: str, checkpoint: Path, tmp_path: Path
) -> None:
    file = altered(checkpoint, tmp_path, network, tensor)
    policy = VJepa2Ac.from_config({**SETTINGS, "checkpoint": str(file)})
    with pytest.raises(ConfigError, match=f"(?s){says}"):
        policy.initialize()


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"encoder_heads": None}, "encoder_heads: unset, and 48"),
        ({"source_dir": "/nowhere"}, "source_dir or in VJEPA2_SRC"),
        ({"checkpoint": "./none.pt"}, "no such file or folder"),
    ],
)
def test_what_cannot_be_loaded_says_why(
    settings: dict[str, Any], says: str, checkpoint: Path
) -> None:
    with pytest.raises(ConfigError, match=says):
        VJepa2Ac.from_config({"checkpoint": str(checkpoint), **SETTINGS, **settings}).initialize()


def test_a_file_that_is_no_checkpoint_is_refused_and_never_unpickled(tmp_path: Path) -> None:
    import pickle

    file = tmp_path / "odd.pt"
    file.write_bytes(pickle.dumps(Path))
    with pytest.raises(ConfigError, match="a file of tensors, got another"):
        VJepa2Ac.from_config({"checkpoint": str(file), "encoder_heads": HEADS}).initialize()


SIZE = 2  # size of compiled batches


# More than the 12 plans of an iteration, and no divisor of them.
@pytest.mark.parametrize("pass_size", [400, 5])
def test_plans_of_batches_of_any_size_are_those_without_compilation(
    pass_size: int, checkpoint: Path, policy: VJepa2Ac
) -> None:
    settings = {"checkpoint": str(checkpoint), **SETTINGS, "pass_size": pass_size}
    with counting_compiler() as compiler:
        compiled = VJepa2Ac.from_config({**settings, "compile": "require", "batch_sizes": [SIZE]})
        compiled.initialize()
        plans = min(pass_size, SETTINGS["samples"])
        # The encoder, and each step of a plan.
        assert sorted(compiler.rows) == sorted([SIZE, plans, plans])
        for size in (1, SIZE, SIZE + 1):
            views = [obs(10 + i) for i in range(size)]
            views[0].info[SAMPLES] = 2
            expected, acts = (
                agent.act_batch(views, [begun(agent, i, goal=i) for i in range(size)])
                for agent in (policy, compiled)
            )
            for expected_act, act in zip(expected, acts, strict=True):
                assert isinstance(expected_act, Act)
                assert isinstance(act, Act)
                np.testing.assert_allclose(expected_act.action, act.action, atol=1e-4)
        assert len(compiler.rows) == 3
