"""LeRobot's own commands, as users type them, with the plug-in of plugins/ and a policy on a server."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mirror_policy
import numpy as np
import pytest
from asgi_server import served
from mirror_policy import CAMERA, CONTRACT, ROWS, MirrorPolicy, mirrored

from vlagents_ray.open_loop.recorded import Names, RecordedDataset
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine

ROOT = Path(__file__).parents[3]
PLUGIN = ROOT / "plugins/lerobot_policy_vlagents"
TASK = "lift the cup"
BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
METADATA = {"policy": "mirror", "contract": CONTRACT.to_json(), "version": "0", "protocol": PROTOCOL_VERSION}


@dataclass(frozen=True)
class Server:
    url: str
    policy: MirrorPolicy


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    policy = MirrorPolicy()
    policy.initialize()
    engine = Engine(policy)
    engine.start()
    with served(build_http_app(engine, lambda: METADATA, DEFAULT_LIMITS)) as port:
        yield Server(f"http://127.0.0.1:{port}", policy)
    engine.close()


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The PYTHONPATH on which LeRobot finds the plug-in, built as pip does, and the robot of these tests."""
    site, source = tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("source") / "plugin"
    shutil.copytree(PLUGIN, source)
    subprocess.run([sys.executable, "-c", BUILD, str(site)], cwd=source, check=True, capture_output=True, timeout=300)
    [wheel] = site.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    info = site / "lerobot_robot_mirror-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot_robot_mirror\nVersion: 1\n")
    support = Path(mirror_policy.__file__).parent
    return os.pathsep.join(map(str, (site, support, ROOT)))


def lerobot(command: str, installed: str, folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """A command of LeRobot's, in the environment of these tests."""
    return subprocess.run(
        [Path(sys.executable).with_name(command), *options],
        env=os.environ | {"PYTHONPATH": installed, "HF_HOME": str(folder), "HF_HUB_OFFLINE": "1", "SVT_LOG": "0"},
        cwd=folder, capture_output=True, text=True, timeout=500, check=False,
    )  # fmt: skip


def test_lerobot_record_records_the_actions_of_the_servers_policy(
    server: Server, installed: str, tmp_path: Path
) -> None:
    done = lerobot(
        "lerobot-record", installed, tmp_path,
        "--robot.type=mirror",
        "--policy.type=vlagents", f"--policy.url={server.url}", "--policy.state=[joints, gripper]", "--policy.seed=7",
        "--dataset.repo_id=me/eval_mirror", f"--dataset.root={tmp_path / 'recorded'}", f"--dataset.single_task={TASK}",
        "--dataset.fps=20", "--dataset.num_episodes=2", "--dataset.episode_time_s=0.5", "--dataset.reset_time_s=0",
        "--dataset.video=false", "--dataset.push_to_hub=false", "--play_sounds=false",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert server.policy.begun == [(TASK, 7), (TASK, 8)]
    dataset = RecordedDataset(tmp_path / "recorded")
    plays = dataset.plays()
    assert len(plays) == 2
    for play in plays:
        chunk = np.zeros((0, 3), np.float32)
        for step in dataset.steps(play.parts[0], Names(state=["joints", "gripper"]), CONTRACT):
            if step.frame % ROWS == 0:
                state = np.array([*step.obs.state["joints"], step.obs.gripper], np.float32)
                pixel = int(step.obs.cameras[CAMERA][0, 0, 0])
                chunk = mirrored(state, pixel, step.frame // ROWS + 1, TASK)
            np.testing.assert_array_equal(step.expected[0], chunk[step.frame % ROWS])


def test_lerobot_eval_gives_each_environment_a_session_of_its_own(
    server: Server, installed: str, tmp_path: Path
) -> None:
    from lerobot_env_mirror import INSTRUCTION, STEPS

    server.policy.begun.clear()
    done = lerobot(
        "lerobot-eval", installed, tmp_path,
        "--env.discover_packages_path=lerobot_env_mirror", "--env.type=mirror",
        "--policy.type=vlagents", f"--policy.url={server.url}", "--policy.state=[joints, gripper]",
        f"--policy.instruction={INSTRUCTION}", "--policy.rank=simulation",
        "--eval.batch_size=2", "--eval.n_episodes=4", f"--output_dir={tmp_path / 'evaluated'}",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert server.policy.begun == [(INSTRUCTION, None)] * 4
    [task] = json.loads((tmp_path / "evaluated/eval_info.json").read_text())["per_task"]
    assert task["metrics"]["sum_rewards"] == [STEPS] * 4


def test_what_does_not_fit_is_refused_by_the_command(server: Server, installed: str, tmp_path: Path) -> None:
    done = lerobot(
        "lerobot-record", installed, tmp_path,
        "--robot.type=mirror", "--robot.camera=side",
        "--policy.type=vlagents", f"--policy.url={server.url}", "--policy.state=[joints, gripper]",
        "--dataset.repo_id=me/eval_mirror", f"--dataset.root={tmp_path / 'recorded'}", f"--dataset.single_task={TASK}",
        "--dataset.fps=30", "--dataset.video=false", "--dataset.push_to_hub=false", "--play_sounds=false",
    )  # fmt: skip
    assert done.returncode != 0
    assert "camera 'top': the policy needs it, the env gives ['side']" in done.stderr
    assert "the policy was made for 20 Hz, the env runs at 30.0 Hz" in done.stderr
    assert "--policy.cameras" in done.stderr
