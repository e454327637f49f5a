"""GR00T N1.7 by LeRobot 0.6: its actions, processors, embodiments and checkpoints."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from plugins.vlagents_ray_models.tests.families.lerobot import tiny
from plugins.vlagents_ray_models.tests.families.lerobot.conftest import (
    FILTERS,
    TASKS,
    Load,
    Made,
    begun,
    view,
)
from plugins.vlagents_ray_models.tests.families.lerobot.test_upstream import Theirs, draws_of
from vlagents_ray import Obs
from vlagents_ray.contract import CameraSpec, StateSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import SAMPLES, Act
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray_models.lerobot import LeRobot

pytestmark = FILTERS

ATOL = 1e-5
PRE, POST = "policy_preprocessor", "policy_postprocessor"
PACK, UNPACK = "groot_n1_7_pack_inputs_v1", "groot_action_unpack_unnormalize_v2"
ARM = tiny.STATE - 1


def opened(folder: Path, **config: Any) -> LeRobot:
    policy = LeRobot.from_config({"checkpoint": str(folder), **config})
    policy.initialize()
    return policy


@pytest.fixture
def copied(made: Made, tmp_path: Path) -> Path:
    """A copy of the checkpoint, to be spoilt."""
    return Path(shutil.copytree(made("groot"), tmp_path / "groot"))


def without(pipeline: str, name: str) -> Callable[[Path], None]:
    """Take a statistic from a pipeline."""

    def spoil(folder: Path) -> None:
        [file] = folder.glob(f"{pipeline}*.safetensors")
        saved = load_file(file)
        del saved[name]
        save_file(saved, file)

    return spoil


def step(pipeline: str, name: str, **changed: Any) -> Callable[[Path], None]:
    """Change the settings of a step."""

    def spoil(folder: Path) -> None:
        file = folder / f"{pipeline}.json"
        saved = json.loads(file.read_text())
        for one in saved["steps"]:
            if one.get("registry_name") == name:
                one["config"] |= changed
        file.write_text(json.dumps(saved))

    return spoil


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (without(PRE, "observation.state.min"), "'min'.* of 'observation.state'"),
        (without(PRE, "action.max"), "'max'.* of 'action'"),
        (without(POST, "action.min"), f"{POST}.*'min'.* of 'action'"),
        (step(PRE, PACK, embodiment_tag="ours"), "expected an embodiment of .*got 'ours'"),
        (lambda folder: shutil.rmtree(folder / "vlm"), r"cannot load it as 'groot'.*vlm"),
        (lambda folder: shutil.rmtree(folder / "base"), "has to be in the cache"),
    ],
)
def test_a_spoilt_checkpoint_is_refused(
    spoil: Callable[[Path], Any], text: str, copied: Path
) -> None:
    home = _home(copied)
    # Their folders are the copy's own.
    for file in ("config.json", f"{PRE}.json", "base/config.json"):
        (copied / file).write_text((copied / file).read_text().replace(home, str(copied)))
    opened(copied)
    spoil(copied)
    with pytest.raises(ConfigError, match=text):
        opened(copied)


@pytest.mark.verifies("loading")
def test_a_checkpoint_of_nvidias_is_refused_with_what_to_do(copied: Path) -> None:
    with pytest.raises(ConfigError, match=r"NVIDIA's own.*base_model_path"):
        opened(copied / "base")


@pytest.mark.verifies("loading")
def test_a_checkpoint_of_n1_5_is_refused(copied: Path) -> None:
    file = copied / "config.json"
    file.write_text(
        json.dumps({**json.loads(file.read_text()), "tokenizer_assets_repo": "lerobot/eagle2hg"})
    )
    with pytest.raises(ConfigError, match=r"N1\.5 support was removed"):
        opened(copied)


@pytest.mark.verifies("parity")
def test_its_actions_are_theirs_from_the_same_seed(loaded: Load, made: Made) -> None:
    policy, theirs = loaded("groot", actions="chunk"), Theirs(made("groot"))
    rows = begun(policy).act(view()).action
    torch.manual_seed(int(draws_of(policy).integers(2**63)))
    for row in rows:
        np.testing.assert_allclose(theirs.select(view()), row, atol=ATOL)


@pytest.mark.verifies("batches")
def test_a_session_gets_the_same_in_any_company(loaded: Load) -> None:
    """Those of other tasks have prompts of other lengths."""
    policy = loaded("groot", actions="chunk")
    alone = begun(policy, 1).act(view(1)).action
    for company in ([1, 2], [1, 4, 7], [0, 1, 2, 3, 4]):
        acts = policy.act_batch(
            [view(number) for number in company], [begun(policy, number) for number in company]
        )
        ours = acts[company.index(1)]
        assert isinstance(ours, Act)
        np.testing.assert_allclose(ours.action, alone, atol=ATOL)


@pytest.mark.verifies("isolation")
def test_a_neighbour_changes_no_action(loaded: Load) -> None:
    policy = loaded("groot", actions="chunk")
    found = []
    # Of the same task, of another size, with samples.
    for other in (view(2), view(3, side=96, **{SAMPLES: 3})):
        session, neighbour = begun(policy, 1), begun(policy, 4)
        policy.act_batch([view(1), other], [session, neighbour])
        [_, act] = policy.act_batch([other, view(5)], [neighbour, session])
        assert isinstance(act, Act)
        found.append(act.action)
    np.testing.assert_allclose(*found, atol=ATOL)


def test_rows_with_prompts_of_one_length_share_a_pass(
    loaded: Load, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = loaded("groot", actions="chunk")
    network, sizes = policy.model.sampler.policy._groot_model, []
    act = network.get_action
    monkeypatch.setattr(
        network, "get_action", lambda inputs: sizes.append(len(inputs["state"])) or act(inputs)
    )
    sessions = [begun(policy, number) for number in (0, 1, 3, 4, 6)]  # TASKS[0], [1], [0], [1], [0]
    policy.act_batch([view(number) for number in range(5)], sessions)
    assert sorted(sizes) == [2, 3]


@pytest.mark.verifies("parity")
def test_actions_relative_to_the_state_are_theirs_and_its_parts_are_the_contract(
    tmp_path: Path,
) -> None:
    """As NVIDIA's checkpoints have them: groups of the state and of actions, with bounds for
    each tick of a chunk.
    """
    folder = _with_groups(tmp_path / "native")
    policy, theirs = opened(folder, actions="chunk"), Theirs(folder)
    assert policy.contract is not None
    assert policy.contract.cameras == {tiny.CAMERA: CameraSpec()}
    assert policy.contract.state == {"arm": StateSpec(ARM)}
    assert policy.contract.gripper
    chunks = []
    for number in (0, 1):
        whole = view(number)
        parts = Obs(
            whole.cameras, float(whole.state["joints"][-1]), {"arm": whole.state["joints"][:-1]}
        )
        session = AgentCopies(policy).make()
        session.reset(parts, TASKS[0], seed=0)
        chunks.append((parts, session))
    ours = policy.act_batch([obs for obs, _ in chunks], [session for _, session in chunks])
    for number, act in enumerate(ours):
        torch.manual_seed(int(draws_of(policy).integers(2**63)))
        with torch.inference_mode():
            wanted = theirs.after(
                theirs.policy.predict_action_chunk(theirs.preprocess(view(number)))
            )[0].numpy()
        assert isinstance(act, Act)
        np.testing.assert_allclose(act.action, wanted[: tiny.EXECUTED], atol=ATOL)


def _home(folder: Path) -> str:
    """The folder in which a checkpoint was made, as it names it."""
    return str(Path(json.loads((folder / "config.json").read_text())["base_model_path"]).parent)


def _with_groups(folder: Path) -> Path:
    """A checkpoint over a base that names groups, some of whose actions are relative to the
    state.
    """
    folder.mkdir()
    config = tiny.groot(folder)
    rng = np.random.default_rng(1)

    def bounds(*shape: int) -> dict[str, Any]:
        low, width = rng.uniform(-1, 0, shape), rng.uniform(1, 2, shape)
        found = {
            "min": low,
            "max": low + width,
            "mean": low,
            "std": width,
            "q01": low,
            "q99": low + width,
        }
        return {name: value.tolist() for name, value in found.items()}

    names = ["arm", "gripper"]
    groups = {"arm": bounds(ARM), "gripper": bounds(1)}
    relative = {"arm": bounds(tiny.CHUNK, ARM)}
    actions = [
        {"rep": rep, "type": "non_eef", "format": "default"} for rep in ("relative", "absolute")
    ]
    ticks = {
        "modality_keys": names,
        "delta_indices": list(range(tiny.CHUNK)),
        "action_configs": actions,
    }
    modality = {
        "state": {"modality_keys": names, "delta_indices": [0]},
        "action": ticks,
        "video": {"modality_keys": [tiny.CAMERA], "delta_indices": [0]},
    }
    kept = {
        "modality_configs": {"new_embodiment": modality},
        "use_relative_action": True,
        "max_action_horizon": 8,
    }
    (folder / "base" / "processor_config.json").write_text(json.dumps({"processor_kwargs": kept}))
    stats = {"new_embodiment": {"state": groups, "action": groups, "relative_action": relative}}
    (folder / "base" / "statistics.json").write_text(json.dumps(stats))
    return tiny.write(folder, config)
