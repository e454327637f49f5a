"""A learner in a separate process, with a Ray of its own, that is killed and continues."""

from __future__ import annotations

import itertools
import json
import os
import sys
from pathlib import Path
from subprocess import Popen
from typing import Any

import pyarrow as pa
import pytest
from eval_fakes import LINE, PYTHONPATH, ToZero, wait_for
from ray_processes import processes, ray_folder, wait_for_end

from vlagents_ray_learn import RolloutPlan, Rollouts

pytestmark = [pytest.mark.ray, pytest.mark.slow]

EPISODES = 8
LEARNER = """
import json, sys
from pathlib import Path
import pyarrow as pa
from eval_fakes import LINE, ToZero
from vlagents_ray_learn import RolloutPlan, Rollouts

folder, episodes, workers = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
options = json.loads(sys.argv[4])
checkpoint = folder / "position"
first = int(checkpoint.read_text()) if checkpoint.exists() else 0
plan = RolloutPlan(LINE, ToZero, workers=workers, first=first, env_options=options)
with Rollouts(plan) as rollouts:
    while rollouts.position < episodes:
        batch = next(rollouts)
        with pa.OSFile(str(folder / f"{rollouts.position - 1}.arrow"), "wb") as file:
            with pa.ipc.new_file(file, batch.schema) as writer:
                writer.write_batch(batch)
        (folder / "part").write_text(str(rollouts.position))
        (folder / "part").rename(checkpoint)
"""


def learned(folder: Path) -> list[Any]:
    """The episodes that the learner has kept, by their numbers."""
    files = sorted(folder.glob("*.arrow"), key=lambda file: int(file.stem))
    assert [int(file.stem) for file in files] == list(range(len(files)))
    return [pa.ipc.open_file(file).get_batch(0) for file in files]


def test_a_killed_learner_leaves_nothing_running_and_goes_on_without_a_lost_or_doubled_transition(
    tmp_path: Path,
) -> None:
    options = {"folder": str(tmp_path), "trouble": {"gate": [5, 6]}}
    checkpoint = tmp_path / "position"
    with ray_folder() as ours:
        environment = {**os.environ, "PYTHONPATH": PYTHONPATH, "RAY_TMPDIR": str(ours)}

        def learn(workers: int) -> Popen[bytes]:
            arguments = [str(tmp_path), str(EPISODES), str(workers), json.dumps(options)]
            command = [sys.executable, "-c", LEARNER, *arguments]
            return Popen(command, env=environment, start_new_session=True)

        with learn(workers=2) as learner:
            wait_for(lambda: all((tmp_path / f"gate-{seed}").exists() for seed in (5, 6)))
            # Both workers are in mid-episode.
            wait_for(lambda: checkpoint.exists() and checkpoint.read_text() == "5")
            learner.kill()
        wait_for_end(ours, "Rollout")
        wait_for(lambda: not processes(ours))
        with learn(workers=0) as learner:  # without another Ray
            assert learner.wait(300) == 0
    with Rollouts(RolloutPlan(LINE, ToZero, workers=0, env_options=options)) as undisturbed:
        expected = list(itertools.islice(undisturbed, EPISODES))
    got = learned(tmp_path)
    assert len(got) == EPISODES
    assert all(one.equals(other) for one, other in zip(got, expected, strict=True))
