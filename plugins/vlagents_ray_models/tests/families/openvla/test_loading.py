"""A checkpoint or settings that do not fit are errors before anything is served."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from plugins.vlagents_ray_models.tests.families.openvla.conftest import LIBRARIES
from plugins.vlagents_ray_models.tests.families.openvla.upstream import VARIABLES
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import policy_class

pytestmark = [pytest.mark.source("OPENVLA_SRC"), pytest.mark.source("OPENVLA_OFT_SRC"), *LIBRARIES]


def load(policy: str, checkpoint: Path, **config: Any) -> None:
    policy_class(policy).from_config(
        {"checkpoint": str(checkpoint), "device": "cpu", **config}
    ).initialize()


@pytest.fixture
def copied(checkpoint: Callable[[str], Path], tmp_path: Path) -> Callable[[str], Path]:
    """A copy of a kind's checkpoint, to be damaged; large files are links."""
    return lambda kind: Path(
        shutil.copytree(checkpoint(kind), tmp_path / kind, copy_function=_link)
    )


def _link(source: str, target: str) -> None:
    if source.endswith((".safetensors", ".pt")):
        os.symlink(source, target)
    else:
        shutil.copy(source, target)


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    ("policy", "kind", "config", "message"),
    [
        (
            "openvla",
            "openvla",
            {"unnorm_key": "bridge"},
            r"expected one of .*bridge_orig.*libero_spatial.*got 'bridge'",
        ),
        (
            "openvla",
            "openvla",
            {"cameras": {"image_top": "front"}},
            r"expected .* \['image'\], got \['image_top'\]",
        ),
        (
            "openvla",
            "openvla",
            {"source_dir": "/nowhere"},
            r"expected a folder with prismatic.*, got \['/nowhere'\]",
        ),
        ("openvla", "openvla", {"trust_remote_code": True}, "expected code named in"),
        (
            "openvla",
            "openvla",
            {"trust_remote_code": True, "source_dir": "."},
            "expected one of them .*got both",
        ),
        (
            "openvla_oft",
            "oft",
            {"film": True},
            r"expected one file vision_backbone--STEP",
        ),
        (
            "openvla_oft",
            "oft",
            {"head": "diffusion"},
            "expected one file noisy_action_projector--STEP",
        ),
        ("openvla_oft", "oft", {"head": "tokens"}, "has action_head--.*do not use"),
        ("openvla_oft", "oft", {"state": []}, "has proprio_projector--.*do not use"),
        ("openvla_oft", "oft-film", {}, "has vision_backbone--.*do not use"),
        ("openvla_oft", "oft-diffusion", {}, "has noisy_action_projector--.*do not use"),
        (
            "openvla_oft",
            "oft",
            {"cameras": {"full_image": "front", "top": "top"}},
            r"expected .*, got \['full_image', 'top'\]",
        ),
        (
            "openvla_oft",
            "oft",
            {"cameras": {"wrist_image": "wrist"}},
            r"expected .* \['full_image', 'wrist_image'\]",
        ),
        ("openvla_oft", "oft", {"attention": "flash_attention_2"}, "attention"),
        ("openvla_oft", "oft", {"inference_steps": 51}, "expected at most 50, got 51"),
    ],
)
def test_settings_that_do_not_fit(
    checkpoint: Callable[[str], Path], policy: str, kind: str, config: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        load(policy, checkpoint(kind), **config)


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    "file",
    ["config.json", "preprocessor_config.json", "tokenizer_config.json", "model.safetensors"],
)
def test_a_checkpoint_that_is_not_whole(copied: Callable[[str], Path], file: str) -> None:
    folder = copied("openvla")
    (folder / file).unlink()
    with pytest.raises(ConfigError, match="expected"):
        load("openvla", folder)


@pytest.mark.verifies("loading")
def test_statistics_are_in_the_checkpoint_or_nothing_is_served(
    copied: Callable[[str], Path],
) -> None:
    folder = copied("openvla")
    statistics = json.loads((folder / "dataset_statistics.json").read_text())
    (folder / "dataset_statistics.json").unlink()
    with pytest.raises(
        ConfigError, match=r"expected dataset_statistics.json.*got no normalisation statistics"
    ):
        load("openvla", folder)

    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"norm_stats": statistics}))
    load("openvla", folder, unnorm_key="bridge_orig")


@pytest.mark.verifies("loading")
def test_weights_that_do_not_fill_the_model(copied: Callable[[str], Path]) -> None:
    folder = copied("oft")
    tensors = load_file(folder / "model.safetensors")
    del tensors["projector.fc2.weight"]
    (folder / "model.safetensors").unlink()
    save_file(tensors, folder / "model.safetensors", {"format": "pt"})
    with pytest.raises(ConfigError, match=r"1 parameters are not in it \['projector.fc2.weight'\]"):
        load("openvla_oft", folder)


def test_no_source_and_no_leave_to_run_remote_code(
    copied: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name)
    with pytest.raises(
        ConfigError, match=r"got no source tree; .*OPENVLA_SRC.*trust_remote_code: true"
    ):
        load("openvla", copied("remote"))


def test_either_source_serves_either_policy(
    checkpoint: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = [os.environ[name] for name in VARIABLES]
    for name in VARIABLES:
        monkeypatch.delenv(name)
    for source in sources:
        load("openvla", checkpoint("openvla"), source_dir=source)
        load("openvla_oft", checkpoint("oft"), source_dir=source)


def test_components_of_two_steps_are_not_guessed_between(copied: Callable[[str], Path]) -> None:
    folder = copied("oft")
    shutil.copy(
        folder / "action_head--100_checkpoint.pt", folder / "action_head--200_checkpoint.pt"
    )
    with pytest.raises(ConfigError, match=r"expected one file action_head--STEP.*got .*100.*200"):
        load("openvla_oft", folder)


def test_a_component_of_another_kind(copied: Callable[[str], Path]) -> None:
    folder = copied("oft")
    saved = torch.load(folder / "action_head--100_checkpoint.pt", weights_only=True)
    saved["module.model.fc3.weight"] = saved.pop("module.model.fc2.weight")
    (folder / "action_head--100_checkpoint.pt").unlink()
    torch.save(saved, folder / "action_head--100_checkpoint.pt")
    with pytest.raises(
        ConfigError,
        match=r"expected \['model.fc2.weight'\], got \['model.fc3.weight'\] in addition",
    ):
        load("openvla_oft", folder)
