"""What a checkpoint's processors may name is decided from the JSON, before anything of it is imported."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.lerobot.processors import require_known_steps

PROCESSOR = """
import subprocess
from subprocess import Popen

class ProcessorStep: ...
class Unregistered(ProcessorStep): ...
class NoStep: ...
def make(): return Unregistered()
"""


@pytest.fixture(autouse=True)
def lerobot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A stand-in for LeRobot, whose processors' module imports others as any module does."""
    package = tmp_path / "site" / "lerobot"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "processor.py").write_text(PROCESSOR)
    monkeypatch.syspath_prepend(str(package.parent))
    own = {name: module for name, module in sys.modules.items() if name.partition(".")[0] == "lerobot"}
    for name in own:
        monkeypatch.delitem(sys.modules, name)
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] == "lerobot"]:
        del sys.modules[name]


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
    file = pipeline(tmp_path, REGISTERED, {"class": name, "config": {"args": ["/bin/sh", "-c", "exit"]}})
    with pytest.raises(
        ConfigError, match=r"policy_preprocessor\.json: got a step of the class .* trust_remote_code: true"
    ):
        require_known_steps(file)


def test_a_step_that_says_nothing_of_its_class_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="None"):
        require_known_steps(pipeline(tmp_path, {"config": {}}))


def test_what_would_be_imported_is_not_when_it_is_refused(tmp_path: Path) -> None:
    (tmp_path / "site" / "evil.py").write_text("raise SystemExit('was imported')")
    with pytest.raises(ConfigError, match="evil"):
        require_known_steps(pipeline(tmp_path, {"class": "evil.Step"}))


def test_registered_steps_and_lerobots_own_pass(tmp_path: Path) -> None:
    require_known_steps(pipeline(tmp_path))
    # LeRobot looks at the class only where there is no registered name.
    both = {"registry_name": "device_processor", "class": "subprocess.Popen"}
    require_known_steps(pipeline(tmp_path, REGISTERED, both, {"class": "lerobot.processor.Unregistered"}))
