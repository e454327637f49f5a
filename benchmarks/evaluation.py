"""Measures episodes per minute of whole evaluations, ours and those of other systems, in
alternating rounds on one machine.

Each system runs the same episodes of one environment (`environments.TimedEnv`: same code, image
size, step limit, seeds and initial states) with a policy that does nothing behind the system's own
server, with the system's own command, and stores the results. A round runs each system once:

- ours: `vlagents-ray eval`, which serves the policy for the length of the run;
- vlagents: `run-eval`, over shared memory. It runs one configuration in one process, which is the
  first variant here. The second variant splits the episodes into one configuration for each worker,
  each with its own process and server;
- vla-eval: one model server, and as many shards as `vlagents-ray eval` has workers, without Docker;
- lerobot: `lerobot-eval`, the policy in its process, with as many environments, which it steps one
  after another.

`--env` names a simulator: it must be installed in this Python and, with the peers, in
`--peers-python` (`peers/requirements-simulators.txt` has LIBERO and ManiSkill; vlagents, which
needs numpy 1, cannot be there). With `--chunk 8` our policy returns 8 rows, and images between two
requests are not rendered; the other systems render each step.

For ours, summary.json also has the shares of the time in which the simulators and the policy were
busy.

The rate counts from the first reset to the last step, so that start-up and shutdown do not count;
`run-eval` sleeps for a fixed time of 30 s in them. The second figure is the wall time of the whole
command.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

import vlagents_ray
from benchmarks.console import Out, save, show_skipped
from benchmarks.environments import TIMED_ENV, read_episode_times
from benchmarks.line_process import LineProcess, ProcessFailed, our_environment
from benchmarks.peers import PYTHON, SCRIPTS, PeersPython, installed
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.cli.options import parse_list
from vlagents_ray.envs.base import known_contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.results.summary import FILE as SUMMARY
from vlagents_ray.evaluate.workers.rollout import THREAD_VARIABLES
from vlagents_ray.serve.ports import LOOPBACK, free_block

OURS = "vlagents-ray"
SPLIT = "vlagents, split"  # variant of vlagents with a configuration for each worker
# Scripts of the other systems.
PEERS = {
    "vlagents": "vlagents_peer.py",
    "vla-eval": "vla_eval_peer.py",
    "lerobot": "lerobot_eval_peer.py",
}
_SIMULATORS = (
    "vlagents-ray venv create benchmarks/peers/requirements-simulators.txt --light --out "
    ".venv-peers-simulators"
)
_CURES = {
    "vlagents": "`python -m benchmarks.peers` makes an environment",
    "vla-eval": (
        f"`python -m benchmarks.peers` makes an environment, with simulators `{_SIMULATORS}`"
    ),
    "lerobot": f"`{_SIMULATORS}` makes an environment",
}
_MOST_S = 3600.0  # time limit of one command, s


@dataclass(frozen=True, slots=True)
class EvaluationPlan:
    """The episodes that all systems run."""

    episodes: int = 200  # total number of episodes
    workers: int = 2  # number of workers; with 0, `vlagents-ray eval` runs in its own process
    rounds: int = 3
    size: int = 224  # width and height of images, pixels
    max_steps: int = 80  # step limit; nothing else ends an episode
    step_ms: float = 0.0  # additional CPU time of each environment step, ms
    name: str = "tabletop"  # name of the environment
    chunk: int = 1  # number of rows in an answer of our policy

    def __post_init__(self) -> None:
        if self.episodes % max(1, self.workers):
            raise ConfigError(
                f"episodes: expected a multiple of the {self.workers} workers, got {self.episodes}"
            )

    def env(self, notes: Path) -> dict[str, Any]:
        """Return the options of the environment."""
        options = {"size": self.size, "max_steps": self.max_steps, "step_ms": self.step_ms}
        return {"notes": str(notes), "env": self.name, **options}

    @property
    def action_dim(self) -> int:
        """The number of values in an action."""
        contract = known_contract(self.name, {})
        # The action dimension of LIBERO, and of ManiSkill by default.
        return 7 if contract is None else contract.action.dim or 7


class Played(NamedTuple):
    """The figures of one command."""

    episodes_per_minute: float  # rate from the first reset to the last step
    wall_s: float  # wall time of the whole command, s
    env_busy: float | None = None  # busy share of the workers' time; only for our evaluation
    policy_busy: float | None = None  # busy share of the replica's time; only for our evaluation


# Is called with the system's folder and with the folder of the records.
Run = Callable[[Path, Path], None]


def measure_evaluation(
    plan: EvaluationPlan,
    *,
    peers: Sequence[str] = (),
    peers_python: Path,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Measure all systems, and return plain JSON values. Systems that cannot run here are in
    `skipped`, with the reason.
    """
    wanted = list(PEERS) if "all" in peers else peers
    if unknown := set(wanted) - set(PEERS):
        raise ConfigError(f"peers: expected only {list(PEERS)}, or 'all', got {sorted(unknown)}")
    versions = installed(peers_python, list(PEERS)) if wanted and peers_python.is_file() else {}
    scripts = {peer: SCRIPTS / PEERS[peer] for peer in wanted if peer in versions}
    skipped = {
        peer: f"not installed for {peers_python}; {_CURES[peer]}"
        for peer in wanted
        if peer not in versions
    }
    rounds: dict[str, list[Played]] = {}
    with tempfile.TemporaryDirectory() as top:
        runs = {OURS: our_run(plan)} | their_runs(plan, scripts, peers_python, alone(Path(top)))
        for number in range(plan.rounds):
            for name, run in runs.items():
                folder = Path(top) / f"{name} {number}"
                rounds.setdefault(name, []).append(played := play(plan, run, folder))
                progress(
                    f"round {number + 1}/{plan.rounds}: {name} {played.episodes_per_minute:.0f} "
                    f"episodes/min, whole command {played.wall_s:.1f} s"
                )
    return {
        "plan": asdict(plan),
        "cores": os.cpu_count(),
        "versions": {OURS: version(OURS)} | {peer: versions[peer] for peer in scripts},
        "skipped": skipped,
        "rounds": {name: [one._asdict() for one in each] for name, each in rounds.items()},
        "medians": {name: _median(each)._asdict() for name, each in rounds.items()},
        "ratios": {
            name: ratios(rounds[OURS], each) for name, each in rounds.items() if name != OURS
        },
    }


def play(plan: EvaluationPlan, run: Run, folder: Path) -> Played:
    """Run the plan with one system. Raises `ProcessFailed` if the system did not run exactly these
    episodes.
    """
    notes = folder / "notes"
    notes.mkdir(parents=True)
    begun = time.time()  # the clock of the records
    run(folder, notes)
    wall_s = time.time() - begun
    episodes = [note for each in read_episode_times(notes).values() for note in each]
    seeds, steps = sorted(note.seed for note in episodes), {note.steps for note in episodes}
    if seeds != list(range(plan.episodes)) or steps != {plan.max_steps}:
        raise ProcessFailed(
            f"{folder.name}: ran {len(episodes)} episodes with {len(set(seeds))} seeds and "
            f"{sorted(steps)} steps, want each of {plan.episodes} once with {plan.max_steps}; its "
            "results cannot be compared"
        )
    first = min(note.begun for note in episodes)
    playing_s = max(note.ended for note in episodes) - first
    summary = folder / "results" / SUMMARY
    found = json.loads(summary.read_text()) if summary.is_file() else {}
    busy = found.get("env_busy"), found.get("policy_busy")
    return Played(60 * plan.episodes / playing_s, wall_s, *busy)


def ratios(ours: Sequence[Played], theirs: Sequence[Played]) -> dict[str, Any]:
    """Return our rate over theirs and their wall time over ours: both ratios are above 1 if we are
    faster.
    """
    pairs = list(zip(ours, theirs, strict=True))
    rates = [mine.episodes_per_minute / other.episodes_per_minute for mine, other in pairs]
    walls = [other.wall_s / mine.wall_s for mine, other in pairs]
    return {
        "rounds": rates,
        "median": statistics.median(rates),
        "wall_rounds": walls,
        "wall_median": statistics.median(walls),
    }


def alone(folder: Path) -> dict[str, str]:
    """Return environment variables with which another Python can import our two packages, but no
    other packages of this Python.
    """
    place = folder / "path"
    place.mkdir()
    for package in (Path(vlagents_ray.__file__).parent, Path(__file__).parent):
        (place / package.name).symlink_to(package)
    return {"PYTHONPATH": f"{place}{os.pathsep}{SCRIPTS}"} | dict.fromkeys(THREAD_VARIABLES, "1")


def our_run(plan: EvaluationPlan) -> Run:
    """Return the function that runs `vlagents-ray eval`, which serves the policy or, without
    workers, runs it itself.
    """

    def run(folder: Path, notes: Path) -> None:
        settings = [f"--env-set={name}={value}" for name, value in plan.env(notes).items()]
        command = [
            sys.executable,
            "-c",
            "from vlagents_ray.cli import main; main()",
            "eval",
            TIMED_ENV,
            "--policy=noop",
            f"--set=action_dim={plan.action_dim}",
            f"--set=chunk={plan.chunk}",
            f"--episodes={plan.episodes}",
            f"--workers={plan.workers}",
            "--video=none",
            f"--out={folder / 'results'}",
            *settings,
        ]
        environment = os.environ | our_environment()
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, check=False, timeout=_MOST_S
        )
        if done.returncode:
            raise ProcessFailed(
                f"{OURS}: ended with exit status {done.returncode}\n{done.stderr[-2000:]}"
            )

    return run


def their_runs(
    plan: EvaluationPlan, scripts: Mapping[str, Path], python: Path, environment: Mapping[str, str]
) -> dict[str, Run]:
    """Return the function that runs each system in `scripts`; vlagents has two."""

    def way(name: str, peer: str, workers: int) -> Run:
        def run(folder: Path, notes: Path) -> None:
            words = {
                "folder": str(folder),
                "episodes": plan.episodes,
                "workers": workers,
                "seed": 0,
            }
            words["action_dim"] = plan.action_dim
            given = json.dumps(words | {"env": plan.env(notes)})
            port = str(free_block(workers))
            with LineProcess(
                name,
                [str(python), str(scripts[peer]), "evaluate", LOOPBACK, port, given],
                environment,
            ) as child:
                child.read(_MOST_S)

        return run

    found = {peer: way(peer, peer, 1 if peer == "vlagents" else plan.workers) for peer in scripts}
    if "vlagents" in scripts and plan.workers > 1:
        found[SPLIT] = way(SPLIT, "vlagents", plan.workers)
    return found


def _median(rounds: Sequence[Played]) -> Played:
    rates, walls, *others = zip(*rounds, strict=True)
    known = (None if None in column else statistics.median(column) for column in others)
    return Played(statistics.median(rates), statistics.median(walls), *known)


def show_evaluation(found: Mapping[str, Any]) -> None:
    """Print a row for each system."""
    plan = found["plan"]
    rows = table(
        "",
        "episodes/min",
        "whole command s",
        "simulators busy",
        "policy busy",
        "ours / theirs",
        "wall: theirs / ours",
    )
    rows.title = (
        f"{plan['episodes']} episodes of {plan['max_steps']} steps of {plan['name']}, "
        f"{plan['size']}x{plan['size']}, {plan['workers']} workers on {found['cores']} cores, "
        f"medians of {plan['rounds']} rounds"
    )
    for name, row in found["medians"].items():
        ratio = found["ratios"].get(name)
        cells = [f"{ratio['median']:.2f}", f"{ratio['wall_median']:.2f}"] if ratio else ["", ""]
        busy = [
            "" if row[side] is None else f"{row[side]:.0%}" for side in ("env_busy", "policy_busy")
        ]
        rows.add_row(
            name, f"{row['episodes_per_minute']:.0f}", f"{row['wall_s']:.1f}", *busy, *cells
        )
    out.print(rows)
    show_skipped(found)


def main(
    episodes: Annotated[
        int, typer.Option(min=1, help="Number of episodes of each system in each round.")
    ] = 200,
    workers: Annotated[int, typer.Option(min=1)] = 2,
    peers: Annotated[
        str, typer.Option(help="vlagents, vla-eval, lerobot, separated by commas, or 'all'.")
    ] = "",
    rounds: Annotated[int, typer.Option(min=1)] = 3,
    size: Annotated[
        int, typer.Option(min=32, help="Width and height of the image, in pixels.")
    ] = 224,
    max_steps: Annotated[int, typer.Option(min=1, help="Number of steps of an episode.")] = 80,
    env_ms: Annotated[
        float, typer.Option(min=0, help="Additional CPU time of each environment step, in ms.")
    ] = 0.0,
    env: Annotated[
        str, typer.Option(help="The environment: libero/libero_spatial/0, maniskill/PushCube-v1.")
    ] = "tabletop",
    chunk: Annotated[
        int,
        typer.Option(
            min=1, help="Number of rows in each answer of our policy, all of which are executed."
        ),
    ] = 1,
    peers_python: PeersPython = PYTHON,
    out_file: Out = None,
) -> None:
    """Measure episodes per minute of whole evaluations: `vlagents-ray eval` and the other systems'
    own commands, interleaved.
    """
    with errors():
        plan = EvaluationPlan(episodes, workers, rounds, size, max_steps, env_ms, env, chunk)
        found = measure_evaluation(
            plan, peers=parse_list(peers), peers_python=peers_python, progress=progress
        )
    show_evaluation(found)
    save(found, out_file)


if __name__ == "__main__":
    typer.run(main)
