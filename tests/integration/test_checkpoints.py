"""The swap of a deployment's checkpoint without new replicas, and evaluations over several
checkpoints, on real servers.
"""

from __future__ import annotations

import itertools
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import wait_for
from in_process_evaluation import flat_config
from shared_ray import shared_server

from tests.integration.conftest import deploy, states
from tests.integration.test_sessions import TRANSPORTS, url
from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.errors import ConfigError, PolicyUnavailable
from vlagents_ray.evaluate import Results, evaluate
from vlagents_ray.evaluate.results.summary import reported
from vlagents_ray.policies.base.checkpoint_files import digest
from vlagents_ray.serve.launch.checkpoint_swaps import ServedCheckpoints
from vlagents_ray.serve.launch.deployment_file import Deployment, deployment
from vlagents_ray.serve.launch.server import Server

POLICY = "served_agents:Stored"
LOAD_S = 60.0  # time for a replica to start, and to load a checkpoint


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the checkpoints 1 to 9, each a file that contains its number."""
    folder = tmp_path_factory.mktemp("runs")
    for number in range(1, 10):
        (folder / f"{number}").write_text(str(number))
    return folder


def deployed(folder: Path, **beside: Any) -> Deployment:
    """Return the deployment. `beside` are the settings next to `args`, which can change while it
    runs.
    """
    config = {"checkpoint": str(folder / "{step}"), "checkpoint_step": 1}
    document = deployment(POLICY, config=config).model_dump(exclude_unset=True)
    document["applications"][0]["deployments"] = [{"name": "Policy", **beside}]
    return Deployment(**document)


@pytest.fixture(scope="module")
def server(shared_ray: None, folder: Path) -> Iterator[Server]:
    """Serve deploys the file, since it has `deployments`. Only then can it change without new
    replicas.
    """
    with shared_server(deployed(folder, num_replicas=1)) as server:
        yield server


def redeploy(folder: Path, replicas: int = 1, **user_config: Any) -> None:
    """Deploy the changed file, like `serve deploy`."""
    deploy(deployed(folder, num_replicas=replicas, user_config=user_config))


def status() -> Any:
    from ray import serve

    return serve.status().applications["Stored"]


def is_running(replicas: int = 1) -> bool:
    return str(status().status.value) == "RUNNING" and states("Stored") == {"RUNNING": replicas}


def metadata(server: Server) -> dict[str, Any]:
    with RemoteAgent(server.url, transport="http") as agent:
        return agent.metadata


@pytest.fixture
def fresh(server: Server, folder: Path) -> Server:
    """Restore the deployment's initial settings after the previous test."""
    for marker in folder.glob("*.*"):
        marker.unlink()
    redeploy(folder)
    wait_for(is_running, LOAD_S)
    assert metadata(server)["checkpoint"] == str(folder / "1")
    return server


class Robot:
    """A robot that runs episodes in a thread, and stores for each act (whether the episode was
    begun again, number of the checkpoint, step).
    """

    def __init__(self, agent: RemoteAgent, episode: int = 20) -> None:
        self.rows: list[tuple[bool, float, int]] = []
        self.failure: BaseException | None = None
        self._agent, self._episode = agent, episode
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                try:
                    self._agent.reset(Obs(), "x")
                except PolicyUnavailable:  # the replica loads
                    time.sleep(0.1)
                    continue
                for number in range(self._episode):
                    act = self._agent.act(Obs())
                    begins = number == 0 or bool(act.info.get("resumed"))
                    self.rows.append((begins, float(act.action[0]), act.info["step"]))
        except BaseException as failure:  # noqa: BLE001 - `end` raises it
            self.failure = failure

    def end(self) -> list[tuple[bool, float, int]]:
        """Stop after the current episode, and raise the error that occurred, if any."""
        self._stop.set()
        self._thread.join(60)
        self._agent.close()
        if self.failure is not None:
            raise self.failure
        return self.rows


def _pid(server: Server) -> int:
    with RemoteAgent(server.url) as agent:
        return int(agent.reset(Obs(), "x")["pid"])


def test_a_redeploy_swaps_in_place_and_robots_begin_their_episodes_again(
    fresh: Server, folder: Path
) -> None:
    """The session of an episode ends with the old checkpoint. The client begins the episode again,
    so that no part of an episode mixes two checkpoints.
    """
    robots = [
        Robot(RemoteAgent(url(fresh, t).replace("Reacher", "Stored"), transport=t))
        for t in TRANSPORTS
    ]
    pid = _pid(fresh)
    wait_for(lambda: all(len(robot.rows) > 50 for robot in robots))
    (folder / "2.held").touch()
    redeploy(folder, checkpoint_step=2)
    wait_for((folder / "2.begun").exists)
    assert (folder / "1.closed").exists(), "the old checkpoint is closed first"
    assert str(status().status.value) == "DEPLOYING"
    (folder / "2.held").unlink()
    wait_for(
        lambda: all(r.failure is not None or (r.rows and r.rows[-1][1] == 2) for r in robots),
        LOAD_S,
    )
    wait_for(is_running, LOAD_S)
    for robot in robots:
        rows = robot.end()
        assert {number for _, number, _ in rows} == {1.0, 2.0}
        for before, after in itertools.pairwise(rows):
            begins, number, step = after
            # A resumed episode first repeats its earlier observations.
            assert begins or (number, step) == (before[1], before[2] + 1)
    assert _pid(fresh) == pid


def test_a_redeploy_of_what_does_not_load_fails_with_the_cause(fresh: Server, folder: Path) -> None:
    swaps = ServedCheckpoints(fresh, {"mine": "Stored"})
    swaps.begin("mine", 77)

    def fails() -> bool:
        try:
            assert not swaps.is_done("mine")
        except ConfigError as error:
            return "checkpoint_step 77: " in str(error) and "FileNotFoundError" in str(error)
        return False

    wait_for(fails, LOAD_S)
    wait_for(lambda: str(status().status.value) == "DEPLOY_FAILED", LOAD_S)
    swaps.begin("mine", 3)
    wait_for(lambda: swaps.is_done("mine"), LOAD_S)
    assert metadata(fresh)["checkpoint"] == str(folder / "3")


def test_every_replica_swaps_and_new_ones_begin_with_what_was_swapped_to(
    fresh: Server, folder: Path
) -> None:
    # Any setting of the policy can be swapped.
    redeploy(folder, replicas=2, checkpoint_step=4, scale=10.0)

    def numbers() -> dict[int, set[float]]:
        """Return the numbers of the checkpoints that each replica's sessions use."""
        found: dict[int, set[float]] = {}
        for _ in range(8):
            with RemoteAgent("serve://Stored", transport="handle") as agent:
                pid = agent.reset(Obs(), "x")["pid"]
                found.setdefault(pid, set()).add(float(agent.act(Obs()).action[0]))
        return found

    wait_for(lambda: is_running(2), LOAD_S)
    wait_for(lambda: list(numbers().values()) == [{40.0}] * 2)
    redeploy(folder, replicas=2, checkpoint_step=5)
    wait_for(lambda: is_running(2), LOAD_S)
    assert list(numbers().values()) == [{5.0}] * 2


def test_the_other_replicas_keep_the_old_checkpoint_if_the_next_one_does_not_load(
    fresh: Server, folder: Path
) -> None:
    redeploy(folder, replicas=2)
    wait_for(lambda: is_running(2), LOAD_S)
    redeploy(folder, replicas=2, checkpoint_step=77)
    wait_for(lambda: str(status().status.value) == "DEPLOY_FAILED", LOAD_S)
    with RemoteAgent(fresh.url, transport="http") as agent:
        assert agent.reset(Obs(), "x")["checkpoint"] == str(folder / "1")
        assert agent.act(Obs()).action[0] == 1


SWEEP = {"envs": ["eval_fakes:Line"], "episodes": 3, "video": "none", "steps": [3, 4, 2]}


def outcomes(results: Results) -> dict[str, list[tuple[str | None, str | None]]]:
    """Return the checkpoint and the digest of the actions of each episode, by policy and step."""
    outcomes: dict[str, list[tuple[str | None, str | None]]] = {}
    for case in results.cases:
        episodes = [episode.result for episode in case.episodes]
        outcomes[case.policy_id] = [(one.checkpoint, one.actions_sha256) for one in episodes]
    return outcomes


def test_a_sweep_evaluates_each_checkpoint_on_one_server(
    fresh: Server, folder: Path, tmp_path: Path
) -> None:
    config = flat_config(
        **SWEEP,
        policy_url="serve://Stored",
        checkpoint=str(folder / "{step}"),
        workers=1,
        out=tmp_path / "results",
    )
    with pytest.raises(ConfigError, match="expected no `steps` with the `url` of a running server"):
        evaluate(config)

    pid = _pid(fresh)
    summary = evaluate(config, swaps=ServedCheckpoints(fresh, {"policy": "Stored"}))
    assert [(group.policy_id, group.episodes) for group in summary.totals] == [
        ("policy@2", 3),
        ("policy@3", 3),
        ("policy@4", 3),
    ]
    assert [reported(case, "checkpoint") for case in summary.results.cases] == [
        str(folder / step) for step in "342"
    ]
    assert [reported(case, "weights") for case in summary.results.cases] == [
        digest([folder / step]) for step in "342"
    ]
    assert _pid(fresh) == pid


def test_a_replica_that_is_killed_during_a_swap_loads_the_next_checkpoint(
    fresh: Server, folder: Path, tmp_path: Path
) -> None:
    """Serve's controller starts another replica with the new settings. The evaluation waits, and
    has the same results.
    """
    config = flat_config(
        **SWEEP,
        policy_url="serve://Stored",
        checkpoint=str(folder / "{step}"),
        workers=1,
        out=tmp_path / "undisturbed",
    )
    swaps = ServedCheckpoints(fresh, {"policy": "Stored"})
    undisturbed = evaluate(config, swaps=swaps)

    pid = _pid(fresh)
    (folder / "4.begun").unlink()
    (folder / "4.held").touch()

    def kill() -> None:
        wait_for((folder / "4.begun").exists, LOAD_S)
        os.kill(pid, signal.SIGKILL)
        (folder / "4.held").unlink()

    killer = threading.Thread(target=kill)
    killer.start()
    killed = evaluate(config.model_copy(update={"out": tmp_path / "killed"}), swaps=swaps)
    killer.join()
    assert _pid(fresh) != pid
    assert outcomes(killed.results) == outcomes(undisturbed.results)
    assert killed.total.episodes == 9


def test_a_sweep_ends_with_the_cause_if_a_checkpoint_does_not_load(
    fresh: Server, folder: Path, tmp_path: Path
) -> None:
    config = flat_config(
        **SWEEP | {"steps": [1, 77, 2]},
        policy_url="serve://Stored",
        checkpoint=str(folder / "{step}"),
        workers=1,
        out=tmp_path / "results",
    )
    with pytest.raises(ConfigError, match=r"checkpoint_step 77: .*FileNotFoundError"):
        evaluate(config, swaps=ServedCheckpoints(fresh, {"policy": "Stored"}))
    episodes = Results.load(tmp_path / "results").episodes
    assert {episode.result.checkpoint for episode in episodes} == {str(folder / "1")}
