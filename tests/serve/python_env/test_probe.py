"""The settings of an environment in a deployment file, and the errors of the environment that it
names.
"""

from __future__ import annotations

import platform
import re
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import ValidationError
from virtual_environments import ROOT, layered

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import requirements_file
from vlagents_ray.serve.config.deployment import EnvironmentArgs
from vlagents_ray.serve.launch.deployment_file import read_deployment
from vlagents_ray.serve.python_env import probe as interpreter
from vlagents_ray.serve.python_env.create import create
from vlagents_ray.serve.python_env.probe import check_policy, probe, with_process


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """An empty environment, and an empty working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    return str(create(tmp_path / "bare"))


def script(path: Path, text: str, mode: int = 0o755) -> str:
    path.write_text(text)
    path.chmod(mode)
    return str(path)


def args(**environment: Any) -> EnvironmentArgs:
    return EnvironmentArgs(**environment)


def test_an_interpreter_that_is_a_link_stays_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The interpreter of a virtual environment is a link to its base interpreter, which would not
    find the environment's packages.
    """
    link = tmp_path / "python"
    link.symlink_to(sys.executable)
    monkeypatch.chdir(tmp_path)
    assert args(python=str(link)).python == args(python="python").python == str(link)


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"process": "child"}, "expected `python` to be set as well, got 'child'"),
        ({"process": "thread", "python": "p"}, "'auto', 'replica' or 'child'"),
        ({"pythn": "p"}, "Extra inputs"),
    ],
)
def test_what_contradicts_itself_is_refused(environment: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        args(**environment)


def test_what_ray_is_told() -> None:
    assert args().runtime_env() == {}
    assert with_process(args()) == args(), "the cluster's own"
    assert args(python="/p", process="replica", env_vars={"A": "b"}).runtime_env() == {
        "py_executable": "/p",
        "env_vars": {"A": "b"},
    }
    assert args(python="/p", process="child", env_vars={"A": "b"}).runtime_env() == {}


def test_the_same_python_and_ray_host_the_replica() -> None:
    found = probe(sys.executable)
    assert found.versions["python"] == platform.python_version()
    assert found.obstacle_to_replicas() is None
    assert with_process(args(python=sys.executable)).process == "replica"
    assert with_process(args(python=sys.executable, process="child")).process == "child"


def test_another_python_or_ray_makes_a_child(monkeypatch: pytest.MonkeyPatch) -> None:
    found = probe(sys.executable)
    for name, version, said in (
        ("python", "3.10.1", "it has Python 3.10.1, the cluster has Python 3."),
        ("ray", "2.40.0", "it has Ray 2.40.0, the cluster has"),
        ("ray", None, "it has no Ray, the cluster has"),
    ):
        versions = {
            key: value
            for key, value in {**found.versions, name: version}.items()
            if value is not None
        }
        other = interpreter.EnvironmentProbe(versions)
        monkeypatch.setattr(interpreter, "probe", lambda *_, other=other: other)
        assert with_process(args(python=sys.executable)).process == "child"
        with pytest.raises(
            ConfigError,
            match=rf"expected 'child' or 'auto', got 'replica', which cannot run in .*{said}",
        ):
            with_process(args(python=sys.executable, process="replica"))


def test_no_such_interpreter(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError,
        match=r"expected an interpreter, got '/no/such/python', which does not exist; create one",
    ):
        probe("/no/such/python")
    for deployment in sorted((ROOT / "deployments").glob("*.yaml")):
        stated = yaml.safe_load(deployment.read_text())["applications"][0]["args"]
        if (python := stated.get("environment", {}).get("python")) is None:
            continue
        with pytest.raises(ConfigError) as caught:
            probe(str(tmp_path / python))
        [(requirements, folder)] = re.findall(
            r"`vlagents-ray venv create (\S+) --out (\S+)`", str(caught.value)
        )
        assert requirements_file(requirements).is_file()
        assert Path(folder, "bin/python") == tmp_path / python
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "python").symlink_to(sys.executable)
    with pytest.raises(ConfigError, match=rf"did you mean {tmp_path}/bin/python\?"):
        probe(str(tmp_path))


@pytest.mark.parametrize(
    ("text", "mode", "said"),
    [
        (
            "#!/bin/sh\necho hello\n",
            0o755,
            "expected a Python interpreter, got .*, which is another program, or broken: hello",
        ),
        ("#!/bin/sh\nexit 1\n", 0o755, "no output"),
        ("#!/bin/sh\n", 0o644, "Permission denied"),
        ("not a program", 0o755, "expected a Python interpreter"),
        (
            '#!/bin/sh\necho \'VLA{"python": "3.8.10"}\'\n',
            0o755,
            r"expected Python 3.10 or newer, got .*, which is 3.8.10",
        ),
    ],
)
def test_not_an_interpreter(tmp_path: Path, text: str, mode: int, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        probe(script(tmp_path / "python", text, mode))


def test_settings_stand_on_no_command_line_where_every_user_could_read_them(tmp_path: Path) -> None:
    echoing = script(tmp_path / "python", '#!/bin/sh\nshift 2\necho "arguments: $@"\n')
    with pytest.raises(ConfigError, match="arguments: ray") as error:
        check_policy(args(python=echoing), "noop", {"token": "a secret"})
    assert "a secret" not in str(error.value)


def test_an_environment_without_this_package_or_with_another_version_of_it(bare: str) -> None:
    with pytest.raises(
        ConfigError,
        match=r"expected .* as here, got no vlagents-ray in .*; install that version there",
    ):
        probe(bare)
    [packages] = Path(bare).parents[1].glob("lib/python*/site-packages")
    (packages / "vlagents_ray-0.0.9.dist-info").mkdir()
    (packages / "vlagents_ray-0.0.9.dist-info" / "METADATA").write_text(
        "Name: vlagents-ray\nVersion: 0.0.9\n"
    )
    with pytest.raises(ConfigError, match=r"expected .*, got vlagents-ray 0.0.9"):
        probe(bare)


@pytest.mark.slow
def test_the_policy_is_built_where_it_will_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The policy's module exists only in its own environment."""
    python = layered(tmp_path / "env", "six==1.15.0")
    [packages] = python.parents[1].glob("lib/python*/site-packages")
    (packages / "only_there.py").write_text(
        "import os, six\n"
        "from vlagents_ray import ActionSpec, Agent, Contract\n"
        "print('a greeting')\n"
        "class Policy(Agent):\n"
        "    contract = Contract(action=ActionSpec(dim=int(six.__version__.split('.')[1])))\n"
        "    def __init__(self, gain=1.0):\n"
        "        os.environ['SOURCE']\n"
        "    def act(self, obs):\n"
        "        raise NotImplementedError\n"
    )
    environment = args(python=str(python), env_vars={"SOURCE": "/src"})
    contract = check_policy(environment, "only_there:Policy", {"gain": 2.0})
    assert contract.action.dim == 15
    with pytest.raises(ConfigError, match=rf"in {python}: policy Policy: .*'gane'"):
        check_policy(environment, "only_there:Policy", {"gane": 2.0})
    with pytest.raises(
        ConfigError, match=rf"in {python}: policy only_there:Policy: KeyError: 'SOURCE'"
    ):
        check_policy(args(python=str(python)), "only_there:Policy", {})
    with pytest.raises(ConfigError, match=rf"in {python}: .*no class 'Police'"):
        check_policy(environment, "only_there:Police", {})
    monkeypatch.chdir(tmp_path)
    document = {
        "name": "there",
        "import_path": "vlagents_ray.serve.app:build",
        "args": {
            "policy": "only_there:Policy",
            "environment": {"python": "env/bin/python", "env_vars": {"SOURCE": "/src"}},
        },
    }
    Path("deployment.yaml").write_text(yaml.safe_dump({"applications": [document]}))
    [app] = read_deployment("deployment.yaml").applications
    assert app.args["environment"]["python"] == str(python), "Ray must not receive a relative path"


def test_an_interpreter_that_does_not_answer_in_time_is_named_without_its_script(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("vlagents_ray.serve.python_env.probe._TIMEOUT_S", 0.001)
    with pytest.raises(
        ConfigError,
        match=r"runs on this machine, got .* \(no answer in 0.001 s; is the machine busy\?\)$",
    ):
        probe(sys.executable)
