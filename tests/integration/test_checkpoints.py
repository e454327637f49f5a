"""Many checkpoints in one deployment, and the swap of its default checkpoint without a restart, on
real servers.
"""

from __future__ import annotations

import threading
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
from vlagents_ray.errors import CheckpointFailed, UnknownCheckpoint
from vlagents_ray.evaluate import evaluate
from vlagents_ray.evaluate.results.summary import reported
from vlagents_ray.policies.base.checkpoint_files import digest
from vlagents_ray.serve.launch.deployment_file import Deployment, deployment
from vlagents_ray.serve.launch.server import Server

POLICY = "served_agents:Stored"


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
    checkpoints = {
        "choices": {"late": {"checkpoint": str(folder / "9")}},
        "steps": True,
        "loaded": 2,
    }
    document = deployment(POLICY, config=config, checkpoints=checkpoints).model_dump(
        exclude_unset=True
    )
    if beside:
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


def metadata(server: Server) -> dict[str, Any]:
    with RemoteAgent(server.url, transport="http") as agent:
        return agent.metadata


def own(server: Server, folder: Path) -> str:
    """Return the deployment's default checkpoint."""
    return str(metadata(server)["checkpoint"]).removeprefix(f"{folder}/")


@pytest.fixture
def fresh(server: Server, folder: Path) -> Server:
    """Restore the deployment's initial settings after the previous test."""
    for marker in folder.glob("*.*"):
        marker.unlink()
    redeploy(folder)
    wait_for(lambda: states("Stored") == {"RUNNING": 1} and own(server, folder) == "1")
    return server


def told(agent: RemoteAgent) -> list[float]:
    """Return the number of the session's checkpoint, and the number of the act."""
    act = agent.act(Obs())
    return [float(act.action[0]), act.info["step"]]


class Robot:
    """A robot that runs episodes in a thread, and stores for each act (checkpoint of the reset,
    number of the checkpoint, step).
    """

    def __init__(self, agent: RemoteAgent, episode: int = 20, **options: Any) -> None:
        self.rows: list[tuple[str, float, int]] = []
        self.resumed = 0
        self.failure: BaseException | None = None
        self._agent, self._episode, self._options = agent, episode, options
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                name = Path(self._agent.reset(Obs(), "x", **self._options)["checkpoint"]).name
                for _ in range(self._episode):
                    act = self._agent.act(Obs())
                    self.resumed += bool(act.info.get("resumed"))
                    self.rows.append((name, float(act.action[0]), act.info["step"]))
        except BaseException as failure:  # noqa: BLE001 - `end` raises it
            self.failure = failure

    def end(self) -> list[tuple[str, float, int]]:
        """Stop after the current episode, and raise the error that occurred, if any."""
        self._stop.set()
        self._thread.join(60)
        self._agent.close()
        if self.failure is not None:
            raise self.failure
        return self.rows


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_sessions_of_two_checkpoints_side_by_side(
    fresh: Server, folder: Path, transport: Any
) -> None:
    where = "serve://Stored" if transport in ("handle", "plasma") else fresh.url
    with (
        RemoteAgent(where, transport=transport) as early,
        RemoteAgent(where, transport=transport) as late,
    ):
        assert early.reset(Obs(), "x")["checkpoint"] == str(folder / "1")
        assert late.reset(Obs(), "x", checkpoint="late", seed=3)["options"] == {"seed": 3}
        for step in range(1, 50):
            assert told(early) == [1, step]
            assert told(late) == [9, step]
        assert early.reset(Obs(), "x", checkpoint_step=9)["checkpoint"] == str(folder / "9")
        assert told(early) == [9, 1]


def test_metadata_says_what_may_be_chosen_and_what_is_loaded(fresh: Server, folder: Path) -> None:
    with RemoteAgent(fresh.url) as agent:
        agent.reset(Obs(), "x", checkpoint="late")
        said = metadata(fresh)["checkpoints"]
    assert (said["choices"], said["steps"], said["limit"]) == ({"late": str(folder / "9")}, True, 2)
    assert str(folder / "9") in said["loaded"]


def test_a_redeploy_swaps_under_load_without_a_failed_step(fresh: Server, folder: Path) -> None:
    """The checkpoint that each reset reported answers all steps of the episode, and no replica
    restarts.
    """
    robots = [
        Robot(RemoteAgent(url(fresh, t).replace("Reacher", "Stored"), transport=t))
        for t in TRANSPORTS
    ]
    pid = _pid(fresh)
    wait_for(lambda: all(len(robot.rows) > 100 for robot in robots))
    (folder / "2.held").touch()
    redeploy(folder, checkpoint_step=2)
    wait_for((folder / "2.begun").exists)
    counts = [len(robot.rows) for robot in robots]
    wait_for(
        lambda: all(len(r.rows) > count + 100 for r, count in zip(robots, counts, strict=True))
    )
    assert metadata(fresh)["checkpoints"]["swap"] == {
        "state": "loading",
        "checkpoint": str(folder / "2"),
    }
    (folder / "2.held").unlink()
    wait_for(
        lambda: all(r.failure is not None or (r.rows and r.rows[-1][0] == "2") for r in robots)
    )
    for robot in robots:
        rows = robot.end()
        assert {row[:2] for row in rows} == {("1", 1.0), ("2", 2.0)}
        assert [row[2] for row in rows] == [i % 20 + 1 for i in range(len(rows))]
        assert robot.resumed == 0
    wait_for((folder / "1.closed").exists)
    assert _pid(fresh) == pid


def _pid(server: Server) -> int:
    with RemoteAgent(server.url) as agent:
        return int(agent.reset(Obs(), "x")["pid"])


def test_a_redeploy_of_what_does_not_load_leaves_the_old_one_and_says_why(
    fresh: Server, folder: Path
) -> None:
    robot = Robot(RemoteAgent(fresh.url))
    wait_for(lambda: len(robot.rows) > 50)
    redeploy(folder, checkpoint_step=77)
    wait_for(lambda: (metadata(fresh)["checkpoints"]["swap"] or {}).get("state") == "failed")
    assert "FileNotFoundError" in metadata(fresh)["checkpoints"]["swap"]["error"]
    redeploy(folder, checkpoint_step=1, scales=3)  # an unknown setting
    wait_for(
        lambda: "ConfigError" in (metadata(fresh)["checkpoints"]["swap"] or {}).get("error", "")
    )
    count = len(robot.rows)
    wait_for(lambda: len(robot.rows) > count + 50)
    assert {row[:2] for row in robot.end()} == {("1", 1.0)}


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

    wait_for(lambda: len(numbers()) == 2)
    wait_for(lambda: list(numbers().values()) == [{40.0}] * 2)
    redeploy(folder, replicas=2, checkpoint_step=5)
    wait_for(lambda: list(numbers().values()) == [{5.0}] * 2)


def test_an_evaluation_says_by_which_checkpoint(
    fresh: Server, folder: Path, tmp_path: Path
) -> None:
    settings = {
        "envs": ["eval_fakes:Line"],
        "policy_url": fresh.url,
        "episodes": 2,
        "video": "none",
    }
    summary = evaluate(
        flat_config(**settings, policy_options={"checkpoint_step": 3}, out=tmp_path / "results")
    )
    assert [reported(case, "checkpoint") for case in summary.results.cases] == [str(folder / "3")]
    assert [reported(case, "weights") for case in summary.results.cases] == [digest([folder / "3"])]
    assert digest([folder / "3"]) in (tmp_path / "results" / "report.html").read_text()
    assert metadata(fresh)["weights"] == {"digest": digest([folder / "1"]), "revision": None}
    assert (summary.total.episodes, summary.total.policy_errors) == (2, 0)
    for option, error in (
        ({"checkpoint_step": 77}, CheckpointFailed),
        ({"checkpoint": "lat"}, UnknownCheckpoint),
    ):
        out = tmp_path / error.__name__
        # The error stops the evaluation; it is not counted as a lost episode or as a failure of the
        # policy.
        with pytest.raises(error):
            evaluate(flat_config(**settings, policy_options=option, out=out))


def test_a_sweep_evaluates_each_checkpoint_on_one_server(
    fresh: Server, folder: Path, tmp_path: Path
) -> None:
    settings = {
        "envs": ["eval_fakes:Line"],
        "policy_url": fresh.url,
        "episodes": 3,
        "video": "none",
        "workers": 1,
    }
    summary = evaluate(flat_config(**settings, steps=[3, 4], out=tmp_path / "results"))
    assert [(group.policy_id, group.episodes) for group in summary.totals] == [
        ("policy@3", 3),
        ("policy@4", 3),
    ]
    assert [reported(case, "checkpoint") for case in summary.results.cases] == [
        str(folder / "3"),
        str(folder / "4"),
    ]
