"""Workers and environments a worker with which an evaluation ends soonest, measured on a part of it."""

from __future__ import annotations

import math
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.evaluate import EvalConfig, evaluate
from vlagents_ray.evaluate.plan.cases import cells

_RISING = 1.05  # how much shorter a further doubling must make the evaluation for a next one to be tried
_ROUNDS = 2  # episodes of each environment in a measurement, at least
_PROBE_S = 5.0  # for which a measurement plays, at least
_MEMORY = 0.9  # share of the available memory that may be used
_SAMPLE_S = 0.05


@dataclass(frozen=True, slots=True)
class MeasuredEvaluation:
    """The figures of one number of workers, with so many environments each."""

    workers: int
    num_envs: int
    start_s: float  # until the first episode began
    episodes_per_min: float
    memory_mib: float  # that was used at most while it ran, beside what was used before
    total_s: float  # of the whole evaluation at that rate, its start included


@dataclass(slots=True)
class EvaluationTuner:
    """Measures an evaluation whose policies are served already.

    Workers are doubled as long as that makes the evaluation 5 % shorter, then the environments of each worker.

    Args:
        config: The evaluation. Of its suites, the first environment is played, by its first policy and checkpoint.
        end: When it has to end, s of `time.monotonic`.
        max_workers: The largest number of workers.
        max_envs: The largest number of environments a worker.
        progress: Called with a line for each measurement.
    """

    config: EvalConfig
    end: float
    max_workers: int
    max_envs: int = 8
    progress: Callable[[str], None] = lambda _: None
    left_out: list[str] = field(default_factory=list)  # what was not measured, a sentence each
    found: list[MeasuredEvaluation] = field(default_factory=list)

    def measure(self) -> list[MeasuredEvaluation]:
        """Measure; the first is the evaluation as it is."""
        own = max(suite.num_envs for suite in self.config.suites)
        self._add(self._probe(self.config.workers, own))
        self._rise([(number, own) for number in _doubled(self.max_workers) if number != self.config.workers])
        workers = self.chosen.workers
        if not any(suite.clock is not None and suite.clock.latency == "measured" for suite in self.config.suites):
            self._rise([(workers, number) for number in _doubled(self.max_envs) if number != own])
        return self.found

    @property
    def chosen(self) -> MeasuredEvaluation:
        """The shortest evaluation; one with fewer environments at once if it takes at most 5 % longer."""
        shortest = min(one.total_s for one in self.found)
        near = [one for one in self.found if one.total_s <= _RISING * shortest]
        return min(near, key=lambda one: (one.workers * one.num_envs, one.total_s))

    def _rise(self, candidates: list[tuple[int, int]]) -> None:
        """Measure candidates, ascending, until two in a row make the evaluation no shorter."""
        worse = 0
        for workers, num_envs in candidates:
            name = _words(workers, num_envs)
            last = max(self.found, key=lambda one: one.workers * one.num_envs)
            share = workers * num_envs / (last.workers * last.num_envs)
            if share * last.memory_mib > _MEMORY * _available_mib():
                self.left_out.append(
                    f"{name}: would take about {share * last.memory_mib:.0f} MiB, {_available_mib():.0f} are available"
                )
                return
            if time.monotonic() + last.start_s + _ROUNDS * 60 / last.episodes_per_min > self.end:
                self.left_out.append(f"{name}: no time was left")
                return
            shortest = min(one.total_s for one in self.found)
            try:
                measured = self._probe(workers, num_envs)
            except VLAgentsError as error:
                self.left_out.append(f"{name}: {error}")
                return
            self._add(measured)
            worse = 0 if measured.total_s * _RISING <= shortest else worse + 1
            if worse == 2:
                return

    def _add(self, measured: MeasuredEvaluation) -> None:
        self.found.append(measured)
        name = _words(measured.workers, measured.num_envs)
        self.progress(f"{name}: {measured.episodes_per_min:.1f} episodes a minute")

    def _probe(self, workers: int, num_envs: int) -> MeasuredEvaluation:
        """Play some episodes of the evaluation with these numbers."""
        with tempfile.TemporaryDirectory() as folder, _memory_used() as used:
            summary = evaluate(self._part(workers, num_envs, Path(folder) / "results"))
        if summary.total.infra_failures or not summary.rollout_seconds:
            raise VLAgentsError("episodes were lost to infrastructure")
        per_min = summary.total.episodes / summary.rollout_seconds * 60
        start_s = summary.wall_seconds - summary.rollout_seconds
        planned = sum(cell.planned for cell in cells(self.config))
        return MeasuredEvaluation(workers, num_envs, start_s, per_min, used[0], start_s + planned / per_min * 60)

    def _part(self, workers: int, num_envs: int, out: Path) -> EvalConfig:
        """Return the evaluation of the first env of each suite, by the first policy, of as many episodes as needed."""
        policy = self.config.policies[0]
        fastest = max((one.episodes_per_min for one in self.found), default=0.0)
        played = max(_ROUNDS * workers * num_envs, fastest * _PROBE_S / 60)
        episodes = math.ceil(played / len(self.config.suites))
        firsts = {cell.suite.model_dump_json(): cell for cell in reversed(cells(self.config))}
        suites = [
            cell.suite.model_copy(
                update={"envs": [cell.env], "seeds": cell.suite.seeds[:1], "episodes": episodes, "num_envs": num_envs}
            )
            for cell in firsts.values()
        ]
        changes: dict[str, object] = {
            "policies": [policy.model_copy(update={"steps": policy.steps[:1]})], "suites": suites, "out": out,
            "workers": workers, "resume": False, "stop": None, "track": [], "retries": 0, "abort_after": 1,
        }  # fmt: skip
        return self.config.model_copy(update=changes)


def _doubled(most: int) -> list[int]:
    return [2**power for power in range(most.bit_length())]


def _words(workers: int, num_envs: int) -> str:
    return f"{workers} worker{'s' if workers > 1 else ''} of {num_envs}"


def _available_mib() -> float:
    """Return the memory of this machine that processes can still take."""
    for line in Path("/proc/meminfo").read_text().splitlines():
        name, _, value = line.partition(":")
        if name == "MemAvailable":
            return int(value.split()[0]) / 2**10
    return math.inf


@contextmanager
def _memory_used() -> Iterator[list[float]]:
    """Yield a list whose one number is, at the end, the most memory that was used beside that of the beginning, MiB."""
    before, used, over = _available_mib(), [0.0], threading.Event()

    def watch() -> None:
        while not over.wait(_SAMPLE_S):
            used[0] = max(used[0], before - _available_mib())

    thread = threading.Thread(target=watch, name="memory", daemon=True)
    thread.start()
    try:
        yield used
    finally:
        over.set()
        thread.join()
