"""More workers on several nodes run more episodes, and several drivers share a cluster."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
from eval_fakes import PYTHONPATH

from benchmarks.environments import SLEEPING_ENV
from benchmarks.hosts import hosts, ray_cluster
from benchmarks.line_process import LineProcess, our_environment
from benchmarks.scaling import IMAGE_BYTES, OWN, ScalingPlan, driving, measure_cluster
from benchmarks.scaling_driver import Fleet, PlayedEpisodes, ScalingRound
from vlagents_ray.evaluate import Results

pytestmark = pytest.mark.hosts

DRIVER = """
import sys
from pathlib import Path
import ray
from eval_fakes import wait_for
from vlagents_ray.evaluate import EvalConfig, PolicyConfig, SuiteConfig, evaluate
env, seed, out = sys.argv[1:]
ray.init(logging_level="WARNING", log_to_driver=False)
Path(out + ".here").touch()
wait_for(lambda: len(list(Path(out).parent.glob("*.here"))) == 2)
options = {"max_steps": 200, "step_ms": 10.0, "size": 32}  # so that neither is over before the other has begun
evaluate(EvalConfig(
    policies=[PolicyConfig(name="noop", url="serve://own")], workers=2, video="none", out=out,
    suites=[SuiteConfig(envs=[env], episodes=6, seeds=[int(seed)], env_options=options)],
))
"""


@pytest.mark.alone
def test_four_workers_on_two_nodes_play_nearly_four_times_as_much_as_one() -> None:
    """A common bottleneck would halve the rate. The bound leaves room for other work of the
    machine.
    """
    plan = ScalingPlan(workers=(1, 4), rounds=1, steps=20, seconds=3.0)
    with driving(plan, nodes=2) as (driver, size, made):
        assert size == 2
        for _ in range(3):  # a pause of the machine for a second would spoil a round
            rows = {
                (row["app"], row["workers"]): row
                for row in measure_cluster(plan, size, driver, made=made)["rows"]
            }
            if rows[OWN, 4]["of_linear"] > 0.6:
                break
        # These episodes are over before the last worker is ready, as in rounds that measure the
        # driver's costs.
        short = PlayedEpisodes(
            **driver.request(
                json.dumps(asdict(ScalingRound(4, episodes=2, steps=1, step_ms=1.0, size=32))),
                120.0,
            )
        )
    assert (short.episodes, short.episodes_per_minute) == (7, None), (
        "expected episodes, but no rate, since they end before the last worker is ready"
    )
    own = rows[OWN, 4]
    assert own["of_linear"] > 0.6
    assert own["of_ideal"] <= 1.01
    assert own["failures"] == 0
    assert own["transports"] == ["shm"], "the replica of each worker must be on the worker's node"
    assert own["near"] == 1
    assert own["sent_bytes_per_act"] < IMAGE_BYTES / 10, "no image must leave its host"


def test_two_drivers_on_one_cluster_play_a_part_each_and_their_results_are_merged(
    tmp_path: Path,
) -> None:
    settings = {"address": None, "policy_ms": 5.0, "fleets": {"own": asdict(Fleet(2))}}
    with hosts(2) as both, ray_cluster(both, 4, {"PYTHONPATH": PYTHONPATH}) as cluster:
        serving = [sys.executable, "-m", "benchmarks.scaling_driver"]
        settings["address"] = cluster.address
        with LineProcess(
            "server", cluster.head.command([*serving, json.dumps(settings)]), our_environment()
        ) as server:
            server.read(300)
            parts = [tmp_path / seed for seed in ("0", "6")]
            drivers = [
                host.start([sys.executable, "-c", DRIVER, SLEEPING_ENV, part.name, str(part)])
                for host, part in zip(both, parts, strict=True)
            ]
            assert [driver.wait(300) for driver in drivers] == [0, 0]
    merge = [sys.executable, "-c", "from vlagents_ray.cli import main; main()", "merge"]
    done = subprocess.run(
        [*merge, *map(str, parts), "--out", str(tmp_path / "all")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    merged = Results.load(tmp_path / "all")
    assert [sorted(one.result.key.seed for one in case.episodes) for case in merged.cases] == [
        list(range(12))
    ]
    assert [one.result.status for one in merged.cases[0].episodes] == ["done"] * 12
    first, second = sorted(merged.runs, key=lambda run: run.started)
    assert second.started < (first.ended or 0), "both drivers must run at the same time"
