"""Measures the gains and the costs of learners.

Each learner improves the pretrained reference policy on the tabletop, once for each seed and always
from the same checkpoint:

- `dagger`: the policy runs episodes, an expert takes over, and the policy is trained on the frames
  of the expert (examples/reference/dagger.py);
- `cloning`: the same number of optimizer steps on demonstrations of the expert alone, stored
  without loss like the corrections of `dagger`;
- `cloning_h264`: the same on demonstrations that were stored as usual, in lossy H.264;
- `grpo`, `ppo`: reinforcement learning from the reward alone (examples/learn/flow.py).

    python -m benchmarks.learners --out runs/learners --results examples/reference/learners.json
    python -m benchmarks.learners_page examples/reference/learners.json

All learners use one thread. Each new policy then runs the same held-out episodes of the tabletop as
the first policy. It also runs episodes of Meta-World, on which no learner trains, to measure what
the policy forgets. An interrupted series continues; an interrupted step begins again, so that its
costs are those of the whole step.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.console import save
from vlagents_ray.cli.console import errors, out
from vlagents_ray.cli.options import parse_list
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.evaluate import EvalConfig, PolicyConfig, Results, SuiteConfig, evaluate
from vlagents_ray.evaluate.results.statistics import Pairs
from vlagents_ray.registry import require
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.local_agent import LocalPolicy

ROOT = Path(__file__).parents[1]
CHECKPOINT = ROOT / "examples/reference/pretrained"
BEFORE = "before"  # the folder of the policy that all learners begin with
EXECUTE = 4  # number of executed rows of a chunk
TOGETHER = 16  # number of tabletop episodes that run at the same time
COSTS = "costs.json"
# Difference of the first episodes of two runs with successive seeds, which share no episodes.
SEEDS_APART = 10_000
# First seeds of recordings and trainings; seeds of evaluations begin at 0.
CORRECTIONS, DEMONSTRATIONS = 2_000_000, 3_000_000
RATE = "5e-4"  # learning rate of `dagger` and `cloning`
MOST_SEEDS = 10
REINFORCEMENT = ("grpo", "ppo")  # learners of examples/learn/flow.py
# Variables of the trainings: their memory is kept, as in examples/reference/make.sh, and each step
# has one thread.
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "1",
    "MALLOC_MMAP_THRESHOLD_": "33554432",
    "MALLOC_TRIM_THRESHOLD_": "8589934592",
}
SUITES: dict[str, dict[str, Any]] = {
    "tabletop": {
        "envs": ["tabletop"],
        "env_options": {"cameras": ["front", "wrist"], "width": 64, "height": 64},
        "num_envs": TOGETHER,
    },
    "metaworld": {
        "envs": [
            "metaworld/button-press-topdown-v3",
            "metaworld/drawer-close-v3",
            "metaworld/drawer-open-v3",
            "metaworld/window-close-v3",
        ],
        "env_options": {
            "cameras": ["corner2", "gripperPOV"],
            "width": 64,
            "height": 64,
            "shadows": False,
            "max_steps": 200,
        },
    },
}


@dataclass(frozen=True)
class Sizes:
    """The amount of work of each learner and of the evaluations."""

    recorded: int = 800  # number of episodes that `dagger` and `cloning` run
    steps: int = 600  # number of optimizer steps in `dagger` and `cloning`
    iterations: int = 20  # number of iterations of `grpo` and `ppo`
    rollouts: int = 512  # number of episodes of an iteration
    held_out: int = 500  # number of evaluated episodes of the tabletop
    metaworld: int = 25  # number of evaluated episodes of each task of Meta-World; 0 for none


@dataclass(frozen=True)
class Step:
    """A command of a learner."""

    name: str
    command: Sequence[str]
    # The file or folder that the command makes; missing if the command was interrupted.
    result: Path


@dataclass(frozen=True)
class LearnerRun:
    """A learner with one seed."""

    learner: str
    seed: int
    folder: Path

    @property
    def checkpoint(self) -> Path:
        """The folder of the new policy."""
        parent = self.learned if self.learner in REINFORCEMENT else self.folder
        return parent / "checkpoint"

    @property
    def learned(self) -> Path:
        """The output folder of examples/learn/flow.py."""
        return self.folder / "learned"

    @property
    def dataset(self) -> Path:
        """The recorded episodes."""
        return self.folder / "data" / "tabletop"


def dagger_steps(run: LearnerRun, sizes: Sizes) -> list[Step]:
    """Return the recording of corrections and the training on them."""
    first = CORRECTIONS + SEEDS_APART * run.seed
    options = ["--episodes", f"{sizes.recorded}", "--seed", f"{first}"]
    command = [_example("reference/dagger.py"), "record", f"{CHECKPOINT}", f"{run.dataset}"]
    return [Step("record", [*command, *options], run.dataset), _training(run, sizes)]


def cloning_steps(run: LearnerRun, sizes: Sizes) -> list[Step]:
    """Return the recording of demonstrations without loss and the training on them."""
    return [_demonstrations(run, sizes, "--lossless"), _training(run, sizes)]


def cloning_h264_steps(run: LearnerRun, sizes: Sizes) -> list[Step]:
    """Return the recording of demonstrations in H.264 and the training on them."""
    return [_demonstrations(run, sizes, "--no-lossless"), _training(run, sizes)]


def reinforcement_steps(run: LearnerRun, sizes: Sizes) -> list[Step]:
    """Return the training of `grpo` or `ppo`, with the smallest evaluation that the program
    allows.
    """
    options = {
        "--seed": run.seed,
        "--iterations": sizes.iterations,
        "--episodes": sizes.rollouts,
        "--held-out": 1,
        "--evaluate-every": sizes.iterations,
        "--out": run.learned,
    }
    words = _words(options)
    command = [_example("learn/flow.py"), "learn", run.learner, *words]
    return [Step("train", command, run.learned)]


def _words(options: Mapping[str, object]) -> list[str]:
    """Return options and their values as words of a command line."""
    words = []
    for option, value in options.items():
        words += [option, str(value)]
    return words


LEARNERS: dict[str, Callable[[LearnerRun, Sizes], list[Step]]] = {
    "dagger": dagger_steps,
    "cloning": cloning_steps,
    "cloning_h264": cloning_h264_steps,
    "grpo": reinforcement_steps,
    "ppo": reinforcement_steps,
}


def _example(name: str) -> str:
    return str(ROOT / "examples" / name)


def _demonstrations(run: LearnerRun, sizes: Sizes, loss: str) -> Step:
    first = DEMONSTRATIONS + SEEDS_APART * run.seed
    options = ["--episodes", f"{sizes.recorded}", "--seed", f"{first}", loss]
    command = [_example("reference/dagger.py"), "demonstrate", f"{run.dataset}", *options]
    return Step("record", command, run.dataset)


def _training(run: LearnerRun, sizes: Sizes) -> Step:
    options = {
        "--work": run.folder / "train",
        "--cameras": "tabletop=front,wrist",
        "--start": CHECKPOINT,
        "--rate": RATE,
        "--steps": sizes.steps,
        "--seed": run.seed,
        "--threads": 1,
    }
    words = _words(options)
    folders = [f"{run.dataset.parent}", f"{run.checkpoint}"]
    return Step("train", [_example("reference/train.py"), *folders, *words], run.checkpoint)


def learn(run: LearnerRun, sizes: Sizes) -> dict[str, dict[str, float]]:
    """Run the steps of a learner that have no result yet.

    Returns:
        The costs of each step: `cpu_s` and `wall_s`.

    Raises:
        VLAgentsError: A step failed.
    """
    file = run.folder / COSTS
    costs: dict[str, dict[str, float]] = json.loads(file.read_text()) if file.exists() else {}
    run.folder.mkdir(parents=True, exist_ok=True)
    for step in LEARNERS[run.learner](run, sizes):
        if step.name in costs:
            continue
        shutil.rmtree(step.result, ignore_errors=True)
        shutil.rmtree(run.folder / "train", ignore_errors=True)
        costs[step.name] = _execute(step, run.folder / f"{step.name}.log")
        file.write_text(json.dumps(costs, indent=1) + "\n")
    shutil.rmtree(run.folder / "train", ignore_errors=True)  # removes the images, a gigabyte
    return costs


def _execute(step: Step, log: Path) -> dict[str, float]:
    """Run the command of a step, and return its costs."""
    begun = time.monotonic()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with log.open("w") as file:
        done = subprocess.run(
            [sys.executable, *step.command],
            env=os.environ | ENVIRONMENT,
            stdout=file,
            stderr=subprocess.STDOUT,
            check=False,
        )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise VLAgentsError(
            f"{step.name}: expected exit status 0, got {done.returncode}; its output is in {log}"
        )
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"cpu_s": cpu_s, "wall_s": time.monotonic() - begun}


def episodes_of(run: LearnerRun, sizes: Sizes) -> dict[str, int]:
    """Return the number of episodes that a run used, by their kind."""
    if run.learner in REINFORCEMENT:
        return {"rollouts": sizes.iterations * sizes.rollouts}
    info = json.loads((run.dataset / "meta/info.json").read_text())
    kept = int(info["total_episodes"])
    if run.learner == "dagger":
        return {"rollouts": sizes.recorded, "interventions": kept}
    return {"demonstrations": kept}


Solved = dict[tuple[str, int], bool]  # whether each episode was solved, by environment and seed


def played(suite: str, checkpoint: Path, folder: Path, episodes: int) -> Solved:
    """Run those episodes of a suite that have no result in the folder yet.

    Args:
        suite: One of `SUITES`; the embodiment of the policy has the same name.
        checkpoint: The policy.
        folder: The folder of the results.
        episodes: The number of episodes of each environment.

    Returns:
        Whether each episode was solved.
    """
    config: dict[str, Any] = {"checkpoint": str(checkpoint.resolve()), "embodiment": suite}
    plan = EvalConfig(
        policies=[PolicyConfig(name="reference", config=config, execute=EXECUTE)],
        suites=[SuiteConfig(**SUITES[suite], episodes=episodes)],
        out=folder,
        video="none",
        workers=0,
        resume=True,
    )
    args = {"policy": "reference", "batch": {"max_size": TOGETHER}}
    evaluate(plan, agent_factory=lambda: LocalPolicy(ServerArgs.model_validate(args), config))
    solved: Solved = {}
    for case in Results.load(folder).cases:
        for result in case.counted:
            solved[case.env, result.key.seed] = bool(result.success_once)
    return solved


def pairs_of(after: Solved, before: Solved) -> Pairs:
    """Count the episodes that both policies, one of them, or neither solved."""
    both = sum(after[key] and before[key] for key in after)
    only_after = sum(after[key] and not before[key] for key in after)
    only_before = sum(before[key] and not after[key] for key in after)
    return Pairs(both, only_after, only_before, len(after) - both - only_after - only_before)


def rates_of(solved: Solved) -> dict[str, list[int]]:
    """Return the numbers of solved episodes and of all episodes of each environment."""
    rates: dict[str, list[int]] = {}
    for (env, _), is_solved in sorted(solved.items()):
        rate = rates.setdefault(env, [0, 0])
        rate[0] += is_solved
        rate[1] += 1
    return rates


class Series:
    """Runs of several learners and seeds, in one folder."""

    def __init__(self, folder: Path, sizes: Sizes) -> None:
        self._folder = folder.resolve()
        self._sizes = sizes
        self._first: dict[str, Solved] = {}  # results of the policy before the training, by suite

    def suites(self) -> dict[str, int]:
        """Return the number of episodes of each environment by suite, without suites that have
        none.
        """
        episodes = {"tabletop": self._sizes.held_out, "metaworld": self._sizes.metaworld}
        return {suite: number for suite, number in episodes.items() if number}

    def before(self) -> dict[str, Any]:
        """Evaluate the policy that all learners begin with."""
        for suite, episodes in self.suites().items():
            folder = self._folder / BEFORE / suite
            self._first[suite] = played(suite, CHECKPOINT, folder, episodes)
        return {suite: rates_of(solved) for suite, solved in self._first.items()}

    def run(self, learner: str, seed: int) -> dict[str, Any]:
        """Train with one seed, evaluate the new policy, and return the figures of the run."""
        run = LearnerRun(learner, seed, self._folder / f"{learner}-{seed}")
        costs = learn(run, self._sizes)
        figures: dict[str, Any] = {
            "learner": learner,
            "seed": seed,
            # Number of optimizer steps; reinforcement learning makes as many steps as its episodes
            # need.
            "steps": None if learner in REINFORCEMENT else self._sizes.steps,
            "episodes": episodes_of(run, self._sizes),
            "cpu_s": sum(cost["cpu_s"] for cost in costs.values()),
            "wall_s": sum(cost["wall_s"] for cost in costs.values()),
        }
        for suite, episodes in self.suites().items():
            after = played(suite, run.checkpoint, run.folder / suite, episodes)
            pairs = pairs_of(after, self._first[suite])
            figures[suite] = {"rates": rates_of(after), **pairs.to_json()}
        return figures


def main(
    folder: Annotated[
        Path, typer.Option("--out", help="Folder of the runs; finished steps are not repeated.")
    ] = Path("runs/learners"),
    learners: Annotated[
        str, typer.Option(help=f"Some of {','.join(LEARNERS)}; default: all.")
    ] = ",".join(LEARNERS),
    seeds: Annotated[str, typer.Option(help="Seeds of recordings and trainings.")] = "0,1,2,3,4",
    recorded: Annotated[
        int, typer.Option(min=1, help="Number of episodes that dagger and cloning record.")
    ] = Sizes.recorded,
    steps: Annotated[
        int, typer.Option(min=1, help="Number of optimizer steps of dagger and cloning.")
    ] = Sizes.steps,
    iterations: Annotated[
        int, typer.Option(min=1, help="Number of iterations of grpo and ppo.")
    ] = Sizes.iterations,
    rollouts: Annotated[
        int, typer.Option(min=1, help="Number of episodes of an iteration of grpo and ppo.")
    ] = Sizes.rollouts,
    held_out: Annotated[
        int, typer.Option(min=1, help="Number of held-out episodes of the tabletop.")
    ] = Sizes.held_out,
    metaworld: Annotated[
        int, typer.Option(min=0, help="Number of episodes of each task of Meta-World; 0: none.")
    ] = Sizes.metaworld,
    results: Annotated[
        Path | None, typer.Option(help="File of the figures, as JSON, written after each run.")
    ] = None,
) -> None:
    """Train all learners with all seeds, seed after seed, and print the success of each run."""
    with errors():
        names = parse_list(learners)
        unknown = sorted(set(names) - set(LEARNERS))
        if unknown or not names:
            raise ConfigError(f"--learners: expected only {list(LEARNERS)}, got {unknown}")
        numbers = parse_seeds(seeds)
        sizes = Sizes(recorded, steps, iterations, rollouts, held_out, metaworld)
        # Threads of the evaluations, as another number would round differently.
        require("torch").set_num_threads(1)
        series = Series(folder, sizes)

        figures: dict[str, Any] = {"sizes": asdict(sizes), "before": series.before(), "runs": []}
        out.print(f"before: {shown(figures['before']['tabletop'])}")
        for seed in numbers:
            for learner in names:
                run = series.run(learner, seed)
                figures["runs"].append(run)
                out.print(
                    f"{learner}, seed {seed}: {shown(run['tabletop']['rates'])}, "
                    f"p {run['tabletop']['p_value']:.2g}, {run['cpu_s']:.0f} s of CPU time"
                )
                save(figures, results)


def parse_seeds(text: str) -> list[int]:
    """Return the seeds of a list with commas.

    Raises:
        ConfigError: The seeds are not different numbers of at least 0, or there are too many.
    """
    words = parse_list(text)
    if not all(word.isdecimal() for word in words) or not 1 <= len(set(words)) <= MOST_SEEDS:
        raise ConfigError(
            f"--seeds: expected 1 to {MOST_SEEDS} numbers from 0 on, such as 0,1,2, got {text!r}"
        )
    return list(dict.fromkeys(int(word) for word in words))


def shown(rates: Mapping[str, Sequence[int]]) -> str:
    """Return the success of all environments together."""
    solved = sum(rate[0] for rate in rates.values())
    episodes = sum(rate[1] for rate in rates.values())
    return f"{solved} of {episodes} episodes solved"


if __name__ == "__main__":
    typer.run(main)
