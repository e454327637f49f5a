"""Environments with other versions of Python and of Ray, in which `version_check.py` runs.

A warning of Python about the code of this repository is an error there, in every process: a module
that each interpreter imports at its start enables this.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import onnx
from onnx.parser import parse_model
from peer_environment import environment
from resolved import direct

from vlagents_ray.serve.python_env.create import install

ROOT = Path(__file__).parents[2]
SCRIPT = Path(__file__).with_name("version_check.py")
RUN_S = 300
DIM = 3  # number of values in an action of the model
_MODEL = """<ir_version: 8, opset_import: ["": 17]>
    reach (float[batch, 4] state) => (float[batch, 3] action) {
        weights = Constant <value = float[4, 3] {1, 0, 0, 0, 1, 0, 0, 0, 1, 1, 1, 1}> ()
        action = MatMul(state, weights)
    }"""
_AGENTS = """import ray._private.runtime_env.agent.main
from ray.dashboard.utils import DashboardAgentModule, get_all_modules

get_all_modules(DashboardAgentModule)
"""
_WARNINGS = """import warnings

for category in (DeprecationWarning, PendingDeprecationWarning, SyntaxWarning):
    warnings.filterwarnings("error", category=category, module="vlagents_ray")
"""


def check(python: str, folder: Path, ray: str | None = None) -> dict[str, Any]:
    """Run `version_check.py` in an environment, and return its output.

    Args:
        python: The minor version of Python, such as "3.12".
        folder: A folder for its files.
        ray: The version of Ray, such as "2.56.1"; None for the newest allowed version. If a version
            is given, the environment also has the packages of rollouts.
    """
    extras = ("serve", "onnx") if ray is None else ("serve", "onnx", "rollouts")
    plugins = (
        ["vlagents_ray_models"] if ray is None else ["vlagents_ray_models", "vlagents_ray_learn"]
    )
    packages = {text for extra in extras for text in direct(extra) if "vlagents" not in text}
    if ray is not None:
        packages = {text for text in packages if not text.startswith("ray[")}
        packages.add(f"ray[serve]=={ray}")
    name = f"python{python}" if ray is None else f"ray{ray}"
    interpreter = environment(name, sorted(packages), python)
    for source in (ROOT, *(ROOT / "plugins" / plugin for plugin in plugins)):
        install(interpreter, ["--no-deps", "--editable", str(source)])
    # Ray waits at most 15 s for its agents, which is too short if their modules have never been
    # compiled.
    subprocess.run([str(interpreter), "-c", _AGENTS], check=True, capture_output=True)

    onnx.save(parse_model(_MODEL), str(folder / "model.onnx"))
    (folder / "sitecustomize.py").write_text(_WARNINGS)
    done = subprocess.run(
        [str(interpreter), str(SCRIPT), str(folder)],
        env=os.environ | {"PYTHONPATH": str(folder)},
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=RUN_S,
    )
    assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-6000:]}"
    printed: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return printed


def require_everything(printed: dict[str, Any], *, rollouts: bool) -> None:
    """Check that all transports in the output of `version_check.py` returned equal actions, and
    that there are results.
    """
    for actions in printed["actions"].values():
        assert sorted(actions) == ["handle", "http", "plasma", "shm", "websocket"]
        [first, *others] = actions.values()
        assert all(action == first for action in others), actions
    # The state (0, 1, 2, 3) times the weights.
    assert printed["actions"]["onnx"]["http"] == [3.0, 4.0, 5.0]
    assert printed["evaluated"] == 2
    assert (printed["collected"] > 0) == rollouts
    assert printed["package"] == str(ROOT / "vlagents_ray")
