"""Tests the endurance of one evaluation with many episodes and killed workers: memory, speed, and
lost episodes.

Images are small and steps few, so that the work around an episode is measured. The gap is the time
between an episode's last step and the next episode's reset in the same worker; it contains the
result, its transport to the driver, the database, and the next job. The youngest worker is killed
at intervals. The oldest worker runs from the first episode to the last; its memory and the driver's
memory are sampled.
"""

from __future__ import annotations

import itertools
import os
import signal
import tempfile
import threading
import time
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from benchmarks.console import Out, save
from benchmarks.environments import TIMED_ENV, EpisodeTimes, read_episode_times
from benchmarks.report import Outcome, show_outcomes, unmeasured
from vlagents_ray.cli.console import errors, out, progress
from vlagents_ray.evaluate import EvalConfig, PolicyConfig, Progress, Results, SuiteConfig, evaluate
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase, plan_cases
from vlagents_ray.evaluate.plan.jobs import plan_jobs
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server

LIMIT_GAP_MS = 5.0
LIMIT_SLOWDOWN = 1.25  # maximum ratio of the last thousand episodes to the first, including noise
LIMIT_GROWTH_MIB = 0.5  # maximum growth of a process in a thousand episodes
_EVERY_S = 0.5  # time between two samples of the memory, s
_PAGE = os.sysconf("SC_PAGE_SIZE")
_MIB = 2**20
_SETTLING = 0.2  # share of the episodes in which pools and caches fill


@dataclass(frozen=True, slots=True)
class SoakPlan:
    """The evaluation of `measure_soak`."""

    episodes: int = 10_000
    workers: int = 2
    kill_every_s: float = 30.0  # time between two kills, s; 0 for no kills
    max_steps: int = 20
    size: int = 32  # width and height of images, pixels

    @property
    def window(self) -> int:
        """The number of first episodes, and of last episodes, that are compared: at most a quarter
        of all.
        """
        return min(1000, self.episodes // 4)


class ResourceSample(NamedTuple):
    """Memory at one moment."""

    episodes: int  # number of episodes recorded so far
    driver: int  # resident memory of the driver, bytes
    eldest: int | None  # resident memory of the first worker, bytes; None once the worker has ended


def measure_soak(
    soak: SoakPlan, progress: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Run the evaluation, monitor it, and return plain JSON values."""
    ledger = SoakLedger(progress)
    cpus = max(os.cpu_count() or 1, soak.workers)
    with (
        running_server(deployment("noop", config={"action_dim": 4}), num_cpus=cpus),
        tempfile.TemporaryDirectory() as top,
    ):
        notes = Path(top) / "notes"
        notes.mkdir()
        config = EvalConfig(
            policies=[PolicyConfig(name="noop", url="serve://noop")],
            suites=[
                SuiteConfig(
                    envs=[TIMED_ENV],
                    env_options={
                        "notes": str(notes),
                        "size": soak.size,
                        "max_steps": soak.max_steps,
                    },
                    episodes=soak.episodes,
                )
            ],
            workers=soak.workers,
            video="none",
            out=Path(top) / "results",
        )
        with SoakWatcher(notes, ledger, soak) as watcher:
            evaluate(config, progress=ledger)
        found = Results.load(config.out)
        wanted = sorted(str(job.key) for job in plan_jobs(plan_cases(config)))
        return report(soak, ledger, watcher, read_episode_times(notes), found, wanted)


class SoakLedger(Progress):
    """Records the time of each recorded episode, and the driver's CPU time until then."""

    def __init__(self, progress: Callable[[str], None]) -> None:
        # Arrays of times, s of `time.time()`, which are small compared with the growth to detect.
        self.at_s, self.cpu_s = array("d"), array("d")
        self._progress = progress

    def episode(self, case: EvalCase, result: EpisodeResult) -> None:
        """Record the time."""
        self.at_s.append(time.time())
        self.cpu_s.append(time.process_time())
        if len(self.at_s) % 1000 == 0:
            self._progress(f"{len(self.at_s)} of {case.planned} episodes")


class SoakWatcher:
    """Samples memory, and kills the youngest worker at intervals. Use as a context manager."""

    def __init__(self, notes: Path, ledger: SoakLedger, soak: SoakPlan) -> None:
        self.samples: list[ResourceSample] = []
        self.killed: list[int] = []
        self._notes = notes
        self._ledger = ledger
        self._soak = soak
        self._seen: list[int] = []  # workers that have finished an episode, the oldest first
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="soak", daemon=True)

    def __enter__(self) -> SoakWatcher:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join()

    def _watch(self) -> None:
        since: float | None = None  # time of the first episode, or of the last kill
        while not self._stop.wait(_EVERY_S):
            self._seen += [
                pid
                for file in self._notes.glob("*.txt")
                if (pid := int(file.stem)) not in self._seen
            ]
            if not self._seen:
                continue
            self.samples.append(
                ResourceSample(
                    len(self._ledger.at_s), resident(os.getpid()) or 0, resident(self._seen[0])
                )
            )
            since = since or time.monotonic()
            if (
                self._soak.kill_every_s
                and time.monotonic() - since >= self._soak.kill_every_s
                and self._kill()
            ):
                since = time.monotonic()

    def _kill(self) -> bool:
        """Kill the youngest worker, if all workers are running."""
        playing = [pid for pid in self._seen if is_worker(pid)]
        if len(playing) < self._soak.workers:
            return False
        with suppress(ProcessLookupError):
            os.kill(playing[-1], signal.SIGKILL)
        self.killed.append(playing[-1])
        return True


def is_worker(pid: int) -> bool:
    """Return whether the process is one of Ray's, and not a later process with the same id."""
    try:
        return b"ray::" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def resident(pid: int) -> int | None:
    """Return the resident memory of a process, bytes; None if it has ended."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE
    except (OSError, IndexError):
        return None


def report(
    soak: SoakPlan,
    ledger: SoakLedger,
    watcher: SoakWatcher,
    notes: Mapping[int, Sequence[EpisodeTimes]],
    results: Results,
    wanted: Sequence[str],
) -> dict[str, Any]:
    """Return all figures as plain JSON values."""
    episodes = [one for case in results.cases for one in case.episodes]
    attempts = [one for case in results.cases for one in case.attempts]
    at, cpu, window = ledger.at_s, ledger.cpu_s, soak.window
    between = gaps(notes.values())
    return {
        "plan": asdict(soak),
        "episodes_per_minute": 60 * (len(at) - 1) / (at[-1] - at[0]),
        "keys_once": sorted(str(one.result.key) for one in episodes) == list(wanted),
        "done": sum(one.result.status == "done" for one in episodes),
        "killed": len(watcher.killed),
        "retries": sum(one.retried for one in attempts),
        "played_again": sum(map(len, notes.values())) - len(episodes),
        "gap_ms": {"first": _spread(between[:window]), "last": _spread(between[-window:])},
        "driver_cpu_ms": {
            "first": 1e3 * (cpu[window - 1] - cpu[0]) / (window - 1),
            "last": 1e3 * (cpu[-1] - cpu[-window]) / (window - 1),
        },
        "memory": {
            "driver": growth(
                [(one.episodes, one.driver) for one in watcher.samples], soak.episodes
            ),
            "worker": growth(
                [(one.episodes, one.eldest) for one in watcher.samples if one.eldest is not None],
                soak.episodes,
            ),
        },
    }


def gaps(workers: Iterable[Sequence[EpisodeTimes]]) -> list[float]:
    """Return the times between two episodes of a worker, s, in the order in which the later
    episodes began.
    """
    pairs = [pair for notes in workers for pair in itertools.pairwise(notes)]
    return [
        after.begun - before.ended
        for before, after in sorted(pairs, key=lambda pair: pair[1].begun)
    ]


def growth(samples: Sequence[tuple[int, int]], episodes: int) -> dict[str, float] | None:
    """Fit the growth of resident memory in a thousand episodes, MiB, by least squares.

    `samples` are (episodes, bytes). The first fifth, in which pools and caches fill, and samples
    after the last episode, when all results are read, are left out. Returns None if too few are
    left.
    """
    settled = [(done, size) for done, size in samples if _SETTLING * episodes <= done < episodes]
    if len({done for done, _ in settled}) < 2:
        return None
    done, size = zip(*settled, strict=True)
    slope = np.polyfit(np.array(done) / 1000, np.array(size) / _MIB, 1)[0]
    return {
        "begin_mib": settled[0][1] / _MIB,
        "end_mib": settled[-1][1] / _MIB,
        "mib_per_1000": float(slope),
    }


def _spread(gaps_s: Sequence[float]) -> dict[str, float]:
    median, p95 = np.quantile(gaps_s, (0.5, 0.95)) * 1e3
    return {"median": float(median), "p95": float(p95)}


def soak_outcomes(found: Mapping[str, Any]) -> list[Outcome]:
    """Return the targets of `measure_soak`, and whether they are met."""
    episodes, gap, cpu = found["plan"]["episodes"], found["gap_ms"], found["driver_cpu_ms"]
    first, last = gap["first"]["median"], gap["last"]["median"]
    slowdown = cpu["last"] / cpu["first"]
    once = f"{found['done']} done, {'each key once' if found['keys_once'] else 'not each key once'}"
    return [
        Outcome(
            "every episode",
            f"{episodes} done, each key once",
            once,
            found["keys_once"] and found["done"] == episodes,
        ),
        Outcome(
            "between two episodes of a worker, at first",
            f"< {LIMIT_GAP_MS:g} ms",
            f"{first:.2f} ms",
            first < LIMIT_GAP_MS,
        ),
        Outcome(
            "between two episodes of a worker, at last",
            f"< {LIMIT_GAP_MS:g} ms",
            f"{last:.2f} ms",
            last < LIMIT_GAP_MS,
        ),
        Outcome(
            "the same, last over first",
            f"≤ {LIMIT_SLOWDOWN}",
            f"{last / first:.2f}",
            last <= LIMIT_SLOWDOWN * first,
        ),
        Outcome(
            "the driver's CPU time for an episode, last over first",
            f"≤ {LIMIT_SLOWDOWN}",
            f"{slowdown:.2f} ({cpu['first']:.2f} ms at first)",
            slowdown <= LIMIT_SLOWDOWN,
        ),
        *(_growth(f"memory of the {name}", row) for name, row in found["memory"].items()),
    ]


def _growth(what: str, row: Mapping[str, Any] | None) -> Outcome:
    wanted = f"≤ {LIMIT_GROWTH_MIB:g} MiB in 1,000 episodes"
    if row is None:
        return unmeasured(what, wanted)
    seen = f"{row['mib_per_1000']:+.3f} MiB, {row['begin_mib']:.0f} to {row['end_mib']:.0f}"
    return Outcome(what, wanted, seen, row["mib_per_1000"] <= LIMIT_GROWTH_MIB)


def show_soak(found: Mapping[str, Any]) -> None:
    """Print the counts and the targets."""
    out.print(
        f"{found['plan']['episodes']} episodes, {found['episodes_per_minute']:.0f} a minute; "
        f"workers killed: {found['killed']}, retries: {found['retries']}, played again: "
        f"{found['played_again']}",
    )
    show_outcomes(soak_outcomes(found))


def main(
    episodes: Annotated[int, typer.Option(min=100)] = 10_000,
    workers: Annotated[int, typer.Option(min=1)] = 2,
    kill_every: Annotated[
        float, typer.Option(min=0, help="Seconds between two kills of a worker; 0: no kills.")
    ] = 30.0,
    out_file: Out = None,
) -> None:
    """Run many short episodes while workers are killed; check memory, overhead, and that each
    episode is run once.
    """
    with errors():
        found = measure_soak(SoakPlan(episodes, workers, kill_every), progress)
    show_soak(found)
    save(found, out_file)


if __name__ == "__main__":
    typer.run(main)
