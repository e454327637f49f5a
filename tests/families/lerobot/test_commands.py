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
from itertools import count
from pathlib import Path

import mirror_policy
import numpy as np
import pytest
from asgi_server import served
from in_memory_keys import ChangingKeys
from lerobot_env_mirror import INSTRUCTION, STEPS
from mirror_policy import CONTRACT, ROWS, MirrorPolicy, colour_of, mirrored

from vlagents_ray.open_loop.recorded import Names, RecordedDataset
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
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
    key: str
    policy: MirrorPolicy


@dataclass(frozen=True)
class Ended:
    """A command that ended."""

    status: int
    log: str
    folder: Path  # of all commands


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    policy = MirrorPolicy()
    policy.initialize()
    engine = Engine(policy)
    engine.start()
    known = ChangingKeys()
    key = known.add("robot")
    inside = build_http_app(engine, lambda: METADATA, DEFAULT_LIMITS)
    with served(AccessMiddleware(inside, known.keys, "app")) as port:
        yield Server(f"http://127.0.0.1:{port}", key, policy)
    engine.close()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The PYTHONPATH on which LeRobot finds the plug-in, built as pip does, and the robot of these tests."""
    folder, source = tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("source") / "plugin"
    shutil.copytree(PLUGIN, source)
    subprocess.run([sys.executable, "-c", BUILD, str(folder)], cwd=source, check=True, capture_output=True, timeout=300)
    [wheel] = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    info = folder / "lerobot_robot_mirror-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot_robot_mirror\nVersion: 1\n")
    (folder / "rerun.py").touch()  # LeRobot's commands import it, to show what they record
    support = Path(mirror_policy.__file__).parent
    return os.pathsep.join(map(str, (folder, support, ROOT)))


@pytest.fixture(scope="module")
def ended(server: Server, site: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Ended]:
    """The commands of these tests, after they ended."""
    folder = tmp_path_factory.mktemp("commands")
    (folder / "key").write_text(f"{server.key}\n")
    policy = ["--policy.type=vlagents", f"--policy.url={server.url}", f"--policy.key_file={folder / 'key'}"]
    policy += ["--policy.state=[joints, gripper]"]
    robot = ["lerobot-record", "--robot.type=mirror", *policy, "--dataset.repo_id=me/eval_mirror"]
    robot += [f"--dataset.single_task={TASK}", "--dataset.num_episodes=2", "--dataset.episode_time_s=0.5"]
    robot += ["--dataset.reset_time_s=0", "--dataset.push_to_hub=false", "--dataset.vcodec=h264", "--play_sounds=false"]
    env = ["lerobot-eval", "--env.discover_packages_path=lerobot_env_mirror", "--env.type=mirror", *policy]
    commands = {
        "record": [*robot, "--dataset.fps=20", f"--dataset.root={folder / 'recorded'}", "--policy.seed=7"],
        "refused": [*robot, "--dataset.fps=30", f"--dataset.root={folder / 'refused'}", "--robot.camera=side"],
        "eval": [
            *env, "--eval.batch_size=2", "--eval.n_episodes=4", f"--output_dir={folder / 'evaluated'}",
            f"--policy.instruction={INSTRUCTION}", "--policy.rank=simulation",
        ],
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, Path(__file__).with_name("entry_points.py")],
        input="".join(f"{json.dumps(command)}\n" for command in commands.values()),
        env=os.environ | {"PYTHONPATH": site, "HF_HOME": str(folder), "HF_HUB_OFFLINE": "1"},
        cwd=folder, capture_output=True, text=True, timeout=500, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    logs = [(folder / f"{number}.log").read_text() for number in range(len(commands))]
    found = zip(map(int, done.stdout.split()), logs, strict=True)
    return {name: Ended(*each, folder) for name, each in zip(commands, found, strict=True)}


def test_lerobot_record_records_the_actions_of_the_servers_policy(server: Server, ended: dict[str, Ended]) -> None:
    done = ended["record"]
    assert done.status == 0, done.log
    assert server.policy.begun[:2] == [(TASK, 7), (TASK, 8)]
    dataset = RecordedDataset(done.folder / "recorded")
    plays = dataset.plays()
    assert len(plays) == 2
    images = count(1)
    for play in plays:
        chunk = np.zeros((0, 3), np.float32)
        for step in dataset.steps(play.parts[0], Names(state=["joints", "gripper"]), CONTRACT):
            colour = colour_of(next(images))  # of the robot's image, which the video has only nearly
            if step.frame % ROWS == 0:
                state = np.array([*step.obs.state["joints"], step.obs.gripper], np.float32)
                chunk = mirrored(state, colour, step.frame // ROWS + 1, TASK)
            np.testing.assert_array_equal(step.expected[0], chunk[step.frame % ROWS])


def test_lerobot_eval_gives_each_environment_a_session_of_its_own(server: Server, ended: dict[str, Ended]) -> None:
    done = ended["eval"]
    assert done.status == 0, done.log
    assert server.policy.begun[2:] == [(INSTRUCTION, None)] * 4
    [task] = json.loads((done.folder / "evaluated/eval_info.json").read_text())["per_task"]
    assert task["metrics"]["sum_rewards"] == [STEPS] * 4  # the environment rewards the actions of its own session


def test_a_command_refuses_what_does_not_fit_before_it_moves(ended: dict[str, Ended]) -> None:
    done = ended["refused"]
    assert done.status == 1
    assert "camera 'top': the policy needs it, the env gives ['side']" in done.log
    assert "the policy was made for 20 Hz, the env runs at 30.0 Hz" in done.log
    assert "--policy.cameras" in done.log
