"""What users of a version keep: results, a bundle, a recorded session, deployment and evaluation files, keys.

`python tests/support/kept_files.py` writes tests/upgrades/VERSION, once, before that version is published. Later
versions have to read it (tests/upgrades), so nothing there is ever written again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import tomllib
from flat_config import flat_config
from in_process_evaluation import play
from recorded_sessions import recorded

from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.bundle import write_bundle
from vlagents_ray.evaluate.exports.tables import to_csv
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.serve.access.key_store import new_key

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "tests/upgrades"
EPISODES = 2


class Lifting(Agent):
    """Lifts the gripper's target a little, always the same."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, object]:
        return {"checkpoint": "lifting", "weights": "sha256:5711"}

    def act(self, obs: Obs) -> Act:
        return Act(np.array([0.1, 0.0, 0.2, 1.0], np.float32))


def settings(out: Path, **changes: Any) -> EvalConfig:
    """The evaluation that is kept."""
    options = {"max_steps": 6, "width": 64, "height": 64}
    chosen = {"episodes": EPISODES, "record": "all", "video": "none"} | changes
    return flat_config(envs=["tabletop"], env_options=options, out=out, **chosen)


def write(folder: Path) -> None:
    """Write all files."""
    folder.mkdir(parents=True)
    with contextlib.chdir(folder):  # so that no path of this machine is in them
        results = play(settings(Path("results")), Lifting)
        write_bundle(Path("results"), Path("bundle.zip"))
        to_csv(results, Path("rows.csv"))
    (folder / "results/results.lock").unlink()
    for name in ("deployments", "evaluations"):
        shutil.copytree(ROOT / name, folder / name)
    new_key(folder / "keys.json", "robot-1", apps=("pi0",), rate=50.0, expires=4e9)
    new_key(folder / "keys.json", "learner", scopes=("weights", "watch"), rank="simulation")
    with recorded(folder / "session") as recording:
        recording.robot().play(3)
    digests = {
        str(file.relative_to(ROOT)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted((ROOT / "clients/golden").rglob("*"))
        if file.is_file()
    }
    (folder / "golden.json").write_text(json.dumps(digests, indent=1) + "\n")


if __name__ == "__main__":
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    if (KEPT / version).exists():
        sys.exit(f"{KEPT / version} is there; remove it if {version} is not published yet, and leave it if it is")
    write(KEPT / version)
