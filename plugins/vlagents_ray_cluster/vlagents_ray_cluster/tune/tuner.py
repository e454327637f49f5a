"""Measures variants of a deployment file's settings, and chooses one.

Each variant is measured in its own process. The whole tuning has a time limit.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.evaluate.artifacts.recorder import Trajectory, videos_of
from vlagents_ray.interface import Obs
from vlagents_ray.policies.compilation import Quantization, uses_torch_compile
from vlagents_ray.registry import require
from vlagents_ray.serve.config.deployment import BatchArgs, ServerArgs
from vlagents_ray_cluster.tune.line_process import LineProcess, ProcessFailed, our_environment
from vlagents_ray_cluster.tune.measured_policy import FRAMES, ProcessSettings, save_observations

# Factor by which a variant must be better than the file's own settings to replace them.
_BETTER = 1.05


class GoalMissed(VLAgentsError):
    """No measured settings reach the goal; the message has those that come closest."""


@dataclass(frozen=True, slots=True)
class TuningGoal:
    """The goal of `tune`: many actions per second, or many robots with short round trips."""

    kind: Literal["throughput", "robots"]
    p99_ms: float | None = None  # for robots: limit of the 99th percentile of round trips, ms

    def __post_init__(self) -> None:
        if self.kind == "robots" and self.p99_ms is None:
            raise ConfigError(
                "--for robots: expected --p99-ms, the longest acceptable round trip of your "
                "robots, ms, got none; set it"
            )
        if self.kind == "throughput" and self.p99_ms is not None:
            raise ConfigError("--p99-ms: applies only to --for robots; leave it out")


@dataclass(frozen=True, slots=True)
class Variant:
    """Changes to the settings of the policy in the file; none for the file's own settings."""

    changes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The changes in words, without the batch sizes, which are in a separate column of the
        table.
        """
        words = []
        for key, value in self.changes.items():
            if key != "batch_sizes":
                text = str(value).lower() if isinstance(value, bool) else value
                words.append(f"{key}: {text}")
        return ", ".join(words) or "own settings"


@dataclass(slots=True)
class MeasuredPoint:
    """The figures of a variant with one number of sessions, which equals its batch size.

    A point is measured in several turns, which alternate with those of other points.
    """

    variant: Variant
    sessions: int
    # Largest difference from the actions of the file's own settings, as a share of their range.
    difference: float
    rates: list[float] = field(default_factory=list)  # rate of each turn, actions per second
    trips_ms: list[float] = field(default_factory=list)  # round trips of all turns, ms
    peak_mib: float = 0.0
    took_s: float = 0.0  # duration of the first turn, s

    def add(self, turn: Mapping[str, Any]) -> None:
        """Add the figures of a turn, as the process of the variant returns them."""
        self.rates.append(turn["actions_per_s"])
        self.trips_ms += turn["trips_ms"]
        self.peak_mib = max(self.peak_mib, turn["peak_mib"])

    @property
    def actions_per_s(self) -> float:
        """The median rate of the turns."""
        return statistics.median(self.rates)

    @property
    def round_trip_ms(self) -> float:
        """The median of all round trips."""
        return float(np.median(self.trips_ms))

    @property
    def p99_ms(self) -> float:
        """The 99th percentile of all round trips."""
        return float(np.quantile(self.trips_ms, 0.99))

    def reaches(self, goal: TuningGoal) -> bool:
        """Return whether round trips are short enough for robots, if that is the goal."""
        return goal.p99_ms is None or self.p99_ms <= goal.p99_ms


def sessions(number: int) -> str:
    """Return a number of sessions as text, such as "1 session" or "4 sessions"."""
    return f"{number} session{'s' if number > 1 else ''}"


def choose(points: Sequence[MeasuredPoint], goal: TuningGoal) -> MeasuredPoint:
    """Choose the best point for a goal.

    A variant must be 5 % better than one with fewer changes, or serve more robots.

    Raises:
        GoalMissed: No point reaches the goal.
    """
    reaching = [point for point in points if point.reaches(goal)]
    if not reaching and not points:
        raise GoalMissed("no settings could be measured")
    if not reaching:
        closest = min(points, key=lambda point: point.p99_ms)
        raise GoalMissed(
            f"--p99-ms: expected a p99 of at most {goal.p99_ms} ms, got {closest.p99_ms:.1f} ms "
            f"at best, with {sessions(closest.sessions)} and {closest.variant.name}; raise "
            "--p99-ms, or use a faster machine or model"
        )

    def score(point: MeasuredPoint) -> float:
        return point.actions_per_s if goal.kind == "throughput" else point.sessions

    # The best point of each variant; variants with the fewest changes come first.
    variants = {point.variant.name: point.variant for point in reaching}
    best_points = []
    for variant in sorted(variants.values(), key=lambda variant: len(variant.changes)):
        points_of_variant = [point for point in reaching if point.variant is variant]
        best_points.append(max(points_of_variant, key=score))

    best = best_points[0]
    for point in best_points[1:]:
        if goal.kind == "throughput":
            is_better = point.actions_per_s > _BETTER * best.actions_per_s
        elif point.sessions == best.sessions:
            is_better = point.p99_ms * _BETTER < best.p99_ms
        else:
            is_better = point.sessions > best.sessions
        if is_better:
            best = point
    return best


def default_point(
    points: Sequence[MeasuredPoint], goal: TuningGoal, max_size: int
) -> MeasuredPoint | None:
    """Return the figures of the unchanged file.

    Args:
        points: The measured points.
        goal: The goal.
        max_size: The file's largest batch size.

    Returns:
        The point; None if it was not measured, or misses the goal.
    """
    candidates = []
    for point in points:
        if point.variant.changes or point.sessions > max_size or not point.reaches(goal):
            continue
        if goal.kind == "throughput" and point.sessions != max_size:
            continue
        candidates.append(point)
    return max(candidates, key=lambda point: point.sessions, default=None)


def chosen_settings(
    chosen: MeasuredPoint, batch: BatchArgs, fixed: Sequence[int] | None
) -> dict[str, dict[str, Any]]:
    """Return the settings of a deployment file to change.

    Args:
        chosen: The best point.
        batch: The settings `batch` of the file.
        fixed: The policy's `batch_sizes` in the file or by default, if it has any.

    Returns:
        Section below `args` -> key -> value.
    """
    config: dict[str, Any] = dict(chosen.variant.changes)
    sizes = chosen.variant.changes.get("batch_sizes", fixed)
    if sizes and sizes[-1] > chosen.sessions:
        smaller = [size for size in sizes if size < chosen.sessions]
        config["batch_sizes"] = [*smaller, chosen.sessions]

    queue: dict[str, Any] = {}
    if chosen.sessions != batch.max_size and batch.sizes is not None:
        queue["sizes"] = [size for size in batch.sizes if size <= chosen.sessions]
    elif chosen.sessions != batch.max_size:
        queue["max_size"] = chosen.sessions

    sections = {"config": config, "batch": queue}
    return {section: values for section, values in sections.items() if values}


def figures(points: Sequence[MeasuredPoint]) -> list[list[str]]:
    """Return a table of the measurements, with its header as the first row."""
    rows = [
        [
            "settings",
            "sessions",
            "actions/s",
            "round trip ms",
            "p99 ms",
            "peak MiB",
            "actions off by",
        ]
    ]
    for point in points:
        rows.append(
            [
                point.variant.name,
                str(point.sessions),
                f"{point.actions_per_s:.1f}",
                f"{point.round_trip_ms:.1f}",
                f"{point.p99_ms:.1f}",
                f"{point.peak_mib:.0f}",
                f"{point.difference:.3%}",
            ]
        )
    return rows


# Factor by which the last two batch sizes must raise the rate before a larger one is measured.
_RISING = 1.05
_TURNS = 3  # number of turns of each point
_END_S = 2.0  # time for a process to end before it is killed, s
# The minimum range of a value of the action, as a share of its largest magnitude, since a value may
# be nearly constant.
_SMALLEST_RANGE = 0.1


class VariantFailed(VLAgentsError):
    """A variant could not be loaded or measured; the message has the reason."""


@dataclass(frozen=True, slots=True)
class TunePlan:
    """The settings of `Tuner`."""

    args: ServerArgs  # the `args` of a deployment file
    goal: TuningGoal
    max_batch: int = 32
    minutes: float = 5.0  # time limit of the whole tuning, minutes
    seconds: float = 2.0  # duration of each measurement, s
    tolerance: float = 0.01  # largest difference of actions, as a share of their range
    # Types to try; None selects those that the device computes natively.
    dtypes: Sequence[str] | None = None
    # Folder of recorded trajectories; None selects random observations.
    frames: Path | None = None
    side: int = 224  # size of random images if the policy accepts any size, px
    # Sizes by name in the state, where the contract defines none.
    dims: Mapping[str, int] = field(default_factory=dict)


class Tuner:
    """Measures the variants of a plan; `left_out` has a sentence for each skipped variant."""

    def __init__(
        self,
        plan: TunePlan,
        progress: Callable[[str], None] = lambda _: None,
        began: float | None = None,
    ) -> None:
        """Set the plan; nothing is measured yet.

        Args:
            plan: The settings.
            progress: Is called with each message about the progress.
            began: The time from which the plan's minutes count, `time.monotonic()`; None selects
                now.
        """
        self.left_out: list[str] = []
        self.device = ""
        # `batch_sizes` of the policy with the file's own settings, explicit or by default.
        self.fixed: Sequence[int] | None = None
        self._plan, self._progress = plan, progress
        began = time.monotonic() if began is None else began
        self._end = began + plan.minutes * 60
        self._expected: list[np.ndarray] = []  # actions with the file's own settings
        self._points: list[MeasuredPoint] = []
        self._failed: list[Variant] = []

    def measure(self) -> list[MeasuredPoint]:
        """Measure the file's own settings, then each variant."""
        with tempfile.TemporaryDirectory() as folder:
            frames = None
            if self._plan.frames is not None:
                frames = Path(folder) / "frames"
                save_observations(recorded_observations(self._plan.frames, FRAMES), frames)

            ready = self._measure_own(frames)
            rates = {point.sessions: point.actions_per_s for point in self._points}
            if self._plan.goal.kind == "throughput":
                largest_size = max(rates, key=rates.__getitem__)
            else:
                largest_size = max(rates)

            variants = self._variants(ready, sorted(size for size in rates if size <= largest_size))
            for number, variant in enumerate(variants):
                changes = variant.changes.items()
                if any(failed.changes.items() <= changes for failed in self._failed):
                    continue
                if time.monotonic() >= self._end:
                    self.left_out.append(f"{variant.name}: no time was left")
                    continue
                sizes = (
                    self._plan.args.batch.sizes
                    or variant.changes.get("batch_sizes")
                    or self._candidates()
                )
                try:
                    with self._loaded(variant, frames) as (process, ready):
                        uncompiled = ready["uncompiled"]
                        for reason in uncompiled:
                            self.left_out.append(f"{variant.name}: not compiled: {reason}")
                        if variant.changes.get("compile") and len(uncompiled) == len(sizes):
                            raise VariantFailed("no size could be compiled")
                        remaining = len(variants) - number
                        self._sweep(process, variant, sizes, remaining)
                except VariantFailed as error:
                    self._failed.append(variant)
                    self.left_out.append(f"{variant.name}: {error}")
        return self._points

    def _measure_own(self, frames: Path | None) -> Mapping[str, Any]:
        """Measure the file's own settings; return the report of their process."""
        unchanged, ready = Variant(), None
        try:
            with self._loaded(unchanged, frames) as (process, ready):
                self.device, self.fixed = ready["device"], ready["settings"].get("batch_sizes")
                if self._plan.dtypes and "dtype" not in ready["settings"]:
                    raise ConfigError(
                        "--dtypes: expected a policy with the setting `dtype`, got "
                        f"{self._plan.args.policy!r}; leave it out"
                    )
                sizes = self._candidates()
                self._expected = self._actions(process, sizes[0])[:FRAMES]
                remaining = len(self._variants(ready, ())) + 1
                self._sweep(process, unchanged, sizes, remaining)
        except VariantFailed as error:
            if ready is None or not self._points:
                raise VariantFailed(f"the file's own settings: {error}") from error
            self.left_out.append(f"{unchanged.name}: {error}")
        return ready

    def _candidates(self) -> list[int]:
        """Return the batch sizes to measure, ascending: the fixed ones, or 1, 2, 4, … if none are.

        Raises:
            ConfigError: All fixed sizes are above `max_batch`.
        """
        fixed = self._plan.args.batch.sizes or self.fixed
        sizes = fixed or [2**power for power in range(self._plan.max_batch.bit_length())]
        candidates = [size for size in sizes if size <= self._plan.max_batch]
        if not candidates:
            raise ConfigError(
                f"--max-batch: expected at least {sizes[0]}, the file's smallest fixed size, got "
                f"{self._plan.max_batch}; raise it"
            )
        return candidates

    def _variants(self, ready: Mapping[str, Any], sizes: Sequence[int]) -> list[Variant]:
        """Return the variants other than the file's own settings.

        Args:
            ready: The report of the process with the file's own settings.
            sizes: The batch sizes of compiled variants, if the file does not fix them.
        """
        settings = ready["settings"]

        names = ready["dtypes"] if self._plan.dtypes is None else self._plan.dtypes
        dtypes: list[dict[str, Any]] = []
        for name in names:
            setting = "quantization" if name in get_args(Quantization) else "dtype"
            if setting in settings and settings[setting] != name:
                dtypes.append({setting: name})

        current_mode = settings.get("compile", True)  # the mode that "auto" selects
        modes: list[Any] = []
        if not uses_torch_compile(current_mode):
            modes = [mode for mode in ready["modes"] if mode != current_mode]

        is_free = "batch_sizes" in settings and self._plan.args.config.get("batch_sizes") is None
        compiled: list[dict[str, Any]] = []
        for mode in modes:
            changes: dict[str, Any] = {"compile": mode}
            if mode and is_free:
                changes["batch_sizes"] = list(sizes)
            compiled.append(changes)

        both: list[dict[str, Any]] = []
        for compile_changes in compiled:
            both += [dtype_changes | compile_changes for dtype_changes in dtypes]
        return [Variant(changes) for changes in [*dtypes, *compiled, *both]]

    @contextmanager
    def _loaded(
        self, variant: Variant, frames: Path | None
    ) -> Iterator[tuple[LineProcess, Mapping[str, Any]]]:
        """Yield the process of a loaded variant, and its report."""
        args, environment = self._plan.args, self._plan.args.environment
        if args.batch.sizes:
            max_size = args.batch.sizes[-1]
        else:
            max_size = max(self._plan.max_batch, args.batch.max_size)

        settings = ProcessSettings(
            policy=args.policy,
            config=args.config | dict(variant.changes),
            wrappers=args.wrappers,
            max_size=max_size,
            patience=args.batch.patience,
            batch_sizes=args.batch.sizes or (),
            frames=None if frames is None else str(frames),
            side=self._plan.side,
            dims=self._plan.dims,
        )

        variables = our_environment() if environment.python is None else {}
        variables = variables | environment.env_vars
        command = [
            environment.python or sys.executable,
            "-m",
            "vlagents_ray_cluster.tune.measured_policy",
        ]
        with LineProcess("tune", command, variables, end_s=_END_S) as process:
            process.send(json.dumps(asdict(settings)))
            report = self._answer(process)
            while "step" in report:
                self._progress(f"{variant.name}: {report['step']}")
                report = self._answer(process)

            load_s, device = report["load_s"], report["device"]
            self._progress(f"{variant.name}: loaded in {load_s:.1f} s on {device}")
            yield process, report

    def _sweep(
        self, process: LineProcess, variant: Variant, sizes: Sequence[int], remaining: int
    ) -> None:
        """Measure a loaded variant with growing batches while the rate rises.

        The points are then measured in further turns, as time permits.

        Args:
            process: The process of the variant.
            variant: The variant.
            sizes: The batch sizes, ascending.
            remaining: The number of variants, with this one, that share the remaining time.
        """
        now = time.monotonic()
        until = now + (self._end - now) / remaining
        points: list[MeasuredPoint] = []
        for size in sizes:
            if not self._worth_more(points):
                break
            if not self._add(process, variant, size, points, until):
                break

        default = self._plan.args.batch.max_size
        is_measured = default in [point.sessions for point in points]
        if self._plan.goal.kind == "throughput" and not variant.changes and not is_measured:
            self._add(process, variant, default, points, (time.monotonic() + self._end) / 2)

        turn_s = sum(point.took_s for point in points)
        for _ in range(_TURNS - 1):
            if time.monotonic() + turn_s > until:
                break
            for point in points:
                point.add(self._turn(process, point.sessions))

    def _worth_more(self, points: Sequence[MeasuredPoint]) -> bool:
        """Return whether a larger batch may reach the goal better than the measured ones.

        Args:
            points: The measured points of a variant, by ascending batch size.
        """
        if points and self._plan.goal.p99_ms is not None:
            return points[-1].round_trip_ms <= self._plan.goal.p99_ms

        rates = [point.rates[0] for point in points]
        # One measurement may have been disturbed.
        return len(rates) < 3 or max(rates[-2:]) >= _RISING * max(rates[:-2])

    def _add(
        self,
        process: LineProcess,
        variant: Variant,
        size: int,
        points: list[MeasuredPoint],
        until: float,
    ) -> bool:
        """Check the actions of a batch size, and measure it once.

        Args:
            process: The process of the variant.
            variant: The variant.
            size: The batch size.
            points: The points of the variant, to which the new one is added.
            until: The time by which the measurement should end, `time.monotonic()`.

        Returns:
            Whether it was measured. If not, `left_out` has the reason.

        Raises:
            VariantFailed: The variant differs from the file's own settings, or its first size
                failed.
        """
        began = time.monotonic()
        if points and began + points[-1].took_s * size / points[-1].sessions > until:
            self.left_out.append(f"{variant.name}, {sessions(size)}: no time was left")
            return False

        try:
            difference = largest_difference(self._actions(process, size), self._expected)
            if difference > self._plan.tolerance:
                off = (
                    f"actions differ by {difference:.2%} of their range, expected at most "
                    f"{self._plan.tolerance:.2%}"
                )
                if variant.changes or points:
                    raise VariantFailed(f"rejected, as {off}")
                raise VariantFailed(
                    f"{off}, for the same observations and seeds, so the actions of variants "
                    f"cannot be compared with them; let the seed of `reset` determine what is "
                    f"random in the policy, or "
                    "raise --tolerance"
                )

            point = MeasuredPoint(variant, size, difference)
            point.add(self._turn(process, size))
        except VariantFailed as error:
            if not points:
                raise
            self.left_out.append(f"{variant.name}, {sessions(size)}: {error}")
            return False

        point.took_s = time.monotonic() - began
        points.append(point)
        self._points.append(point)
        self._progress(f"{variant.name}, {sessions(size)}: {point.rates[0]:.1f} actions/s")
        return True

    def _actions(self, process: LineProcess, size: int) -> list[np.ndarray]:
        """Return the first actions of some episodes, computed in batches of `size`."""
        process.send(json.dumps({"act": size}))
        return [np.array(action, np.float64) for action in self._answer(process)["actions"]]

    def _turn(self, process: LineProcess, number: int) -> dict[str, Any]:
        """Measure a number of sessions once."""
        request = {
            "measure": number,
            "seconds": self._plan.seconds,
            "priority": "robot" if self._plan.goal.kind == "robots" else "simulation",
        }
        process.send(json.dumps(request))
        return self._answer(process)

    def _answer(self, process: LineProcess) -> dict[str, Any]:
        """Return the next answer of a process.

        Raises:
            VariantFailed: The answer is an error, the process has ended, or the time is over.
        """
        try:
            answer: dict[str, Any] = process.read(max(0.0, self._end - time.monotonic()))
        except ProcessFailed as error:
            if time.monotonic() >= self._end:
                raise VariantFailed(
                    f"not done within {self._plan.minutes:g} minutes; raise --minutes"
                ) from error
            first, *more = str(error).partition(": ")[2].splitlines()
            raise VariantFailed(". ".join([first, *more[-1:]])) from error

        if "failed" in answer:
            raise VariantFailed(answer["failed"])
        return answer


def largest_difference(actions: Sequence[np.ndarray], expected: Sequence[np.ndarray]) -> float:
    """Return the largest difference of two lists of actions, as a share of their range.

    Each of the D values of an action has its own range: the largest minus the smallest value among
    all rows of `expected`, or a tenth of the largest magnitude if that is more.

    Args:
        actions: Each (D,) or (H, D). The action at i is compared with
            `expected[i % len(expected)]`.
        expected: Each (D,) or (H, D).

    Returns:
        The difference; infinity if shapes differ, or if a value is not finite.
    """
    rows = np.concatenate([np.atleast_2d(action) for action in expected]).astype(np.float64)
    span = np.maximum(np.ptp(rows, axis=0), _SMALLEST_RANGE * np.abs(rows).max(axis=0))
    largest = 0.0
    for i, action in enumerate(actions):
        expected_action = np.asarray(expected[i % len(expected)], np.float64)
        if np.shape(action) != expected_action.shape or not np.isfinite(action).all():
            return float("inf")
        difference = np.abs(action - expected_action)
        # Any difference of a value whose range is 0 is infinite.
        shares = np.divide(
            difference, span, out=np.where(difference > 0, np.inf, 0.0), where=span > 0
        )
        largest = max(largest, float(shares.max(initial=0.0)))
    return largest


def recorded_observations(folder: Path, count: int) -> list[Obs]:
    """Read observations from the trajectories below a folder.

    The observations are spread evenly over the trajectories and over the steps of each trajectory.

    Args:
        folder: A folder of trajectories, as evaluations save them.
        count: The number of observations.

    Raises:
        ConfigError: There is no trajectory, or a video cannot be read.
    """
    files = sorted(folder.rglob("*.npz"))
    if not files:
        raise ConfigError(
            f"--frames {folder}: expected a folder of trajectories (.npz), as evaluations save, "
            "got none"
        )

    used = files[:: max(1, len(files) // count)][:count]
    observations: list[Obs] = []
    for number, file in enumerate(used):
        trajectory = Trajectory.load(file)
        share = len(range(number, count, len(used)))  # observations of this trajectory
        steps = np.linspace(0, len(trajectory.actions), share, dtype=int).tolist()
        images = {}
        for camera, video in videos_of(file, trajectory.cameras).items():
            images[camera] = _images(video, steps)

        for step in steps:
            cameras = {camera: images[camera][step] for camera in trajectory.cameras}
            gripper = None if trajectory.gripper is None else float(trajectory.gripper[step])
            state = {name: values[step] for name, values in trajectory.state.items()}
            observations.append(Obs(cameras=cameras, gripper=gripper, state=state))
    return observations


def _images(video: Path, steps: list[int]) -> dict[int, np.ndarray]:
    """Return the images of these steps, (H, W, 3) uint8 RGB."""
    av = require("av")
    images: dict[int, np.ndarray] = {}
    try:
        with av.open(str(video)) as container:
            for number, frame in enumerate(container.decode(video=0)):
                if number in steps:
                    images[number] = frame.to_ndarray(format="rgb24")
    except (OSError, ValueError) as error:  # PyAV raises these types of errors for broken files
        raise ConfigError(f"--frames: {video} cannot be read ({error})") from error

    missing = sorted(set(steps) - set(images))
    if missing:
        raise ConfigError(
            f"--frames: {video}: expected the frames of its trajectory, got none of {missing}"
        )
    return images
