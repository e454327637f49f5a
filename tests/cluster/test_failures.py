"""Failures of a cluster's machines and networks cost time and attempts, but no episode and no
result.
"""

from __future__ import annotations

import contextlib
import functools
import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
import yaml
from eval_fakes import HURRY, LINE, PYTHONPATH, Line, Unhurried, wait_for
from in_process_episode import run_episode
from simulated_hosts import Host, HostFailed, RayCluster, hosts, ray_cluster

from vlagents_ray.client.credentials import KEY_VARIABLE
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import Results
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.results.reader import Attempt
from vlagents_ray.serve.access.key_store import new_key
from vlagents_ray.serve.ports import EVERYWHERE

pytestmark = [pytest.mark.hosts, pytest.mark.slow]

# For conditions that need a process or all results to be checked.
until = functools.partial(wait_for, timeout_s=300, every_s=0.25)
POLICY = "policy"  # a resource of the nodes on which replicas may run
# The program joins the cluster before the command connects to its policy, which is reachable only
# inside.
_SERVED = "import ray; ray.init(log_to_driver=False); from vlagents_ray.cli.main import app; app()"
_OWN = """
import sys, yaml
from eval_fakes import Unhurried
from vlagents_ray.cli.console import out
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.evaluate import EvalConfig, evaluate, progress_for
settings = yaml.safe_load(open(sys.argv[2])) | {"resume": "--resume" in sys.argv}
try:
    evaluate(EvalConfig.model_validate(settings), agent_factory=Unhurried, progress=progress_for(out))
except VLAgentsError as error:
    sys.exit(f"{type(error).__name__}: {error}")
"""


@contextlib.contextmanager
def cluster_of(
    head: Host, nodes: Sequence[tuple[Host, int, bool]], run: Evaluation, **environment: str
) -> Iterator[RayCluster]:
    """Run a head without workers, and nodes with a number of workers and possibly a replica; `run`
    is the evaluation to run there.
    """
    shared = {"PYTHONPATH": PYTHONPATH, "TERM": "dumb", HURRY: str(run.hurry)} | environment
    with ray_cluster([head], cpus=0, environment=shared) as cluster:
        for host, workers, serves in nodes:
            cluster.join(host, workers, resources=json.dumps({POLICY: 1} if serves else {}))
        yield cluster


@contextlib.contextmanager
def serving(head: Host, folder: Path, replicas: int) -> Iterator[str]:
    """Serve `Unhurried` on the cluster, and yield the key of its clients."""
    args = {
        "policy": "eval_fakes:Unhurried",
        "replicas": replicas,
        "resources": {"num_cpus": 0, "custom": {POLICY: 1}},
    }
    application = {
        "name": "line",
        "route_prefix": "/",
        "import_path": "vlagents_ray.serve.app:build",
        "args": args,
    }
    file, keys, log = folder / "serve.yaml", folder / "keys.json", folder / "serve.log"
    file.write_text(yaml.safe_dump({"applications": [application]}))
    keys.unlink(missing_ok=True)
    token = new_key(keys, "all")
    command = [
        "vlagents-ray",
        "serve",
        str(file),
        "--address",
        "auto",
        "--host",
        EVERYWHERE,
        "--keys",
        str(keys),
    ]
    with log.open("w") as output, head.start(command, stdout=output, stderr=output) as server:
        try:
            until(lambda: "serving line" in log.read_text() or server.poll() is not None)
            assert server.poll() is None, log.read_text()
            yield token
        finally:
            server.kill()


class Evaluation:
    """An evaluation on a host; `folder` contains its results and its log.

    With a server of `serving`, its policy is that server's; otherwise each worker has its own
    policy. `episodes` is so large that the evaluation would take much longer than the test; the
    file `hurry` makes the rest fast.
    """

    def __init__(self, folder: Path, episodes: int, workers: int) -> None:
        self.out, self.hurry = folder / "out", folder / "hurry"
        self._log = folder / "eval.log"
        self._file = folder / "eval.yaml"
        policy = {"name": "line", "url": "serve://line", "execute": 1}
        suite = {"envs": [LINE], "episodes": episodes}
        run = {
            "workers": workers,
            "worker": {"cpus": 1},
            "video": "none",
            "out": str(self.out),
            "place_timeout_s": 60,
        }
        self._file.write_text(yaml.safe_dump({"policies": [policy], "suites": [suite], **run}))
        self._process: subprocess.Popen[str] | None = None

    @contextlib.contextmanager
    def running(self, host: Host, *options: str, token: str | None = None) -> Iterator[None]:
        """Run the evaluation during the context, which begins after its first episode; `token` is
        the key of the server.
        """
        command = [
            "env",
            f"{KEY_VARIABLE}={token}",
            sys.executable,
            "-c",
            _OWN if token is None else _SERVED,
        ]
        command += ["eval", str(self._file), *options]
        before = len(self.played())
        with (
            self._log.open("a") as output,
            host.start(command, stdout=output, stderr=output) as self._process,
        ):
            try:
                self.plays(before + 1)
                yield
            finally:
                self._process.kill()

    def ends(self) -> int:
        """Wait for the end, and return the exit status."""
        assert self._process is not None
        return self._process.wait(300)

    def plays(self, episodes: int) -> None:
        """Wait until `episodes` episodes are recorded."""
        process = self._process
        assert process is not None
        until(lambda: len(self.played()) >= episodes or process.poll() is not None)
        assert process.poll() is None, self.said()

    def goes_on(self, by: int = 12) -> None:
        """Wait for `by` more episodes."""
        self.plays(len(self.played()) + by)

    def played(self) -> list[EpisodeResult]:
        """Return the recorded episodes."""
        try:
            cases = Results.load(self.out).cases
        except ConfigError:  # no results have been written yet
            return []
        return [one.result for case in cases for one in case.episodes]

    def attempts(self) -> list[Attempt]:
        """Return the attempts that failed for infrastructure errors."""
        return [one for case in Results.load(self.out).cases for one in case.attempts]

    def said(self) -> str:
        """Return the whole output."""
        return self._log.read_text()

    def is_whole(self, episodes: int) -> None:
        """Check that each episode exists once, with the same outcome as in a run without
        failures.
        """
        played = self.played()
        assert sorted(one.key.episode for one in played) == list(range(episodes))
        for one in played:
            alone = run_episode(Line(), Unhurried(0.0), one.key, execute=1)
            assert one.outcome == alone.outcome


def workers_on(host: Host) -> int:
    """Return the number of rollout workers on a host."""
    return host.run(["ps", "-eo", "args"]).count("ray::Rollout")


MEMORY = Path("/proc/meminfo")


@contextlib.contextmanager
def cut_off(host: Host, seconds: float) -> Iterator[None]:
    """Cut a host off from the network for at least that time, while the block runs."""
    healed = time.monotonic() + seconds
    host.cut()
    yield
    time.sleep(max(0.0, healed - time.monotonic()))
    host.heal()


@contextlib.contextmanager
def out_of_memory(host: Host, folder: Path) -> Iterator[None]:
    """Simulate a host without free memory for Ray's memory monitor."""
    fake = folder / "meminfo"
    none = re.sub(
        r"(?m)^(MemFree|MemAvailable|Buffers|Cached|SReclaimable):.*",
        r"\1: 0 kB",
        MEMORY.read_text(),
    )
    fake.write_text(none)
    host.run(["mount", "--bind", str(fake), str(MEMORY)])
    yield
    host.run(["umount", str(MEMORY)])


def test_lost_nodes_and_partitions_cost_attempts_alone(tmp_path: Path) -> None:
    """Two nodes have a replica and a worker each, and one node has two workers."""
    episodes = 600
    run = Evaluation(tmp_path, episodes, workers=4)
    with hosts(5) as [head, one, two, simulating, spare]:
        nodes = [(one, 1, True), (two, 1, True), (simulating, 2, False)]
        with (
            cluster_of(head, nodes, run) as cluster,
            serving(head, tmp_path, replicas=2) as token,
            run.running(head, token=token),
        ):
            with cut_off(two, 3.0):
                pass
            run.goes_on()
            assert run.attempts() == [], "a short partition must cost only time"
            with cut_off(two, 20.0):
                run.goes_on()
            run.goes_on()
            simulating.kill()
            until(lambda: "the worker on host4 died" in run.said())
            run.goes_on()
            cluster.join(spare, 2)
            until(lambda: workers_on(spare) == 2)
            two.kill()
            run.goes_on()
            run.hurry.touch()
            assert run.ends() == 0, run.said()
            for host in (head, one, spare):
                until(lambda host=host: workers_on(host) == 0)
    run.is_whole(episodes)


@pytest.mark.alone
def test_a_robot_outside_of_the_cluster_keeps_its_loop_beside_an_evaluation(tmp_path: Path) -> None:
    run = Evaluation(tmp_path, episodes=1000, workers=2)
    with (
        hosts(3) as [head, one, robot],
        cluster_of(head, [(one, 2, True)], run),
        serving(head, tmp_path, replicas=1) as token,
        run.running(head, token=token),
    ):
        robot.limit("1gbit")
        robot.environment |= {KEY_VARIABLE: token}
        loop = ["--hz", "50", "--seconds", "20", "--transport", "websocket", "--safe", "hold"]
        code = "from vlagents_ray.cli import main; main()"
        command = [sys.executable, "-c", code, "robot", f"http://{head.name}:8000", *loop]
        for attempt in (1, 2, 3):  # a pause of the machine for a second can spoil an attempt
            try:
                robot.run(command)  # fails if a tick has no action of the policy
            except HostFailed:
                if attempt == 3:
                    raise
            else:
                break
        assert run.attempts() == []
        run.goes_on()


def test_memory_that_runs_out_costs_attempts_and_a_lost_head_a_resumption(tmp_path: Path) -> None:
    """The driver runs on the remaining node, which then becomes the head of another cluster."""
    episodes = 400
    run = Evaluation(tmp_path, episodes, workers=2)
    with hosts(2) as [head, one]:
        with cluster_of(head, [(one, 2, False)], run, RAY_gcs_rpc_server_reconnect_timeout_s="20"):
            with run.running(one):
                with out_of_memory(one, tmp_path):
                    until(
                        lambda: any("low on memory" in attempt.error for attempt in run.attempts())
                    )
                run.goes_on(by=4)
                head.kill()
                run.goes_on(by=2)
                assert run.ends() == 1
            assert (
                "ClusterLost: the head of the Ray cluster, 198.18.0.1:6379, has not answered"
                in run.said()
            )
            assert json.loads((run.out / "summary.json").read_text())["state"] == "stopped"
            until(lambda: workers_on(one) == 0)
        with ray_cluster([one]), run.running(one, "--resume"):
            run.hurry.touch()
            assert run.ends() == 0, run.said()
    run.is_whole(episodes)
