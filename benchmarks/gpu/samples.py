"""Samples the power, clock and temperature of a GPU with nvidia-smi."""

from __future__ import annotations

import shutil
import statistics
import subprocess
import threading
from dataclasses import dataclass, field
from typing import Any

from typing_extensions import Self

NO_GPU = "no GPU"  # replaces the name of a card
_PERIOD_MS = 100
_FIELDS = ("power.draw", "clocks.sm", "temperature.gpu", "clocks_event_reasons.active")
# Bits of the reasons for which the clock of a GPU is limited, other than idleness:
# https://docs.nvidia.com/deploy/nvml-api/group__nvmlClocksEventReasons.html
_LIMITS = {
    0x4: "power cap",
    0x8: "hardware slowdown",
    0x20: "thermal, by software",
    0x40: "thermal, by hardware",
    0x80: "power brake",
}


def card() -> str:
    """Return the name, driver, memory, power limit and highest clock of the first GPU; "no GPU"
    without nvidia-smi.
    """
    program = shutil.which("nvidia-smi")
    if program is None:
        return NO_GPU
    fields = "name,driver_version,memory.total,power.limit,clocks.max.sm"
    command = [program, "-i", "0", f"--query-gpu={fields}", "--format=csv,noheader"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    values = [value.strip() for value in answer.split(",")]
    if len(values) != len(fields.split(",")):
        return NO_GPU
    name, driver, memory, watts, clock = values
    return f"{name}, driver {driver}, {memory}, at most {watts} and {clock}"


@dataclass
class GpuSamples:
    """Samples of the first GPU within this context; there are none on a machine without
    nvidia-smi.
    """

    watts: list[float] = field(default_factory=list)
    clocks_mhz: list[float] = field(default_factory=list)
    celsius: list[float] = field(default_factory=list)
    # Names of the reasons for which the clock was limited.
    limits: set[str] = field(default_factory=set)

    def __enter__(self) -> Self:
        program = shutil.which("nvidia-smi")
        self._process: subprocess.Popen[str] | None = None
        if program is None:
            return self
        query = f"--query-gpu={','.join(_FIELDS)}"
        command = [program, "-i", "0", query, "--format=csv,noheader,nounits"]
        # Without this, a program writes to a pipe in blocks.
        by_line = ["stdbuf", "-oL"] if shutil.which("stdbuf") else []
        self._process = subprocess.Popen(
            [*by_line, *command, "-lms", str(_PERIOD_MS)], stdout=subprocess.PIPE, text=True
        )
        self._reader = threading.Thread(target=self._read, args=[self._process], daemon=True)
        self._reader.start()
        return self

    def __exit__(self, *exc: object) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait()
            self._reader.join()

    def _read(self, process: subprocess.Popen[str]) -> None:
        if process.stdout is not None:
            with process.stdout as lines:
                for line in lines:
                    self.add(line)

    def forget(self) -> None:
        """Drop the samples so far, which may be from before the load."""
        for samples in (self.watts, self.clocks_mhz, self.celsius, self.limits):
            samples.clear()

    def add(self, line: str) -> None:
        """Add a line of nvidia-smi; values that the GPU does not report are left out."""
        values = [value.strip() for value in line.split(",")]
        if len(values) != len(_FIELDS):
            return
        for samples, value in zip(
            (self.watts, self.clocks_mhz, self.celsius), values[:-1], strict=True
        ):
            if value.replace(".", "", 1).isdigit():
                samples.append(float(value))
        if values[-1].startswith("0x"):
            reasons = int(values[-1], 16)
            self.limits.update(name for bit, name in _LIMITS.items() if reasons & bit)

    def figures(self, acts_per_s: float) -> dict[str, Any]:
        """Return the figures of `summary`, and the energy of an action; return nothing without
        samples.

        Args:
            acts_per_s: Actions per second while the samples were taken.
        """
        summary = self.summary()
        if not summary:
            return {}
        return {**summary, "joules_an_act": summary["watts"] / max(acts_per_s, 1e-9)}

    def summary(self) -> dict[str, Any]:
        """Return the mean power, the median clock, the highest temperature, and the reasons that
        limited the clock; return nothing without samples.
        """
        if not (self.watts and self.clocks_mhz and self.celsius):
            return {}
        return {
            "watts": statistics.mean(self.watts),
            "clock_mhz": statistics.median(self.clocks_mhz),
            "celsius": max(self.celsius),
            "clock_limited_by": ", ".join(sorted(self.limits)) or "nothing",
        }
