"""`vlagents-ray eval FILE --watch DIR`, beside a trainer that goes on."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
import yaml
from eval_fakes import LINE, PYTHONPATH, wait_for
from ray_processes import processes, ray_folder

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import Results

COMMAND = str(Path(sys.executable).parent / "vlagents-ray")


@pytest.fixture(name="ray_home")
def own_ray_folder() -> Iterator[Path]:
    with ray_folder() as folder:
        yield folder
        assert not processes(folder), "left running"


def finished(out: Path) -> dict[str, int]:
    """Episodes of each contender."""
    with suppress(ConfigError):
        return {cell.contender: len(cell.counted) for cell in Results.load(out).cells}
    return {}


def written(folder: Path, step: int, number: str, *, done: bool) -> None:
    """A checkpoint as `served_agents.Stored` loads it."""
    (folder / f"{step}").mkdir(exist_ok=True)
    (folder / f"{step}" / "number").write_text(number)
    if done:
        (folder / f"{step}" / "done").touch()


def test_each_checkpoint_is_evaluated_once_it_is_whole_by_one_server(ray_home: Path, tmp_path: Path) -> None:
    runs, out, file = tmp_path / "runs", tmp_path / "out", tmp_path / "watched.yaml"
    runs.mkdir()
    policy = {
        "name": "mine", "source": "served_agents:Stored", "config": {"checkpoint": str(runs / "{step}" / "number")}
    }  # fmt: skip
    suites = [{"envs": [LINE], "episodes": 2}]
    file.write_text(yaml.safe_dump({"policies": [policy], "suites": suites, "out": str(out), "video": "none"}))
    written(runs, 20, "half a numb", done=False)
    with (
        (tmp_path / "log").open("w") as log,
        subprocess.Popen(
            [COMMAND, "eval", str(file), "--watch", str(runs), "--marker", "done", "--until", "30"],
            env=os.environ | {"RAY_TMPDIR": str(ray_home), "PYTHONPATH": PYTHONPATH},
            stdout=log, stderr=subprocess.STDOUT,
        ) as watching,
    ):  # fmt: skip
        try:
            written(runs, 10, "0.5", done=True)
            wait_for(lambda: finished(out) == {"mine@10": 2} or watching.poll() is not None, 180)
            assert watching.poll() is None, (tmp_path / "log").read_text()
            written(runs, 20, "-0.5", done=True)
            written(runs, 30, "1.0", done=True)
            assert watching.wait(180) == 0, (tmp_path / "log").read_text()
        finally:
            watching.terminate()
    results = Results.load(out)
    assert finished(out) == {"mine@10": 2, "mine@20": 2, "mine@30": 2}
    assert [cell.counted[0].checkpoint for cell in results.cells] == [
        str(runs / f"{n}" / "number") for n in (10, 20, 30)
    ]
    assert [cell.step for cell in results.cells] == [10, 20, 30]
    assert "step 20: not yet: has no done" in (tmp_path / "log").read_text()
    assert {one["checkpoint"] for one in results.policies.values()} == {str(runs / "10" / "number")}, "one server"
