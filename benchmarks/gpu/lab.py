"""The tools of the steps: sizes, criteria, policies, and robots on threads."""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import Self

from benchmarks.measured_policy import MeasuredPolicy
from benchmarks.photographs import with_photographs
from vlagents_ray.contract import Contract
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.interface import Obs
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.protocol.messages import PRIORITIES, Reply, Request
from vlagents_ray.registry import require
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.requests import AwaitedReplies, IncomingMessage, PendingRequest
from vlagents_ray.testing import random_observation

CAMERAS = {"base_0_rgb": "front", "left_wrist_0_rgb": "wrist", "right_wrist_0_rgb": "right_wrist"}
INSTRUCTION = "pick up the cube"
# Time of a run, s. Two runs fit into a quarter of an hour, the time for which machines are lent.
SECONDS = 430.0
LATE_S = 120.0
PUBLISHED = (  # figures that others have published, for comparison
    (
        "π0.5 on an H100, 3 cameras, in process: 52.4, 65.1, 91.9, 147.4 ms for 1, 2, 4, 8 rows "
        "(SGLang 0.5.23)"
    ),
    "the same, by WebSocket: 77 ms for 1 robot, 162 ms for 4 (SGLang 0.5.23)",
    (
        "π0 on an RTX 4090, 2 cameras: 40 to 50 ms in CUDA graphs, 27.3 ms with own kernels (arXiv "
        "2510.26742)"
    ),
)
# For `lines_of`: time between two samples, s, and maximum number of lines that are shown.
_LOOK_S, _LINES = 0.1, 25


@dataclass(frozen=True, slots=True)
class Plan:
    """The settings of a run."""

    out: Path
    # Folder for checkpoints, compiled programs, and files that steps leave for later steps.
    scratch: Path
    dry: bool = False
    seconds: float = SECONDS  # time for all steps together, s
    rows: tuple[int, ...] = (1, 8)  # batch sizes that are compiled
    commit: str = ""  # commit of the code, if the checkout does not contain it
    patience: float = 1.0  # factor of the time limits of steps

    def checkpoint(self, family: str) -> dict[str, Any]:
        """Return the settings of a policy with the family's random checkpoint, which the step
        "checkpoint" wrote.
        """
        found: dict[str, Any] = json.loads((self.scratch / f"{family}.json").read_text())
        return found


@dataclass(frozen=True, slots=True)
class Step:
    """A step, and its time limit, s."""

    run: Callable[[Lab], None]
    limit_s: float
    beside: str = ""  # name of the step that may run at the same time


class Lab:
    """The settings and results of a step; each result is written immediately, as the step may
    crash.
    """

    def __init__(self, plan: Plan, step: str) -> None:
        self.plan, self.dry, self._file = plan, plan.dry, plan.scratch / f"step-{step}.json"
        self.found: dict[str, Any] = {"figures": {}, "checks": []}
        self._lock = threading.Lock()

    def show(self, **figures: Any) -> None:
        """Write figures: numbers, texts, lists of texts, or lists of rows, which become a table."""
        with self._lock:
            self.found["figures"] |= figures
            self._file.write_text(json.dumps(self.found, default=float))

    @contextlib.contextmanager
    def lines_of(self, thread: str | tuple[str, ...], title: str) -> Iterator[None]:
        """Show, also while the context is active, the lines of the package in which each thread
        spends its time.
        """
        seen, over = Counter[str](), threading.Event()

        def look() -> None:
            begun = time.perf_counter()
            while not over.wait(_LOOK_S):
                now, frames = time.perf_counter(), sys._current_frames()
                idents = [
                    one.ident or 0 for one in threading.enumerate() if one.name.startswith(thread)
                ]
                stack = [
                    frame
                    for ident in idents
                    for frame, _ in traceback.walk_stack(frames.get(ident))
                ]
                lines = {(Path(one.f_code.co_filename), one.f_lineno) for one in stack}
                for path, line in lines:
                    if "vlagents_ray" in path.parts:
                        seen[f"{path.name}:{line}"] += round((now - begun) * 1e3)
                self.show(
                    **{
                        title: [
                            f"{ms / 1e3:.1f} s at {line}" for line, ms in seen.most_common(_LINES)
                        ]
                    }
                )
                begun = now

        watch = threading.Thread(target=look, daemon=True)
        watch.start()
        try:
            yield
        finally:
            over.set()
            watch.join()

    def check(self, name: str, got: Any, *, least: float | None = None, most: float | None = None,
              equal: Any = None, speed: bool = False) -> None:  # fmt: skip
        """Write a criterion; a criterion of `speed` is not judged in a dry run."""
        if least is not None:
            want, passed = f"at least {least:g}", got >= least
        elif most is not None:
            want, passed = f"at most {most:g}", got <= most
        else:
            want, passed = f"{equal}", got == equal
        judged = None if speed and self.dry else bool(passed)
        self.found["checks"].append({"name": name, "got": got, "want": want, "passed": judged})
        self.show()

    def size(self, full: Any, dry: Any) -> Any:
        """Return the size of this run."""
        return dry if self.dry else full

    @property
    def device(self) -> str:
        return self.size("cuda", "cpu")  # type: ignore[no-any-return]

    @property
    def graphs(self) -> bool | str:
        """The mode with CUDA graphs of eager cores. A CPU has no graphs, and uses the compiler that
        the runner sets.
        """
        return self.size("graphs", True)  # type: ignore[no-any-return]

    def settings(self, **changed: Any) -> dict[str, Any]:
        """Return the settings of π0 with three cameras, in bfloat16."""
        return {**self.plan.checkpoint("pi0"), "cameras": CAMERAS, "device": self.device, **changed}

    def measured(
        self, policy: str = "pi0", config: Mapping[str, Any] | None = None, *, largest: int
    ) -> MeasuredPolicy:
        """Return a policy that is loaded when its context is entered."""
        config = self.settings(max_rows=largest) if config is None else config
        return MeasuredPolicy(build_agent(policy, config), view, max_size=largest, patience=0.1)

    @contextlib.contextmanager
    def engine(self, **changed: Any) -> Iterator[Engine]:
        """Yield an engine with π0, in CUDA graphs for one and eight rows; a dry run compiles it for
        two rows only.
        """
        rows = self.size(8, 2)
        # On a CPU, tracing the programs for a size takes longer than everything else in a step.
        batch_sizes = self.size([1, rows], [rows])
        config = self.settings(**{"compile": self.graphs, "batch_sizes": batch_sizes, **changed})
        settings = EngineSettings(max_batch_size=rows, patience=0.1)
        engine = Engine(build_agent("pi0", config), settings)
        try:
            with self.lines_of("policy", "start"):
                engine.start()
            yield engine
        finally:
            engine.close()


def view(contract: Contract | None, seed: int) -> Obs:
    """Return an observation that fits the contract, with photographs."""
    obs = random_observation(contract, seed, image_size=224)
    return with_photographs(obs, seed)


class Session:
    """A session of an engine in this process."""

    def __init__(self, engine: Engine, seed: int, **options: Any) -> None:
        self._engine, self._name = engine, f"robot-{seed}"
        self._view = view(engine.contract, seed)
        self.ask("reset", instruction=INSTRUCTION, kwargs={"seed": seed, **options})

    def ask(self, op: Any = "act", **given: Any) -> Reply:
        """Make a request and wait for its reply; raises its error."""
        message, awaited = IncomingMessage("lab"), AwaitedReplies()
        message.expect(1, awaited)
        request = Request(op, self._view, priority="robot", **given)
        self._engine.intake.submit(
            [PendingRequest(self._name, request, message, PRIORITIES["robot"])]
        )
        [reply] = awaited.replies.result(timeout=LATE_S)
        if reply.error is not None:
            raise reply.error
        return reply


class Acting:
    """Robots that act one call after another, each on a thread, within this context."""

    def __init__(self, acts: Sequence[Callable[[], object]]) -> None:
        # End, duration in ms, and error of each call.
        self._calls: list[tuple[float, float, str]] = []
        self._over = threading.Event()
        self._acting = threading.Event()  # cleared while the robots pause
        self._acting.set()
        self._threads = [
            threading.Thread(target=self._act, args=[act], daemon=True) for act in acts
        ]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._over.set()
        self._acting.set()
        for thread in self._threads:
            thread.join(LATE_S)

    def pause(self) -> None:
        """Begin no more calls until `resume`."""
        self._acting.clear()

    def resume(self) -> None:
        """Continue after `pause`."""
        self._acting.set()

    def during(self, action: Callable[[], object], least: int = 1) -> dict[str, Any]:
        """Run a function and wait for at least this number of calls; return the figures of the
        calls that ended in that time.
        """
        begun, before = time.perf_counter(), len(self._calls)
        action()
        took_s, ends = time.perf_counter() - begun, time.perf_counter() + LATE_S
        while len(self._calls) < before + least and time.perf_counter() < ends:
            self._over.wait(0.01)
        calls = self._calls[before:]
        times, errors = (
            [ms for _, ms, _ in calls],
            sorted({error for _, _, error in calls if error}),
        )
        if not calls:
            raise TimeoutError(f"no act ended within {LATE_S:g} s")
        return {
            "seconds": took_s,
            "acts": len(calls),
            "failed": sum(bool(error) for _, _, error in calls),
            "acts_per_s": len(calls) / (time.perf_counter() - begun),
            "median_ms": float(np.median(times)),
            "p99_ms": float(np.quantile(times, 0.99)),
            "worst_ms": max(times),
            "errors": "; ".join(errors)[:300],
        }

    def _act(self, act: Callable[[], object]) -> None:
        while self._acting.wait() and not self._over.is_set():
            begun, error = time.perf_counter(), ""
            try:
                act()
            except VLAgentsError as failure:
                error = f"{type(failure).__name__}: {failure}"
            end = time.perf_counter()
            self._calls.append((end, (end - begun) * 1e3, error))


def seconds_of(lab: Lab, work: Callable[[], object], times: int = 10) -> float:
    """Return the mean time of some work on the device, s, after a warm-up call."""
    torch = require("torch")
    wait = (lambda: None) if lab.dry else torch.cuda.synchronize
    work(), wait()
    begun = time.perf_counter()
    for _ in range(times):
        work()
    wait()
    return (time.perf_counter() - begun) / times


def row_error(got: np.ndarray, want: np.ndarray) -> float:
    """Return the largest error of a row (…, D), relative to the largest norm of a row."""
    return float(np.linalg.norm(got - want, axis=-1).max() / np.linalg.norm(want, axis=-1).max())
