"""What of a checkpoint or its settings does not fit is said before anything is served, and none
of its code is run.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plugins.vlagents_ray_models.tests.families.gr00t import tiny
from plugins.vlagents_ray_models.tests.families.gr00t.conftest import MARKS, Checkpoint
from vlagents_ray.errors import ConfigError
from vlagents_ray_models import gr00t
from vlagents_ray_models.gr00t import Gr00t
from vlagents_ray_models.model_code import remote_code

pytestmark = MARKS

Spoil = Callable[[Path], None]


def load(folder: Path, checkout: Path, **config: Any) -> Gr00t:
    policy = Gr00t.from_config({"checkpoint": str(folder), "source_dir": str(checkout), **config})
    policy.model = policy.load()
    return policy


@pytest.fixture
def copied(checkpoint: Checkpoint, tmp_path: Path) -> Path:
    """A copy of the checkpoint, to be spoilt."""
    return Path(shutil.copytree(checkpoint("relative"), tmp_path / "spoilt"))


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({}, rf"embodiment: expected one of \['{tiny.LIBERO}', 'new_embodiment'\], got None"),
        (
            {"embodiment": "ours"},
            rf"expected one of \['{tiny.LIBERO}', 'new_embodiment'\], got 'ours'",
        ),
        ({"embodiment": tiny.LIBERO, "device": "tpu:1"}, "device 'tpu:1': not available"),
        (
            {"embodiment": tiny.LIBERO, "checkpoint_step": 8, "checkpoint": "/nowhere/{step}"},
            "no such file",
        ),
    ],
)
def test_settings_that_do_not_fit_the_checkpoint(
    checkpoint: Checkpoint, checkout: Path, config: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        load(checkpoint("libero"), checkout, **config)


def test_cameras_of_other_names(checkpoint: Checkpoint, checkout: Path) -> None:
    with pytest.raises(ConfigError, match=r"expected .* \['ego_view'\], got \['front'\]"):
        load(checkpoint("relative"), checkout, cameras={"front": "front"})


def without(name: str) -> Spoil:
    return lambda folder: (folder / name).unlink()


def changed(name: str, *keys: str, value: Any = None) -> Spoil:
    """Change a value in a JSON file, or remove it."""

    def spoil(folder: Path) -> None:
        whole = json.loads((folder / name).read_text())
        within = whole
        for key in keys[:-1]:
            within = within[key]
        if value is None:
            del within[keys[-1]]
        else:
            within[keys[-1]] = value
        (folder / name).write_text(json.dumps(whole))

    return spoil


def tensor(name: str, *, drop: bool) -> Spoil:
    """Drop a tensor of the weights, or shorten it."""

    def spoil(folder: Path) -> None:
        from safetensors.torch import load_file, save_file

        saved = load_file(folder / "model.safetensors")
        whole = saved.pop(name)
        save_file(
            saved if drop else {**saved, name: whole[:-1]},
            folder / "model.safetensors",
            {"format": "pt"},
        )

    return spoil


STATISTICS = ("statistics.json", "new_embodiment")
MODALITIES = ("processor_config.json", "processor_kwargs", "modality_configs")


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (without("config.json"), r"expected \['config.json'\]"),
        (without("model.safetensors"), r"expected \['\*.safetensors'\]"),
        (
            without("processor_config.json"),
            "expected processor_config.json, got .*save the checkpoint's processor",
        ),
        (
            without("statistics.json"),
            "expected statistics.json, got .*save the checkpoint's processor",
        ),
        (
            changed(*STATISTICS, "state", "arm"),
            r"expected \['min', 'max'\] of state 'arm' in .*, got those of \['gripper'\]",
        ),
        (changed(*STATISTICS, "action", "arm", "max"), "of action 'arm'.*numbers have no units"),
        (
            changed(*STATISTICS, "state", "arm", "min", value=[float("nan")] * 5),
            "state 'arm' are not all finite",
        ),
        (changed(*STATISTICS, "relative_action"), "Relative action statistics"),
        (
            changed(*STATISTICS),
            r"expected one of \[\], got .*; \['new_embodiment'\] have no statistics",
        ),
        (changed(*MODALITIES, value={}), r"embodiment: expected one of \[\], got None"),
        (
            changed(*MODALITIES, "new_embodiment", "action", "delta_indices", value=[*range(9)]),
            "9 rows.*at most 8",
        ),
        (
            changed("config.json", "model_type", value="gr00t_n1_5"),
            "expected a model_type .*got 'gr00t_n1_5'.*policy `upstream`",
        ),
        (
            changed("config.json", "model_type", value="Gr00tN1d9"),
            "'Gr00tN1d9'.*name the checkout of its version",
        ),
        (
            changed("config.json", "model_type"),
            "expected a model_type .*got None.*is served by the policy `lerobot`",
        ),
        (tensor("action_head.vlln.weight", drop=True), r"does not fill.*action_head.vlln.weight"),
        (tensor("action_head.vlln.weight", drop=False), "action_head.vlln.weight|size mismatch"),
    ],
)
def test_a_checkpoint_that_is_not_whole(
    copied: Path, checkout: Path, spoil: Spoil, message: str
) -> None:
    spoil(copied)
    with pytest.raises(ConfigError, match=message):
        load(copied, checkout)


@pytest.mark.verifies("loading")
def test_a_robot_of_which_the_model_has_no_number(copied: Path, checkout: Path) -> None:
    for name in ("statistics.json", "processor_config.json"):
        text = (copied / name).read_text()
        (copied / name).write_text(text.replace('"new_embodiment"', '"ours"'))
    with pytest.raises(
        ConfigError,
        match=r"embodiment: expected one in embodiment_id.json, .*'new_.*got 'ours'",
    ):
        load(copied, checkout)


@pytest.mark.verifies("loading")
def test_a_folder_that_is_no_checkout_or_an_older_one(
    checkpoint: Checkpoint, checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match=r"'gr00t': neither installed nor in .*GR00T_SRC"):
        load(checkpoint("relative"), tmp_path)
    monkeypatch.setattr(gr00t.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=r"expected GR00T's code of N1\.6 .*policy `upstream`"):
        load(checkpoint("relative"), checkout)


@pytest.mark.skipif(not tiny.N17, reason="N1.6 has its backbone in the checkout")
def test_a_backbone_in_another_folder_is_named(copied: Path, checkout: Path) -> None:
    elsewhere = str(copied / "nvidia/Cosmos-Reason2-2B")
    missing = "/nowhere/nvidia/Cosmos-Reason2-2B"
    changed("config.json", "model_name", value=missing)(copied)
    changed("processor_config.json", "processor_kwargs", "model_name", value=missing)(copied)
    with pytest.raises(ConfigError, match="a folder that `backbone` names"):
        load(copied, checkout)
    assert load(copied, checkout, backbone=elsewhere).model is not None


def evil(folder: Path, *names: str) -> Path:
    """Put code into modules of a folder; returns the file that it writes."""
    done = folder / "done.txt"
    for name in names:
        (folder / f"{name}.py").write_text(f"open({str(done)!r}, 'w').close()\nclass Evil: pass\n")
    return done


@pytest.mark.verifies("loading")
def test_the_code_of_a_checkpoint_is_not_run(copied: Path, checkout: Path) -> None:
    done = evil(copied, "evil")
    names = dict.fromkeys(
        ("AutoConfig", "AutoModel", "AutoProcessor", "AutoTokenizer"), "evil.Evil"
    )
    changed("config.json", "auto_map", value=names)(copied)
    changed("processor_config.json", "auto_map", value=names)(copied)
    assert load(copied, checkout).model is not None
    assert not done.exists()
    changed("processor_config.json", "processor_class", value="Evil")(copied)
    with pytest.raises(ConfigError):
        load(copied, checkout)
    assert not done.exists()


@pytest.mark.verifies("loading")
def test_transformers_imports_the_checkouts_code_and_none_of_the_same_name(
    checkout: Path, tmp_path: Path
) -> None:
    """As a backbone is imported, whose library says `trust_remote_code=True` of whatever it is
    given.
    """
    from transformers import AutoConfig

    own = checkout / "gr00t/model/family/parts"
    theirs = tmp_path / "parts"
    for folder in (own, theirs):
        folder.mkdir(parents=True)
        (folder / "config.json").write_text(
            json.dumps({"auto_map": {"AutoConfig": "settings.Own"}})
        )
    done = evil(theirs, "settings")
    code = (
        "from transformers import PretrainedConfig\nclass Own(PretrainedConfig):\n    "
        "model_type = 'own'\n"
    )
    (own / "settings.py").write_text(code)
    with remote_code(allowed=False, source=checkout / "gr00t/model"):
        assert AutoConfig.from_pretrained(own, trust_remote_code=True).model_type == "own"
        with pytest.raises(ConfigError, match="trust_remote_code"):
            AutoConfig.from_pretrained(theirs, trust_remote_code=True)
    assert not done.exists()
    shutil.rmtree(checkout / "gr00t/model/family")
