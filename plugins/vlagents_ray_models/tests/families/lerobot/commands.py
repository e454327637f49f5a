"""Servers for LeRobot's own commands, and how these are run as users type them, with the plug-in
of plugins/.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import mirror_policy
from asgi_server import served
from in_memory_keys import ChangingKeys

from vlagents_ray import Agent
from vlagents_ray.abilities import HasStatistics, ability
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine

ROOT = Path(__file__).parents[5]
PLUGIN = ROOT / "plugins/lerobot_policy_vlagents"
BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"


@dataclass(frozen=True)
class Server:
    url: str
    key: str
    engine: Engine

    def options(self, folder: Path) -> list[str]:
        """The options of a command whose policy is here, with the key in a file in `folder`."""
        file = folder / self.key
        file.write_text(f"{self.key}\n")
        options = [
            "--policy.type=vlagents",
            f"--policy.url={self.url}",
            f"--policy.key_file={file}",
        ]
        return [*options, "--policy.state=[joints, gripper]"]


@contextlib.contextmanager
def serving(policy: Agent) -> Iterator[Server]:
    """A server of a policy, with a key."""
    engine = Engine(policy)
    engine.start()
    known = ChangingKeys()
    key = known.add("robot")
    metadata = {"contract": policy.contract.to_json() if policy.contract else None, "version": "0"}
    metadata |= {"policy": type(policy).__name__, "protocol": PROTOCOL_VERSION}
    trained_on = ability(policy, HasStatistics)
    if trained_on is not None:
        metadata["weights"] = {"statistics": trained_on.statistics}

    def describe() -> dict[str, object]:
        return metadata | {"continues_plans": engine.model.continues_plans}

    with served(
        AccessMiddleware(build_http_app(engine, describe, DEFAULT_LIMITS), known.keys, "app")
    ) as port:
        yield Server(f"http://127.0.0.1:{port}", key, engine)
    engine.close()


def make_site(folder: Path, scratch: Path) -> str:
    """The PYTHONPATH on which LeRobot finds the plug-in, built as pip does, and the robot of
    these tests.
    """
    shutil.copytree(PLUGIN, scratch / "plugin")
    build = [sys.executable, "-c", BUILD, str(folder)]
    subprocess.run(build, cwd=scratch / "plugin", check=True, capture_output=True, timeout=300)
    [wheel] = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    info = folder / "lerobot_robot_mirror-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: lerobot_robot_mirror\nVersion: 1\n"
    )
    (folder / "rerun.py").touch()  # LeRobot's commands import it, to show what they record
    support = Path(mirror_policy.__file__).parent
    return os.pathsep.join(map(str, (folder, support, ROOT)))


def run(commands: Sequence[Sequence[str]], site: str, folder: Path) -> list[tuple[int, str]]:
    """Run commands one after the other in `folder`; the exit status and the output of each."""
    done = subprocess.run(
        [sys.executable, Path(__file__).with_name("entry_points.py")],
        input="".join(f"{json.dumps(command)}\n" for command in commands),
        env=os.environ | {"PYTHONPATH": site, "HF_HOME": str(folder), "HF_HUB_OFFLINE": "1"},
        cwd=folder, capture_output=True, text=True, timeout=500, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    logs = [(folder / f"{number}.log").read_text() for number in range(len(commands))]
    return list(zip(map(int, done.stdout.split()), logs, strict=True))
