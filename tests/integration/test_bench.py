"""Very small runs of `python -m benchmarks.NAME`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from peer_environment import peers_python

from benchmarks.own_clients import own_clients

ROOT = Path(__file__).parents[2]


def bench(ray_home: Path, name: str, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}", *words],
        cwd=ROOT, capture_output=True, text=True, timeout=180, check=False,
        env=os.environ | {"RAY_TMPDIR": str(ray_home), "COLUMNS": "200"},
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.alone
def test_every_way_is_measured_and_shared_memory_is_the_fastest_to_a_local_process(
    ray_home: Path, tmp_path: Path
) -> None:
    file = tmp_path / "rtt.json"
    done = bench(ray_home, "rtt", "--peers", "", "--calls", "50", "--out", str(file))
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(file.read_text())
    medians = {way["way"]: way["median_ms"] for way in found["ways"]}
    assert set(medians) == {way.name for way in own_clients()}
    assert all(way["calls"] == 50 for way in found["ways"])
    local = {name: ms for name, ms in medians.items() if "actor" not in name}
    assert min(local, key=lambda name: local[name]) == "shm"
    lost = {way["way"]: way["psnr_db"] for way in found["ways"]}
    assert lost["shm"] is None
    assert lost["websocket, jpeg"] > 30


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.alone
def test_throughput_comes_near_the_bare_policy_and_never_above_it(
    ray_home: Path, tmp_path: Path
) -> None:
    """Named by its class, `noop` is a policy of unknown speed, whose speed is measured without a
    server. It sleeps, so that the load of two cores does not matter.
    """
    file = tmp_path / "throughput.json"
    policy = [
        "--policy",
        "vlagents_ray.policies.noop:Noop",
        "--set",
        "base_ms=40",
        "--set",
        "per_item_ms=5",
    ]
    few = [
        "--clients",
        "8",
        "--batch",
        "4",
        "--seconds",
        "0.6",
        "--rounds",
        "1",
        "--robot-seconds",
        "0.6",
    ]
    ratios = []
    for _ in range(3):  # a pause of the machine for a second would spoil a measurement of 0.6 s
        done = bench(
            ray_home, "throughput", *policy, *few, "--transports", "shm,handle", "--out", str(file)
        )
        assert done.returncode == 0, done.stdout + done.stderr
        found = json.loads(file.read_text())
        assert found["ideal_actions_per_s"] == found["bare_rounds"][0]
        ratios.append(
            (
                found["bare_rounds"][0] * 0.060 / 4,
                *(r["of_ideal"] for r in found["transports"].values()),
            )
        )
        if 0.6 < ratios[-1][0] <= 1.0 and all(0.3 < of_ideal <= 1.1 for of_ideal in ratios[-1][1:]):
            break
    else:
        pytest.fail(
            f"ratios of the measured to the possible rate, for bare, shm and handle: {ratios}"
        )
    assert set(found["transports"]) == {"shm", "handle"}
    for row in found["transports"].values():
        assert [point["clients"] for point in row["curve"]] == [8]
        assert 1 < row["curve"][0]["mean_batch"] <= 4
        assert row["robot"]["calls"] > 0
    assert "of the ideal; a robot among simulations waits" in done.stdout


@pytest.mark.slow
@pytest.mark.integration
def test_peers_make_load_in_the_same_run(ray_home: Path, tmp_path: Path) -> None:
    file = tmp_path / "throughput.json"
    few = [
        "--clients",
        "1,2",
        "--batch",
        "2",
        "--seconds",
        "0.5",
        "--rounds",
        "2",
        "--robot-seconds",
        "1",
    ]
    peers = ["--peers", "openpi,portal", "--peers-python", str(peers_python())]
    done = bench(ray_home, "throughput", *few, *peers, "--transports", "shm", "--out", str(file))
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(file.read_text())
    assert (set(found["transports"]), set(found["peers"])) == ({"shm"}, {"openpi", "portal"})
    assert found["versions"].keys() >= {"ray", "openpi-client", "portal"}
    for row in (*found["transports"].values(), *found["peers"].values()):
        assert [point["clients"] for point in row["curve"]] == [1, 2]
        assert all(
            len(point["rounds"]) == 2 and point["ci95"][0] <= point["actions_per_s"]
            for point in row["curve"]
        )
        assert row["robot"]["calls"] > 0
    batches = {name: row["curve"][1]["mean_batch"] for name, row in found["peers"].items()}
    assert batches == {"openpi": 1.0, "portal": 2.0}
