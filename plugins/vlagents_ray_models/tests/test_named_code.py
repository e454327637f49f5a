"""The classes that a checkpoint of LeRobot or of Octo names are checked in its JSON, before
anything is imported.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.checkpoint import used_checkpoints
from vlagents_ray_models.lerobot.processors import require_known_steps
from vlagents_ray_models.octo import OctoConfig, OctoNetwork, require_own_classes

SOURCE = {
    "lerobot/processor.py": """
import subprocess
from subprocess import Popen

class ProcessorStep: ...
class Unregistered(ProcessorStep): ...
class NoStep: ...
def make(): return Unregistered()
""",
    "octo/model/components/tokenizers.py": """
from subprocess import Popen
import os
class ImageTokenizer: ...
def spec(): ...
""",
    "octo/model/components/vit_encoders.py": "class SmallStem32: ...",
    "octo/data/utils/text_processing.py": "class HFTokenizer: ...",
}


@pytest.fixture(autouse=True)
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install stand-ins for LeRobot and Octo, whose modules import other modules, such as
    `subprocess`, as real ones do.
    """
    for name, source in SOURCE.items():
        file = tmp_path / "site" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(source)
        for folder in file.relative_to(tmp_path / "site").parents:
            (tmp_path / "site" / folder / "__init__.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    for name in imported():
        monkeypatch.delitem(sys.modules, name)
    yield
    for name in imported():
        del sys.modules[name]


def imported() -> list[str]:
    return [name for name in sys.modules if name.partition(".")[0] in ("lerobot", "octo")]


def pipeline(folder: Path, *steps: dict[str, Any]) -> Path:
    file = folder / "policy_preprocessor.json"
    file.write_text(json.dumps({"name": "policy_preprocessor", "steps": list(steps)}))
    return file


REGISTERED = {"registry_name": "normalizer_processor", "config": {"class": "subprocess.Popen"}}


@pytest.mark.parametrize(
    "name",
    [
        "subprocess.Popen",
        "os.system",
        "lerobot.processor.Popen",
        "lerobot.processor.subprocess.Popen",
        "lerobot.processor.NoStep",
        "lerobot.processor.make",
        "lerobot.processor.Missing",
        "lerobot.missing.Unregistered",
        "lerobot",
        "lerobot_evil.Step",
        "evil.lerobot.Step",
        "Popen",
        "",
        None,
        7,
        {"class": "os.system"},
    ],
)
def test_a_step_that_is_not_lerobots_is_refused_with_the_cure(name: object, tmp_path: Path) -> None:
    file = pipeline(
        tmp_path, REGISTERED, {"class": name, "config": {"args": ["/bin/sh", "-c", "exit"]}}
    )
    with pytest.raises(
        ConfigError,
        match=r"policy_preprocessor\.json: expected a step with a registry_name.* trust_remote_code: true",
    ):
        require_known_steps(file)


def test_a_step_without_a_class_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="None"):
        require_known_steps(pipeline(tmp_path, {"config": {}}))


def test_a_refused_step_is_not_imported(tmp_path: Path) -> None:
    (tmp_path / "site" / "evil.py").write_text("raise SystemExit('was imported')")
    with pytest.raises(ConfigError, match="evil"):
        require_known_steps(pipeline(tmp_path, {"class": "evil.Step"}))


def test_registered_steps_and_lerobots_own_pass(tmp_path: Path) -> None:
    require_known_steps(pipeline(tmp_path))
    # LeRobot reads the class only if there is no registered name.
    both = {"registry_name": "device_processor", "class": "subprocess.Popen"}
    require_known_steps(
        pipeline(tmp_path, REGISTERED, both, {"class": "lerobot.processor.Unregistered"})
    )


def spec(module: object, name: object, **kwargs: Any) -> dict[str, Any]:
    return {"module": module, "name": name, "args": [], "kwargs": kwargs}


STEM = spec("octo.model.components.vit_encoders", "SmallStem32", features=[32, 32])
IMAGES = spec("octo.model.components.tokenizers", "ImageTokenizer", encoder=STEM)
TEXT = spec("octo.data.utils.text_processing", "HFTokenizer", tokenizer_name="t5-base")


def config(folder: Path, text: Any = TEXT, encoder: Any = STEM, **more: Any) -> Path:
    file = folder / "config.json"
    model = {
        "observation_tokenizers": {"primary": IMAGES | {"kwargs": {"encoder": encoder}}},
        "heads": {},
    }
    file.write_text(json.dumps({"model": model, "text_processor": text, **more}))
    return file


def test_octos_own_pass_and_what_only_its_training_called_is_not_looked_at(tmp_path: Path) -> None:
    training = {"dataset_kwargs": {"standardize_fn": spec("my_lab.transforms", "standardize")}}
    require_own_classes(config(tmp_path, **training))
    require_own_classes(config(tmp_path, text=None))


FOREIGN = [
    spec("os", "system"),
    spec("subprocess", "Popen"),
    spec("octopus.model.components.x", "X"),
    spec("octo", "X"),
    spec("octo.utils.spec", "_import_from_string"),
    spec("octo.model.components.tokenizers", "Popen"),
    spec("octo.model.components.tokenizers", "os"),
    spec("octo.model.components.tokenizers", "spec"),
    spec("octo.model.components.tokenizers", "os.system"),
    spec("octo.model.components.tokenizers", "Missing"),
    spec(None, "X"),
    spec("octo.model.components.tokenizers", ["ImageTokenizer"]),
]


@pytest.mark.parametrize("foreign", FOREIGN, ids=lambda named: f"{named['module']}:{named['name']}")
def test_anything_else_is_refused_at_every_depth_with_the_cure(
    foreign: dict[str, Any], tmp_path: Path
) -> None:
    deep = STEM | {"kwargs": {"norm": [{"here": foreign}]}}
    for changed in (
        {"text": foreign},
        {"encoder": foreign},
        {"encoder": deep},
        {"text": TEXT | {"args": [foreign]}},
    ):
        with pytest.raises(
            ConfigError, match=r"config\.json: expected a class of .* trust_remote_code: true"
        ):
            require_own_classes(config(tmp_path, **changed))


def test_a_refused_class_is_not_imported(tmp_path: Path) -> None:
    (tmp_path / "site" / "evil.py").write_text("raise SystemExit('was imported')")
    with pytest.raises(ConfigError, match="evil"):
        require_own_classes(config(tmp_path, text=spec("evil", "Evil")))
    assert imported() == []


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"model": {}}'])
def test_a_file_that_is_no_configuration_is_an_error(text: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ConfigError, match="not a configuration of Octo's"):
        require_own_classes(tmp_path / "config.json")


def test_octo_loads_nothing_before_the_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This is different if the checkpoint is trusted."""
    loaded: list[str] = []

    class OctoModel:
        @staticmethod
        def load_pretrained(folder: str, step: int) -> None:
            loaded.append(f"{folder}/{step}")
            raise KeyError("the stand-in has no model")

    monkeypatch.setattr("vlagents_ray_models.octo.octo_model_class", lambda _source_dir: OctoModel)
    monkeypatch.setattr("vlagents_ray_models.octo.jax_device", lambda name: name)
    folder = config(tmp_path, text=spec("os", "system")).parent
    for name in ("example_batch.msgpack", "dataset_statistics.json", "7/default"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).touch()
    with used_checkpoints() as used, pytest.raises(ConfigError, match="got 'system' of 'os'"):
        OctoNetwork.load(OctoConfig(checkpoint=str(folder)))
    assert loaded == []
    assert [path.name for path in used] == [
        "config.json",
        "example_batch.msgpack",
        "dataset_statistics.json",
        "7",
    ]
    with pytest.raises(ConfigError, match="the stand-in has no model"):
        OctoNetwork.load(OctoConfig(checkpoint=str(folder), trust_remote_code=True))
    assert loaded == [f"{folder}/7"]
