"""Whatever is missing, unknown or random in a checkpoint is an error before anything is served."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from plugins.vlagents_ray_models.tests.families.lerobot import tiny
from plugins.vlagents_ray_models.tests.families.lerobot.conftest import (
    FILTERS,
    PATCHED,
    Load,
    Made,
    begun,
    view,
)
from vlagents_ray.contract import CameraSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray_models.lerobot import LeRobot, checkpoint
from vlagents_ray_models.lerobot.config import LeRobotConfig

pytestmark = FILTERS

UNPATCHED = () if PATCHED else ("pi0", "pi05")
Change = Callable[[Path], Any]
PRE, POST = "policy_preprocessor", "policy_postprocessor"
TOP = f"observation.images.{tiny.CAMERA}"


def opened(folder: Path, **config: Any) -> LeRobot:
    policy = LeRobot.from_config({"checkpoint": str(folder), **config})
    policy.initialize()
    return policy


@pytest.fixture
def copied(made: Made, tmp_path: Path) -> Callable[[str], Path]:
    """A copy of the checkpoint of a kind, to be spoilt."""
    return lambda kind: Path(shutil.copytree(made(kind), tmp_path / kind))


def tensors(name: str, change: Callable[[dict[str, Any]], Any]) -> Change:
    def spoil(folder: Path) -> None:
        [file] = folder.glob(name)
        saved = load_file(file)
        change(saved)
        save_file(saved, file)

    return spoil


def settings(**changed: Any) -> Change:
    def spoil(folder: Path) -> None:
        file = folder / "config.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), **changed}))

    return spoil


def step(added: dict[str, Any]) -> Change:
    def spoil(folder: Path) -> None:
        file = folder / f"{POST}.json"
        saved = json.loads(file.read_text())
        file.write_text(json.dumps({**saved, "steps": [*saved["steps"], added]}))

    return spoil


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (lambda folder: (folder / "config.json").unlink(), "config.json"),
        (lambda folder: (folder / "model.safetensors").unlink(), "model.safetensors"),
        (lambda folder: (folder / f"{PRE}.json").unlink(), "migrate_policy_normalization"),
        (lambda folder: (folder / f"{POST}.json").unlink(), f"{POST}.json"),
        (
            lambda folder: next(folder.glob(f"{POST}*.safetensors")).unlink(),
            "processors do not load",
        ),
        (
            tensors(f"{PRE}*.safetensors", lambda saved: saved.pop("observation.state.mean")),
            "'mean'.* of 'observation.state'",
        ),
        (
            tensors(f"{PRE}*.safetensors", lambda saved: saved.pop(f"{TOP}.std")),
            f"'std'.* of '{TOP}'",
        ),
        (
            tensors(f"{POST}*.safetensors", lambda saved: saved.pop("action.std")),
            "'std'.* of 'action'",
        ),
        (
            tensors(f"{POST}*.safetensors", lambda saved: saved["action.mean"].fill_(float("nan"))),
            "'mean'.* of 'action'",
        ),
        (
            tensors("model*", lambda saved: saved.pop("model.action_head.weight")),
            "model.action_head.weight",
        ),
        (settings(type="unheard_of"), "unheard_of"),
        (settings(of_another_version=1), f"venv create lerobot{'' if tiny.NEW else '06'}`"),
        (settings(chunk_size="many"), "chunk_size"),
        (settings(use_peft=True), "`adapter` to this folder"),
        (settings(dim_model=64), "cannot load"),
        (
            step({"class": "subprocess.Popen", "config": {"args": ["/bin/true"]}}),
            "trust_remote_code: true",
        ),
        (step({"class": "lerobot.processor.pipeline.importlib"}), "trust_remote_code: true"),
    ],
)
def test_a_spoilt_checkpoint_is_refused(
    spoil: Change, text: str, copied: Callable[[str], Path]
) -> None:
    folder = copied("act")
    spoil(folder)
    with pytest.raises(ConfigError, match=text):
        opened(folder)


STEP_OF_ITS_OWN = """
from pathlib import Path
from lerobot.processor import ProcessorStep

class Own(ProcessorStep):
    def __init__(self, proof):
        Path(proof).touch()
    def __call__(self, transition):
        return transition
    def transform_features(self, features):
        return features
"""


def test_a_step_of_the_checkpoints_own_runs_only_if_it_is_trusted(
    copied: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "own_steps.py").write_text(STEP_OF_ITS_OWN)
    folder, proof = copied("act"), tmp_path / "proof"
    step({"class": "own_steps.Own", "config": {"proof": str(proof)}})(folder)
    with pytest.raises(ConfigError, match=r"own_steps\.Own.*trust_remote_code: true"):
        opened(folder)
    assert "own_steps" not in sys.modules
    assert not proof.exists()
    opened(folder, trust_remote_code=True)
    assert proof.exists()


def test_a_step_that_takes_code_from_the_hub_by_itself_is_refused(
    copied: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LeRobot's own tokenizer of actions passes `trust_remote_code=True` with a name that the
    checkpoint gives.
    """
    folder, proof, hub = copied("act"), tmp_path / "proof", tmp_path / "hub"
    monkeypatch.setattr(
        "transformers.dynamic_module_utils.HF_MODULES_CACHE", str(tmp_path / "modules")
    )
    hub.mkdir()
    (hub / "processor_config.json").write_text(
        json.dumps({"processor_class": "Own", "auto_map": {"AutoProcessor": "own.Own"}})
    )
    (hub / "own.py").write_text(
        f"from pathlib import Path\nPath({str(proof)!r}).touch()\nclass Own: ..."
    )
    step(
        {
            "registry_name": "action_tokenizer_processor",
            "config": {"action_tokenizer_name": str(hub)},
        }
    )(folder)
    with pytest.raises(
        ConfigError, match=r"Python code of the checkpoint.*trust_remote_code: true"
    ):
        opened(folder)
    assert not proof.exists()
    with pytest.raises(ConfigError, match="processors do not load"):  # it is no processor
        opened(folder, trust_remote_code=True)
    assert proof.exists()


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    ("config", "text"),
    [
        ({"cameras": {"side": "front"}}, r"expected .* \['top'\]"),
        ({"cameras": {}}, r"expected .* \['top'\]"),
        ({"masked_cameras": ["top"]}, "needs all its cameras"),
        ({"masked_cameras": ["side"]}, "side"),
        ({"execute": tiny.CHUNK + 1}, f"{tiny.CHUNK} rows"),
        ({"overrides": {"num_inference_steps": 3}}, "num_inference_steps"),
        ({"overrides": {"chunk_size": "many"}}, "many"),
        ({"processors": {"tokenizer_processor": {}}}, "normalizer_processor"),
        ({"processors": {"normalizer_processor": {"nonsense": 1}}}, "processors do not load"),
        ({"dtype": "bfloat16"}, "for LeRobot's 'act', got 'bfloat16'"),
        ({"device": "cuda:77"}, "cuda:77"),
        ({"temperature": 1}, "temperature"),
    ],
)
def test_a_wrong_setting_is_refused(config: dict[str, Any], text: str, made: Made) -> None:
    with pytest.raises(ConfigError, match=text):
        opened(made("act"), **config)


@pytest.mark.parametrize(
    ("saved", "dtype", "device", "warned"),
    [
        ("float32", "auto", "cuda", True),
        ("float32", "auto", "cuda:1", True),
        ("bfloat16", "auto", "cuda", False),
        ("float32", "float32", "cuda", False),
        ("bfloat16", "bfloat16", "cuda", False),
        ("float32", "auto", "cpu", False),
        (None, "auto", "cuda", False),  # a type without the setting, such as ACT
    ],
)
def test_float32_that_nobody_chose_is_warned_of_on_a_gpu(
    saved: str | None, dtype: str, device: str, warned: bool, caplog: pytest.LogCaptureFixture
) -> None:
    config = LeRobotConfig(checkpoint="none", dtype=dtype)
    settings = SimpleNamespace() if saved is None else SimpleNamespace(dtype=saved)
    checkpoint._warn_of_float32(settings, config, torch.device(device))
    assert ("set the policy's dtype: bfloat16" in caplog.text) == warned


@pytest.mark.verifies("loading")
def test_a_residual_vq_that_is_not_trained_is_refused(copied: Callable[[str], Path]) -> None:
    folder = copied("vqbet")
    tensors(
        "model*", lambda saved: saved["vqbet.action_head.vqvae_model.discretized"].fill_(False)
    )(folder)
    with pytest.raises(ConfigError, match="not trained"):
        opened(folder)


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    ("name", "text"),
    [
        *(
            [("lingbot_va", "for one robot"), ("sac", "gaussian_actor.*venv create lerobot`")]
            if tiny.NEW
            else []
        ),
        *([] if tiny.NEW else [("groot", "GR00T"), ("multi_task_dit", "venv create lerobot06`")]),
        ("sarm", "rewards"),
        *((name, "openpi's changes") for name in UNPATCHED),
    ],
)
def test_a_type_that_cannot_be_served_says_why(
    name: str, text: str, copied: Callable[[str], Path]
) -> None:
    folder = copied("act")
    config = {**json.loads((folder / "config.json").read_text()), "type": name}
    known = ("type", "input_features", "output_features", "device")
    (folder / "config.json").write_text(json.dumps({key: config[key] for key in known}))
    with pytest.raises(ConfigError, match=text):
        opened(folder)


def test_a_step_of_training_is_found_as_lerobot_writes_it(made: Made, tmp_path: Path) -> None:
    shutil.copytree(made("act"), tmp_path / "checkpoints" / "020000" / "pretrained_model")
    policy = opened(tmp_path / "checkpoints" / "{step}", checkpoint_step=20000)
    assert policy.contract is not None
    with pytest.raises(ConfigError, match="no such"):
        opened(tmp_path / "checkpoints" / "{step}", checkpoint_step=40000)


def test_settings_of_the_checkpoint_can_be_overridden(loaded: Load, made: Made) -> None:
    settings = {"num_inference_steps": 10, "n_action_steps": 2}
    policy = opened(made("diffusion"), actions="chunk", overrides=settings)
    assert policy.contract is not None
    assert policy.contract.chunk == 2
    usual = begun(loaded("diffusion", actions="chunk")).act(view()).action
    assert not np.allclose(begun(policy).act(view()).action, usual[:2])


def test_a_checkpoints_cameras_may_be_renamed_or_masked(tmp_path: Path) -> None:
    features = {**tiny.inputs(), "observation.images.wrist": tiny.inputs()[TOP]}
    folder = tiny.make(tmp_path / "two", "smolvla", input_features=features, empty_cameras=1)
    renamed = opened(folder, rename_map={"observation.images.front": TOP}).contract
    assert renamed is not None
    assert renamed.cameras == {"front": CameraSpec(), "wrist": CameraSpec()}
    alone = opened(folder, masked_cameras=["wrist"])
    assert alone.contract is not None
    assert set(alone.contract.cameras or ()) == {tiny.CAMERA}
    assert np.isfinite(begun(alone).act(view()).action).all()
