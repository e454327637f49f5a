"""Several drivers share a cluster, and their results are merged."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from eval_fakes import PYTHONPATH
from simulated_hosts import hosts, ray_cluster

from vlagents_ray.evaluate import Results

pytestmark = pytest.mark.hosts

SERVER = """
import sys
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server
served = deployment("noop", config={"action_dim": 4, "base_ms": 5}, replicas=2)
served.applications[0].name = "own"
with running_server(served, address="auto"):
    print("ready", flush=True)
    sys.stdin.read()
"""
DRIVER = """
import sys
from pathlib import Path
import ray
from eval_fakes import wait_for
from vlagents_ray.evaluate import EvalConfig, PolicyConfig, SuiteConfig, evaluate
seed, out = sys.argv[1:]
ray.init(logging_level="WARNING", log_to_driver=False)
Path(out + ".here").touch()
wait_for(lambda: len(list(Path(out).parent.glob("*.here"))) == 2)
options = {"max_steps": 200, "step_ms": 10.0}  # so that neither is over before the other has begun
evaluate(EvalConfig(
    policies=[PolicyConfig(name="noop", url="serve://own")], workers=2, video="none", out=out,
    suites=[SuiteConfig(envs=["sleeping_env:SleepingEnv"], episodes=6, seeds=[int(seed)], env_options=options)],
))
"""


def test_two_drivers_on_one_cluster_play_a_part_each_and_their_results_are_merged(
    tmp_path: Path,
) -> None:
    parts = [tmp_path / seed for seed in ("0", "6")]
    with hosts(2) as both, ray_cluster(both, 4, {"PYTHONPATH": PYTHONPATH}) as cluster:
        serve = [sys.executable, "-c", SERVER]
        with cluster.head.start(serve, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as server:
            assert server.stdin is not None
            assert server.stdout is not None
            assert server.stdout.readline() == "ready\n"
            drivers = [
                host.start([sys.executable, "-c", DRIVER, part.name, str(part)])
                for host, part in zip(both, parts, strict=True)
            ]
            assert [driver.wait(300) for driver in drivers] == [0, 0]
            server.stdin.close()
            server.wait(180)
    merge = [sys.executable, "-c", "from vlagents_ray.cli import main; main()", "merge"]
    done = subprocess.run(
        [*merge, *map(str, parts), "--out", str(tmp_path / "all")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    merged = Results.load(tmp_path / "all")
    [case] = merged.cases
    assert sorted(one.result.key.seed for one in case.episodes) == list(range(12))
    assert [one.result.status for one in case.episodes] == ["done"] * 12
    first, second = sorted(merged.runs, key=lambda run: run.started)
    assert second.started < (first.ended or 0), "both drivers must run at the same time"
