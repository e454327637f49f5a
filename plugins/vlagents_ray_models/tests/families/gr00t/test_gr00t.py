"""NVIDIA's own code, called through the policy: the actions of `Gr00tPolicy`, in any batch."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pushed_weights import check_pushed_weights
from safetensors.torch import load_file

from plugins.vlagents_ray_models.tests.families.gr00t import tiny
from plugins.vlagents_ray_models.tests.families.gr00t.conftest import MARKS, Checkpoint, Policy
from plugins.vlagents_ray_models.tests.families.gr00t.flash_attention import attend, stand_in
from vlagents_ray import Obs
from vlagents_ray.contract import ActionSpec, CameraSpec, StateSpec
from vlagents_ray.errors import MissingCamera
from vlagents_ray.interface import DISTRIBUTION, SAMPLES, Act
from vlagents_ray.policies.base.checkpoint import used_checkpoints
from vlagents_ray.robot.fit import Trained
from vlagents_ray.testing import check_agent
from vlagents_ray_models.gr00t import Gr00t, built_without_flash_attention, packed_attention
from vlagents_ray_models.sampling_rng import RowDraws

pytestmark = MARKS
torch.set_num_threads(1)  # of products this small, several cores make slower ones

ATOL = 1e-5  # float32, actions of up to 2
TASKS = ("Pick up the cube.", "open the drawer, then close it again", "push")
ROBOTS = {"relative": "new_embodiment", "libero": tiny.LIBERO, "history": "new_embodiment"}


def view(number: int, kind: str = "relative", size: tuple[int, int] = (72, 96), **info: Any) -> Obs:
    """Return the observation of session `number`."""
    rng = np.random.default_rng(number)
    names = ("front", "wrist") if kind == "libero" else ("ego_view",)
    images = {name: rng.integers(0, 256, (*size, 3), dtype=np.uint8) for name in names}
    widths = {"arm": 5}
    if kind == "libero":
        widths = dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), 1) | {"gripper_qpos": 2}
    state = {}
    for name, width in widths.items():
        state[name] = rng.uniform(-0.5, 0.5, width).astype(np.float32)
    return Obs(images, None if kind == "libero" else float(rng.uniform()), state, info)


def begun(policy: Gr00t, number: int = 0, kind: str = "relative") -> Gr00t:
    """Begin session `number` of a loaded policy, with its number as the seed."""
    session = copy.copy(policy)
    session.reset(view(number, kind), TASKS[number % 3], seed=number)
    return session


class Theirs:
    """A checkpoint in NVIDIA's `Gr00tPolicy`."""

    def __init__(
        self, folder: Path, robot: str, patch: pytest.MonkeyPatch, dtype: torch.dtype
    ) -> None:
        from gr00t.data.embodiment_tags import EmbodimentTag
        from gr00t.policy import gr00t_policy

        with built_without_flash_attention():
            self.policy = gr00t_policy.Gr00tPolicy(EmbodimentTag(robot), str(folder), device="cpu")
            if dtype != torch.bfloat16:  # to which the class rounds weights, buffers and inputs
                model = gr00t_policy.AutoModel.from_pretrained(folder, torch_dtype=dtype)
                model = model.to(dtype).eval()
                model.load_state_dict(load_file(folder / "model.safetensors"), strict=False)
                self.policy.model = model
                patch.setattr(gr00t_policy, "_rec_to_dtype", lambda value, **_: value)
        if hasattr(self.policy.model.backbone.model, "vision_model"):
            stand_in(patch, self.policy.model)

    def act(self, frames: list[Obs], kind: str, task: str) -> np.ndarray:
        """Return the chunk of one robot, (horizon, D), for the frames that the model reads."""
        configs, last = self.policy.modality_configs, frames[-1]
        cameras = dict(zip(configs["video"].modality_keys, last.cameras, strict=True))
        state = {**last.state, "gripper": np.float32([last.gripper or 0])}
        if kind == "libero":
            state["gripper"] = last.state["gripper_qpos"]
        videos = {}
        for key, camera in cameras.items():
            videos[key] = np.stack([frame.cameras[camera] for frame in frames])[None]
        states = {key: state[key][None, None] for key in configs["state"].modality_keys}
        language = {configs["language"].modality_keys[0]: [[task]]}
        actions, _ = self.policy.get_action(
            {"video": videos, "state": states, "language": language}
        )
        return np.concatenate([actions[key][0] for key in configs["action"].modality_keys], axis=-1)


@pytest.fixture
def upstream(
    checkpoint: Checkpoint, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Theirs]]:
    state = torch.random.get_rng_state()
    yield lambda kind, dtype=torch.float32: Theirs(
        checkpoint(kind), ROBOTS[kind], monkeypatch, dtype
    )
    torch.random.set_rng_state(state)


def draws_of(number: int) -> np.random.Generator:
    """Return a copy of the generator of session `number`."""
    return np.random.default_rng([0, number])


def test_keeps_the_contract(checkpoint: Checkpoint, checkout: Path) -> None:
    settings = {"checkpoint": str(checkpoint("relative")), "source_dir": str(checkout)}
    check_agent(Gr00t.from_config(settings), atol=ATOL)


@pytest.mark.verifies("parity")
@pytest.mark.parametrize("kind", ["relative", "libero"])
def test_its_actions_are_theirs_from_the_same_seed(
    policy_of: Policy, upstream: Callable[..., Theirs], kind: str
) -> None:
    policy, theirs = policy_of(kind, embodiment=ROBOTS[kind]), upstream(kind)
    for number in (0, 1):
        ours = begun(policy, number, kind).act(view(number, kind)).action
        torch.manual_seed(int(draws_of(number).integers(2**63)))
        expected = theirs.act([view(number, kind)], kind, TASKS[number])
        np.testing.assert_allclose(ours, expected, atol=ATOL)
        assert expected.shape == (tiny.HORIZON, 6 if kind == "relative" else 7)
        assert expected.std(axis=0).min() > 10 * ATOL  # no column is clipped to its bound


@pytest.mark.verifies("parity")
def test_earlier_frames_are_theirs(policy_of: Policy, upstream: Callable[..., Theirs]) -> None:
    policy, theirs = policy_of("history"), upstream("history")
    assert policy.contract.history == 3
    frames, session = [view(number) for number in (0, 3, 6)], begun(policy)
    for step, obs in enumerate(frames):
        draws = copy.deepcopy(session.episode.rng)
        torch.manual_seed(int(draws.integers(2**63)))
        expected = theirs.act([frames[max(0, step - 2)], obs], "history", TASKS[0])
        np.testing.assert_allclose(session.act(obs).action, expected, atol=ATOL)


@pytest.mark.verifies("parity")
def test_in_bfloat16_its_actions_are_those_of_their_class_as_it_is(
    policy_of: Policy, upstream: Callable[..., Theirs]
) -> None:
    policy, theirs = policy_of("relative", dtype="bfloat16"), upstream("relative", torch.bfloat16)
    ours = begun(policy).act(view(0)).action
    with RowDraws([draws_of(0)]):  # torch itself draws different numbers in bfloat16
        expected = theirs.act([view(0)], "relative", TASKS[0])
    # The range of an action is 2 wide, and bfloat16 has steps of 2**-8 in it.
    np.testing.assert_allclose(ours, expected, atol=0.05)
    different = begun(policy, 3).act(view(3)).action
    assert np.abs(different - expected).max() > 0.3


def test_it_acts_with_pushed_weights(policy_of: Policy) -> None:
    policy = policy_of("relative", seed=1)  # policy of this test alone
    # The names are those of NVIDIA's trainer.
    assert policy.parameters().keys() == policy.model.model.state_dict().keys()
    check_pushed_weights(policy, lambda: begun(policy).act(view(0)).action)


@pytest.mark.verifies("batches")
@pytest.mark.parametrize("kind", ["relative", "history"])
def test_a_session_gets_the_same_in_any_company(policy_of: Policy, kind: str) -> None:
    """Different tasks have prompts of different lengths, and larger images have more tokens."""
    policy = policy_of(kind)
    views = [view(0), view(1), view(2), view(3, size=(48, 120)), view(4), view(5)]
    alone = [begun(policy, number).act(obs).action for number, obs in enumerate(views)]
    for batch in ([1, 0], [2, 3, 4], [5, 4, 3, 2, 1, 0]):
        acts = policy.act_batch(
            [views[number] for number in batch], [begun(policy, number) for number in batch]
        )
        for number, act in zip(batch, acts, strict=True):
            assert isinstance(act, Act), act
            np.testing.assert_allclose(act.action, alone[number], atol=ATOL)
    assert np.ptp(np.stack(alone), axis=0).mean() > 100 * ATOL  # six answers, not one


@pytest.mark.parametrize(("kind", "sizes"), [("relative", [5]), ("history", [2, 3])])
def test_rows_share_a_pass_unless_padding_would_change_them(
    policy_of: Policy, monkeypatch: pytest.MonkeyPatch, kind: str, sizes: list[int]
) -> None:
    policy, rows_of_passes = policy_of(kind), list[int]()
    model = policy.model.model
    get_action = model.get_action

    def counting(inputs: Any) -> Any:
        rows_of_passes.append(len(inputs["state"]))
        return get_action(inputs)

    monkeypatch.setattr(model, "get_action", counting)
    sessions = [begun(policy, number) for number in (0, 1, 3, 4, 6)]  # TASKS[0], [1], [0], [1], [0]
    policy.act_batch([view(number) for number in range(5)], sessions)
    assert sorted(rows_of_passes) == ([2, 3] if tiny.N17 else sizes)  # N1.7 attends to padding


@pytest.mark.verifies("isolation")
def test_a_missing_camera_fails_its_own_session_alone(policy_of: Policy) -> None:
    policy = policy_of("relative")
    blind = Obs({}, 1.0, view(1).state)
    bad, good = policy.act_batch([blind, view(0)], [begun(policy, 1), begun(policy, 0)])
    assert isinstance(bad, MissingCamera)
    assert isinstance(good, Act)
    np.testing.assert_allclose(good.action, begun(policy).act(view(0)).action, atol=ATOL)


@pytest.mark.verifies("isolation")
def test_a_neighbour_changes_no_action(policy_of: Policy) -> None:
    policy, actions = policy_of("relative"), []
    for neighbour_obs in (view(2), view(3, size=(50, 90), **{SAMPLES: 3})):
        session, neighbour = begun(policy, 1), begun(policy, 4)
        policy.act_batch([view(1), neighbour_obs], [session, neighbour])
        [_, act] = policy.act_batch([neighbour_obs, view(5)], [neighbour, session])
        assert isinstance(act, Act)
        actions.append(act.action)
    np.testing.assert_allclose(*actions, atol=ATOL)


def test_samples_are_draws_of_their_own(policy_of: Policy) -> None:
    policy = policy_of("relative")
    act = begun(policy).act(view(0, **{SAMPLES: 4}))
    np.testing.assert_allclose(act.action, begun(policy).act(view(0)).action, atol=ATOL)
    assert act.info[DISTRIBUTION]["samples"].shape == (4, tiny.HORIZON, 6)
    assert act.info[DISTRIBUTION]["std"].mean() > 100 * ATOL


def test_the_checkpoints_metadata_are_the_contract(policy_of: Policy) -> None:
    trained = Trained.from_statistics(policy_of("relative").statistics)
    assert trained.state_names == ("arm", "gripper")
    assert trained.state is not None
    assert [len(bound) for bound in trained.state] == [6, 6]

    relative = policy_of("relative").contract
    assert relative.cameras == {"ego_view": CameraSpec()}
    assert relative.state == {"arm": StateSpec(5)}
    assert (relative.gripper, relative.instruction) == (True, True)
    assert relative.action == ActionSpec(dim=6, space="joint", delta=False)
    assert (relative.chunk, relative.history) == (tiny.HORIZON, 1)

    libero = policy_of("libero", embodiment=tiny.LIBERO).contract
    assert set(libero.cameras) == {"front", "wrist"}
    pose = dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), StateSpec(1))
    assert libero.state == pose | {"gripper_qpos": StateSpec(2)}
    assert (libero.gripper, libero.action) == (False, ActionSpec(dim=7))


def test_parts_of_a_state_with_other_names_are_set(
    policy_of: Policy, checkpoint: Checkpoint, checkout: Path
) -> None:
    policy = policy_of("libero", embodiment=tiny.LIBERO)
    settings = {
        "checkpoint": str(checkpoint("libero")),
        "source_dir": str(checkout),
        "embodiment": tiny.LIBERO,
    }
    renamed = Gr00t.from_config({**settings, "state": ["xyz_axis_angle", "gripper_qpos"]})
    renamed.model = policy.model

    obs = view(0, "libero")
    pose = np.concatenate([obs.state[axis] for axis in ("x", "y", "z", "roll", "pitch", "yaw")])
    state = {"xyz_axis_angle": pose, "gripper_qpos": obs.state["gripper_qpos"]}
    renamed_obs = Obs(obs.cameras, None, state)
    expected = begun(policy, 0, "libero").act(obs).action
    session = copy.copy(renamed)
    session.reset(renamed_obs, TASKS[0], seed=0)
    np.testing.assert_allclose(session.act(renamed_obs).action, expected, atol=ATOL)


def test_the_whole_folder_is_the_policys_identity(
    checkpoint: Checkpoint, checkout: Path, tmp_path: Path
) -> None:
    """This includes the processor's files in a separate folder, where the training of N1.7 saves
    them.
    """
    folder = Path(shutil.copytree(checkpoint("relative"), tmp_path / "trained"))
    (folder / "processor").mkdir()
    for name in ("processor_config.json", "statistics.json", "embodiment_id.json"):
        (folder / name).rename(folder / "processor" / name)
    with used_checkpoints() as used:
        policy = Gr00t.from_config(
            {"checkpoint": str(folder), "source_dir": str(checkout), "steps": 2}
        )
        policy.initialize()
    assert used == [folder]
    assert policy.model is not None
    assert policy.model.model.action_head.num_inference_timesteps == 2
    policy.close()
    assert policy.model is None


@pytest.mark.parametrize("lengths", [[4, 4, 4], [2, 5, 3]])
def test_packed_images_do_not_see_each_other(lengths: list[int]) -> None:
    query, key, value = torch.randn(
        3, 1, 2, sum(lengths), 8, generator=torch.Generator().manual_seed(0)
    )
    image = torch.repeat_interleave(torch.arange(3), torch.tensor(lengths))
    expected = attend(query, key, value, 0.3, image[:, None] == image[None, :]).transpose(1, 2)
    attended, _ = packed_attention(None, query, key, value, scaling=0.3, seq_len_list=lengths)
    torch.testing.assert_close(attended, expected)
