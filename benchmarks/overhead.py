"""Measures the overhead of an evaluation over the bare environments: steps per second, in
alternating rounds.

A bare round steps the environments in as many processes as the evaluation has workers, with zeros
as actions and no policy, server or Ray. An evaluated round runs the same episodes with a served
`noop` policy. Both count the steps made while all workers were running, with the gaps between
episodes, but without the creation of environments and the wait for the first and the last worker.
CPU time is counted in the same span: of all bare processes, or of all processes of the evaluation
(driver, workers, replica, HAProxy and Ray's daemons).
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import sqlite3
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from benchmarks.console import Out, save
from benchmarks.processes import cpu_seconds
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.envs import make_env
from vlagents_ray.errors import EnvFailed
from vlagents_ray.evaluate import EvalConfig, PolicyConfig, SuiteConfig, evaluate
from vlagents_ray.evaluate.workers.rollout import THREAD_VARIABLES
from vlagents_ray.interface import Act
from vlagents_ray.overrides import parse_settings
from vlagents_ray.ray_tools.reaper import MARK, marked
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server

_START_S = 600.0
_EVERY_S = 0.2
_LOOK_EVERY = 5  # number of samples between two searches for processes


class Span(NamedTuple):
    """One episode: the times of its beginning and end, s, and its number of steps."""

    begun: float
    ended: float
    steps: int


class CallRate(NamedTuple):
    """The figures of one round."""

    steps_per_s: float
    cpu_ms_per_step: float


class Steady(NamedTuple):
    """The span in which all workers run episodes, s of `time.time()`, and the number of all steps
    in it.
    """

    first: float
    last: float
    steps: float

    @property
    def rate(self) -> float:
        """The steps per second."""
        return self.steps / (self.last - self.first)


@dataclass(frozen=True, slots=True)
class Overhead:
    """All rounds in order; rounds i of both kinds ran one after the other."""

    env: str
    workers: int
    bare: tuple[CallRate, ...]
    evaluated: tuple[CallRate, ...]

    @property
    def ratios(self) -> tuple[float, ...]:
        """The ratio of the evaluated rate to the bare rate, by round."""
        return tuple(
            e.steps_per_s / b.steps_per_s for e, b in zip(self.evaluated, self.bare, strict=True)
        )

    @property
    def ratio(self) -> float:
        """The median of the ratios."""
        return statistics.median(self.ratios)

    @property
    def added_cpu_ms(self) -> tuple[float, ...]:
        """The CPU time that the evaluation adds to a step, ms, by round."""
        return tuple(
            e.cpu_ms_per_step - b.cpu_ms_per_step
            for e, b in zip(self.evaluated, self.bare, strict=True)
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "env": self.env,
            "workers": self.workers,
            "bare_steps_per_second": [r.steps_per_s for r in self.bare],
            "evaluated_steps_per_second": [r.steps_per_s for r in self.evaluated],
            "ratios": list(self.ratios),
            "median_ratio": self.ratio,
            "bare_cpu_ms_per_step": [r.cpu_ms_per_step for r in self.bare],
            "evaluated_cpu_ms_per_step": [r.cpu_ms_per_step for r in self.evaluated],
            "median_added_cpu_ms_per_step": statistics.median(self.added_cpu_ms),
        }


def measure_overhead(
    env: str,
    *,
    workers: int = 2,
    episodes: int = 8,
    rounds: int = 3,
    env_options: Mapping[str, Any] | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Overhead:
    """Alternate bare and evaluated rounds with `episodes` episodes for each worker."""
    options = dict(env_options or {})
    with make_env(env, **options) as one:
        action_dim = one.contract.action.dim or 1
    cpus = max(os.cpu_count() or 1, workers)
    bare: list[CallRate] = []
    evaluated: list[CallRate] = []
    policy = deployment("noop", config={"action_dim": action_dim})
    with running_server(policy, num_cpus=cpus), tempfile.TemporaryDirectory() as folder:
        for number in range(rounds):
            bare.append(bare_rate(env, options, action_dim, workers, episodes))
            progress(f"round {number + 1}/{rounds}: bare {bare[-1].steps_per_s:.1f} steps/s")
            config = EvalConfig(
                policies=[PolicyConfig(name="noop", url="serve://noop")],
                suites=[SuiteConfig(envs=[env], env_options=options, episodes=episodes * workers)],
                workers=workers,
                video="none",
                out=Path(folder) / str(number),
            )
            # The cluster's processes have this value in their environment.
            with CpuSampler(lambda: marked(os.environ[MARK])) as cpu:
                evaluate(config)
            playing = steady(recorded(config.out), workers)
            evaluated.append(
                CallRate(
                    playing.rate, cpu.between(playing.first, playing.last) * 1e3 / playing.steps
                )
            )
            progress(
                f"round {number + 1}/{rounds}: evaluated {evaluated[-1].steps_per_s:.1f} steps/s"
            )
    return Overhead(env, workers, tuple(bare), tuple(evaluated))


def steady(episodes: Sequence[Span], workers: int) -> Steady:
    """Find the span between the first and the last moment at which all `workers` run episodes.

    The steps of an episode are assumed to be evenly spread. Raises `EnvFailed` if the workers never
    all run episodes.
    """
    edges = sorted([(e.begun, 1) for e in episodes] + [(e.ended, -1) for e in episodes])
    playing = 0
    full: list[float] = []  # times at which all workers begin to run, or no longer all run
    for moment, change in edges:
        if workers in (playing, playing + change):
            full.append(moment)
        playing += change
    if len(full) < 2:
        raise EnvFailed(f"{workers} workers were never all playing; measure more episodes")
    first, last = full[0], full[-1]
    inside = sum(
        e.steps * max(0.0, min(e.ended, last) - max(e.begun, first)) / (e.ended - e.begun)
        for e in episodes
    )
    return Steady(first, last, inside)


def bare_rate(
    env: str, options: Mapping[str, Any], action_dim: int, workers: int, episodes: int
) -> CallRate:
    """Run `episodes` episodes with zeros as actions in each of `workers` processes."""
    context = multiprocessing.get_context("spawn")
    start = context.Barrier(workers)
    results = context.Queue()
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))  # as in the evaluation's workers
    try:
        processes = [
            context.Process(
                target=_play,
                args=(env, dict(options), action_dim, worker * episodes, episodes, start, results),
            )
            for worker in range(workers)
        ]
        for process in processes:
            process.start()
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
    played: list[tuple[list[Span], float]] = [results.get(timeout=_START_S) for _ in processes]
    for process in processes:
        process.join(60)
        if process.exitcode != 0:
            raise EnvFailed(f"{env}: a bare process ended with exit code {process.exitcode}")
    spans = [span for one, _ in played for span in one]
    steps = sum(span.steps for span in spans)
    return CallRate(steady(spans, workers).rate, sum(cpu for _, cpu in played) * 1e3 / steps)


def _play(
    name: str,
    options: dict[str, Any],
    action_dim: int,
    seed: int,
    episodes: int,
    start: Barrier,
    results: Any,
) -> None:
    spans: list[Span] = []
    act = Act(np.zeros(action_dim, np.float32))
    with make_env(name, **options) as env:
        start.wait(_START_S)
        used = time.process_time()
        for episode in range(episodes):
            begun, steps, done = time.time(), 0, False
            env.reset(seed=seed + episode)
            while not done:
                _, _, terminated, truncated, _ = env.step(act)
                steps += 1
                done = terminated or truncated
            spans.append(Span(begun, time.time(), steps))
        results.put((spans, time.process_time() - used))


def recorded(out: Path) -> list[Span]:
    """Read every episode of these results."""
    with contextlib.closing(sqlite3.connect(out / "results.db")) as db:
        rows = db.execute("SELECT finished - seconds, finished, steps FROM episodes").fetchall()
    return [Span(*row) for row in rows]


class CpuSampler:
    """Samples the CPU time of this process and of the processes that `processes` returns, within a
    context.

    An ended process counts with its last sample. The time for sampling itself is not counted.
    """

    def __init__(self, processes: Callable[[], Iterable[int]]) -> None:
        self._processes = processes
        self._seen: dict[int, float] = {}
        self._moments: list[tuple[float, float]] = []  # samples: s of time.time(), and CPU s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._sample, name="cpu", daemon=True)

    def __enter__(self) -> CpuSampler:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join()

    def between(self, first: float, last: float) -> float:
        """Interpolate the CPU time that was used between two times, s of `time.time()`."""
        moments, totals = zip(*self._moments, strict=True)
        return float(np.interp(last, moments, totals) - np.interp(first, moments, totals))

    def _sample(self) -> None:
        pids: set[int] = set()
        number = 0
        while True:
            if number % _LOOK_EVERY == 0:
                pids = {*self._processes(), os.getpid()}
            number += 1
            for pid in pids:
                try:
                    self._seen[pid] = cpu_seconds(pid)
                except OSError:
                    continue
            self._moments.append((time.time(), sum(self._seen.values()) - time.thread_time()))
            if self._stop.is_set():
                return
            self._stop.wait(_EVERY_S)


def show_overhead(found: Overhead) -> None:
    """Print a row for each round."""
    rows = table(
        "round",
        "bare steps/s",
        "evaluated steps/s",
        "ratio",
        "bare CPU ms/step",
        "evaluated CPU ms/step",
    )
    rows.title = f"{found.env}, {found.workers} workers"
    for number, (bare, ours, ratio) in enumerate(
        zip(found.bare, found.evaluated, found.ratios, strict=True), 1
    ):
        rows.add_row(
            str(number), f"{bare.steps_per_s:.1f}", f"{ours.steps_per_s:.1f}", f"{ratio:.3f}",
            f"{bare.cpu_ms_per_step:.3f}", f"{ours.cpu_ms_per_step:.3f}",
        )  # fmt: skip
    out.print(rows)


def main(
    env: Annotated[str, typer.Argument(help="The environment to step.")] = "tabletop",
    workers: Annotated[int, typer.Option(min=1)] = 2,
    episodes: Annotated[
        int, typer.Option(min=1, help="Number of episodes for each worker and round.")
    ] = 8,
    rounds: Annotated[int, typer.Option(min=1)] = 3,
    out_file: Out = None,
    env_set: Annotated[list[str], typer.Option("--env-set", metavar="KEY=VALUE")] = [],  # noqa: B006
) -> None:
    """Measure steps per second, and CPU time per step, of an evaluation and of the bare
    environments.
    """
    with errors():
        options = parse_settings(env_set, "--env-set")
        found = measure_overhead(
            env,
            workers=workers,
            episodes=episodes,
            rounds=rounds,
            env_options=options,
            progress=progress,
        )
    show_overhead(found)
    data = found.to_json()
    out.print(
        f"median ratio {found.ratio:.3f}, CPU time added to a step "
        f"{data['median_added_cpu_ms_per_step']:.3f} ms"
    )
    save(data, out_file)


if __name__ == "__main__":
    typer.run(main)
