"""What users of earlier versions kept is read by this one: tests/support/kept_files.py wrote it."""

from __future__ import annotations

import csv
import hashlib
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import kept_files
import numpy as np
import pytest
from in_process_evaluation import play

from vlagents_ray.cli.evaluation.command import read_run
from vlagents_ray.evaluate import EvalConfig, Results, Trajectory
from vlagents_ray.evaluate.bundle import verify
from vlagents_ray.evaluate.exports.tables import to_csv
from vlagents_ray.interface import Act, Obs
from vlagents_ray.open_loop.recorded import Names, RecordedDataset, find_datasets
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.serve.access.key_store import read_keys
from vlagents_ray.serve.launch.deployment_file import read_deployment

VERSIONS = sorted(folder for folder in Path(__file__).parent.iterdir() if (folder / "results").is_dir())
pytestmark = pytest.mark.parametrize("kept", VERSIONS, ids=lambda folder: folder.name)


@pytest.fixture
def results(kept: Path, tmp_path: Path) -> Path:
    """A copy, as a reader may write locks beside them."""
    return Path(shutil.copytree(kept / "results", tmp_path / "results"))


def table(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as lines:
        return list(csv.DictReader(lines))


def test_results_mean_what_they_meant(kept: Path, results: Path, tmp_path: Path) -> None:
    read = Results.load(results)
    to_csv(read, tmp_path / "rows.csv")
    before, now = table(kept / "rows.csv"), table(tmp_path / "rows.csv")
    assert len(now) == len(before) == kept_files.EPISODES
    for old, new in zip(before, now, strict=True):
        assert {name: new[name] for name in old} == old  # there may be further columns
    for row in now:
        trajectory = Trajectory.load(results / row["trajectory"])
        assert np.allclose(trajectory.actions, kept_files.Lifting().act(Obs()).action)


def test_an_evaluation_goes_on_where_the_earlier_version_left_it(results: Path) -> None:
    class Counting(kept_files.Lifting):
        acts = 0

        def act(self, obs: Obs) -> Act:
            Counting.acts += 1
            return super().act(obs)

    found = play(kept_files.settings(results, episodes=kept_files.EPISODES + 1, resume=True), Counting)
    assert sum(len(cell.episodes) for cell in found.cells) == kept_files.EPISODES + 1
    assert Counting.acts == 6  # of the new episode alone


def test_a_bundle_holds_and_its_episodes_play_the_same_again(kept: Path) -> None:
    found = verify(kept / "bundle.zip", replay=1)
    assert found.holds, found.findings


def test_files_are_accepted(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(kept_files.ROOT)

    def build(_: object, policy: str, config: dict[str, Any], wrappers: Sequence[Any]) -> None:
        build_agent(policy, config, wrappers=wrappers)  # here, as none of the environments that they name is

    monkeypatch.setattr("vlagents_ray.serve.launch.deployment_file.check_policy", build)
    deployments, evaluations = (sorted((kept / name).glob("*.yaml")) for name in ("deployments", "evaluations"))
    assert deployments
    assert evaluations
    for file in deployments:
        read_deployment(str(file))
    for file in evaluations:
        EvalConfig.model_validate(read_run(file))


def test_keys_allow_what_they_allowed(kept: Path) -> None:
    robot, learner = read_keys(kept / "keys.json")
    assert (robot.name, robot.apps, robot.rate, robot.expires, robot.scopes) == ("robot-1", ("pi0",), 50.0, 4e9, ())
    assert (learner.name, learner.rank, learner.scopes) == ("learner", "simulation", ("weights", "watch"))
    assert [key.revoked for key in (robot, learner)] == [False, False]


def test_a_recorded_session_is_played(kept: Path) -> None:
    [folder] = find_datasets(kept / "session")
    dataset = RecordedDataset(folder)
    [session] = dataset.plays()
    steps = [step for part in session.parts for step in dataset.steps(part, Names(), None)]
    assert [float(step.obs.state["joints"][0]) for step in steps] == [0, 1, 2]


def test_clients_of_that_version_send_and_get_the_same_bytes(kept: Path) -> None:
    """`clients/golden` is what they are tested with: tests/protocol holds the codec of this version to it."""
    for name, digest in json.loads((kept / "golden.json").read_text()).items():
        assert hashlib.sha256((kept_files.ROOT / name).read_bytes()).hexdigest() == digest, name
