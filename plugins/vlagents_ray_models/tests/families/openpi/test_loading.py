"""What keeps an openpi checkpoint from being served, each said before it is."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from plugins.vlagents_ray_models.tests.families.openpi.conftest import MARKS
from vlagents_ray.errors import ConfigError

pytestmark = MARKS


@pytest.fixture
def whole(checkpoint: Any, tmp_path: Path) -> Path:
    """A copy of a checkpoint, to be damaged."""
    shutil.copytree(checkpoint("pi0"), tmp_path / "step")
    return tmp_path / "step"


def load(folder: Path, **settings: Any) -> Any:
    from vlagents_ray_models.openpi import OpenPi

    config = {
        "config": "plugins.vlagents_ray_models.tests.families.openpi.tiny:PI0",
        "batch_sizes": [1],
        **settings,
    }
    return OpenPi.from_config({"checkpoint": str(folder), **config}).load()


@pytest.mark.verifies("loading")
def test_missing_statistics_are_an_error_that_names_those_that_are_there(whole: Path) -> None:
    (whole / "assets" / "tiny").rename(whole / "assets" / "other")
    with pytest.raises(
        ConfigError,
        match=r"no assets/tiny/libero/norm_stats\.json, has those of \['other/libero'\]",
    ):
        load(whole)


@pytest.mark.verifies("loading")
def test_statistics_without_those_of_actions_are_an_error(whole: Path) -> None:
    file = whole / "assets" / "tiny" / "libero" / "norm_stats.json"
    stats = json.loads(file.read_text())
    del stats["norm_stats"]["actions"]
    file.write_text(json.dumps(stats))
    with pytest.raises(ConfigError, match=r"expected \['actions'\] in"):
        load(whole)


def test_quantiles_that_a_config_needs_must_be_there(checkpoint: Any, tmp_path: Path) -> None:
    shutil.copytree(checkpoint("pi05"), tmp_path / "step")
    file = tmp_path / "step" / "assets" / "droid" / "norm_stats.json"
    stats = json.loads(file.read_text())
    stats["norm_stats"]["state"]["q01"] = None
    file.write_text(json.dumps(stats))
    with pytest.raises(ConfigError, match="quantile"):
        load(
            tmp_path / "step", config="plugins.vlagents_ray_models.tests.families.openpi.tiny:PI05"
        )


def test_the_folder_of_a_run_is_told_from_that_of_a_step(whole: Path) -> None:
    shutil.rmtree(whole / "params")
    with pytest.raises(
        ConfigError,
        match=r"expected params/ or model\.safetensors, got .*; name the folder of one step",
    ):
        load(whole)


@pytest.mark.verifies("loading")
def test_another_configs_checkpoint_does_not_fill_the_model(whole: Path, tiny: ModuleType) -> None:
    tiny.save_statistics(whole, "pi05")
    with pytest.raises(ConfigError, match="does not fill the model of config 'tiny_pi05_droid'"):
        load(whole, config="plugins.vlagents_ray_models.tests.families.openpi.tiny:PI05")


@pytest.mark.verifies("loading")
def test_lora_weights_are_not_dropped(checkpoint: Any, tmp_path: Path, tiny: ModuleType) -> None:
    import orbax.checkpoint

    with orbax.checkpoint.PyTreeCheckpointer() as saver:
        params = saver.restore(checkpoint("pi0") / "params")
        params["params"]["PaliGemma"]["llm"]["lora_a"] = params["params"]["action_out_proj"]["bias"]
        saver.save(tmp_path / "step" / "params", params)
    tiny.save_statistics(tmp_path / "step", "pi0")
    with pytest.raises(ConfigError, match="fine-tuned by LoRA"):
        load(tmp_path / "step")


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"config": "pi7"}, "not one of openpi's .*pi05_libero"),
        (
            {"config": "plugins.vlagents_ray_models.tests.families.openpi.tiny:NONE"},
            "expected an openpi TrainConfig, got NoneType",
        ),
        ({"config": "no_such_module:X"}, "no module 'no_such_module'"),
        ({"cameras": {"observation/image": "front"}}, "cameras: expected .*wrist_image.*got"),
        ({"cameras": {"image": "front", "wrist": "wrist"}}, "cameras: expected a mapping"),
        ({"device": "cuda:7"}, "device 'cuda:7'|device 'gpu:7'"),
        ({"compile": True}, "compile"),
        ({"source_dir": "/nowhere"}, "source_dir"),
    ],
)
def test_wrong_settings_are_named(checkpoint: Any, settings: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        load(checkpoint("pi0"), **settings)
