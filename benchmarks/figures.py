"""Statistics of measurements: medians, intervals and ratios that assume no distribution."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

RESAMPLES = 2000


@dataclass(frozen=True, slots=True)
class RoundTrips:
    """Milliseconds of each call of one client, by round."""

    name: str
    rounds: np.ndarray  # (rounds, calls per round) float64, ms

    @property
    def ms(self) -> np.ndarray:
        """The times of all calls, (N,) float64, ms."""
        return self.rounds.reshape(-1)

    @property
    def median(self) -> float:
        return float(np.median(self.ms))

    def to_json(self) -> dict[str, Any]:
        return {
            "way": self.name,
            "calls": len(self.ms),
            "median_ms": self.median,
            "ci95_ms": list(median_interval(self.ms)),
            "p99_ms": float(np.quantile(self.ms, 0.99)),
        }


class Ratio(NamedTuple):
    """The ratio of two medians, with its 95 % bootstrap interval."""

    ratio: float
    low: float
    high: float


def median_interval(values: np.ndarray) -> tuple[float, float]:
    """Return the 95 % confidence interval of the median, from order statistics: only
    independence is assumed.
    """
    ordered = np.sort(values)
    n = len(ordered)
    half = 0.98 * np.sqrt(n)  # 1.96 standard deviations of a binomial with p = 1/2
    low, high = int(max(0, np.floor(n / 2 - half))), int(min(n - 1, np.ceil(n / 2 + half)))
    return float(ordered[low]), float(ordered[high])


# The 0.975 quantiles of Student's t distribution for 1, 2, … degrees of freedom.
_T = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262)


def mean_interval(rounds: Sequence[float]) -> tuple[float, float] | None:
    """Return the 95 % interval of the mean of 2 to 10 rounds with Student's t; None for a single
    round.
    """
    n = len(rounds)
    if n < 2:
        return None
    half = _T[min(n - 2, len(_T) - 1)] * float(np.std(rounds, ddof=1)) / n**0.5
    return float(np.mean(rounds)) - half, float(np.mean(rounds)) + half


def median_ratio(ours: RoundTrips, theirs: RoundTrips, *, seed: int = 0) -> Ratio:
    """Return the ratio of the two medians.

    The bootstrap draws whole rounds, and the same rounds for both, because calls of one round, and
    adjacent rounds, share the machine's other load. Raises `ValueError` unless both have the same
    number of rounds.
    """
    if len(ours.rounds) != len(theirs.rounds):
        raise ValueError(
            f"rounds: got {len(ours.rounds)} and {len(theirs.rounds)}; measure both in one run"
        )
    n = len(ours.rounds)
    drawn = np.random.default_rng(seed).integers(0, n, (RESAMPLES, n))
    medians = [
        np.median(trips.rounds[drawn].reshape(RESAMPLES, -1), axis=1) for trips in (ours, theirs)
    ]
    low, high = np.quantile(medians[0] / medians[1], [0.025, 0.975])
    return Ratio(ours.median / theirs.median, float(low), float(high))


def ratios(ours: Sequence[RoundTrips], theirs: Sequence[RoundTrips]) -> dict[str, dict[str, Any]]:
    """Return the ratio of each of our clients to each other client, as JSON: {ours: {theirs:
    ratio}}.
    """
    found = {a.name: {b.name: median_ratio(a, b) for b in theirs} for a in ours}
    return {
        a: {b: {"ratio": one.ratio, "ci95": [one.low, one.high]} for b, one in row.items()}
        for a, row in found.items()
    }


def lost_db(images: Mapping[str, np.ndarray], sent: Mapping[str, np.ndarray]) -> float | None:
    """Return the peak signal-to-noise ratio of all images relative to the `sent` images, dB; None
    if they are equal.
    """
    squares = [(images[name].astype(np.float64) - sent[name]) ** 2 for name in sent]
    error = float(np.mean([np.mean(one) for one in squares]))
    return None if error == 0 else float(10 * np.log10(255**2 / error))


PACKAGES = ("vlagents-ray", "ray", "numpy", "torch", "jax", "transformers", "lerobot")


def measured_on(program: str) -> dict[str, Any]:
    """Return date, command, machine and versions as JSON values; call this before measuring, as the
    values include the machine's load.
    """
    return {
        "date": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
        "command": " ".join([program, shlex.join(sys.argv[1:])]).rstrip(),
        "machine": _machine(),
        "versions": _versions() | {"Python": platform.python_version()},
    }


def _versions() -> dict[str, str]:
    installed = {one.metadata["Name"]: one.version for one in importlib.metadata.distributions()}
    return {name: installed[name] for name in PACKAGES if name in installed}


def _machine() -> dict[str, Any]:
    """Return the machine's description, without host or user names."""
    cpu = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            cpu = line.partition(":")[2].strip()
            break
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "memory_gb": round(memory / 2**30),
        "kernel": platform.release().partition("-")[0],
        "load": os.getloadavg()[0],
    }
