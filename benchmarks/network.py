"""Measures the time of a policy's network alone, and profiles one inference call on a GPU."""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.registry import require

Span = tuple[float, float, str]  # begin and end, µs, and name of each kernel

_SHOWN = 5  # maximum number of gaps that are shown
_CORE = "core "  # prefix of the names of the profiler's records of cores
_NAME_CHARACTERS = 90  # maximum number of characters of a kernel's name
# Part of torch's warning about a synchronization; warnings about the debug mode itself have other
# words.
_WAIT = "called a synchronizing CUDA operation"


class NetworkTimer:
    """Times the cores of policies: with events of CUDA on a GPU, by the clock on a CPU.

    Code outside the cores does not count: images, tokens, copies to the device, results.
    """

    def __init__(self) -> None:
        self._spans: list[tuple[Any, Any]] | None = None  # None unless `measure` is running
        self._names: set[str] = set()  # names of the cores, if they are recorded
        self._is_annotating = False  # whether `kernels` is running
        self._inside = False  # whether a core is running, as a core may call another

    @contextmanager
    def loading(self) -> Iterator[None]:
        """Time the cores of each policy that is loaded within this context."""
        mark = Compilation.core

        def core(
            compilation: Compilation,
            name: str,
            function: Any,
            rows: int | None = None,
            parts: Sequence[Any] = (),
            *,
            by_regions: bool = False,
        ) -> Callable[..., Any]:
            cores = [getattr(part, "untimed", part) for part in parts]
            self._names.add(name)
            made = mark(compilation, name, function, rows, cores, by_regions=by_regions)
            return self._timed(name, made)

        Compilation.core = core  # type: ignore[method-assign, assignment]
        try:
            yield
        finally:
            Compilation.core = mark  # type: ignore[method-assign]

    def measure(self, act: Callable[[], object]) -> float | None:
        """Run a call that waits for its result; return the time of the policy's cores, ms, or None
        if it has none.
        """
        self._spans = []
        try:
            act()
            took = [(end - begin) * 1e3 if isinstance(end, float) else begin.elapsed_time(end)
                    for begin, end in self._spans]  # fmt: skip
        finally:
            self._spans = None
        return sum(took) if took else None

    def kernels(self, act: Callable[[], object], most: int = 25) -> dict[str, list[dict[str, Any]]]:
        """Run a call under torch's profiler, and return the kernels of each core, those with the
        longest total time first. On a machine without a GPU, operators of the CPU take their place.

        A core begins when the GPU has no other work, and ends with its last kernel, so that each
        kernel is within the time of its core, also those of a replayed graph.

        Args:
            act: The call.
            most: The maximum number of kernels of a core.

        Returns:
            By the name of a core: "kernel", "calls", "ms", and the "share" of the time of all
            kernels of the core.
        """
        torch = require("torch")
        self._is_annotating = True
        try:
            events = _profiled(act)
        finally:
            self._is_annotating = False
        kind = torch.autograd.DeviceType.CUDA
        if not torch.cuda.is_available():
            kind = torch.autograd.DeviceType.CPU
        # CUPTI repeats an annotation on the device, around the kernels of the annotated call.
        annotations = {f"{_CORE}{name}" for name in self._names}
        spans = [
            (event.name.removeprefix(_CORE), event.time_range)
            for event in events
            if event.name in annotations and event.device_type == torch.autograd.DeviceType.CPU
        ]
        # Durations of each kernel, µs, by core and name.
        times_us: dict[str, dict[str, list[float]]] = {}
        for event in events:
            if event.device_type != kind or event.name in annotations:
                continue
            begin_us, end_us = event.time_range.start, event.time_range.end
            for core, span in spans:
                if span.start <= begin_us <= span.end:
                    kernels = times_us.setdefault(core, {})
                    kernels.setdefault(event.name, []).append(end_us - begin_us)
        return {core: _longest(kernels, most) for core, kernels in times_us.items()}

    def _annotated(self, name: str, function: Callable[..., Any], tensors: Sequence[Any]) -> Any:
        """Call a core within a record of torch's profiler that has all its kernels."""
        torch = require("torch")
        wait = torch.cuda.synchronize if tensors[0].is_cuda else _nothing
        self._inside = True
        try:
            wait()
            with torch.profiler.record_function(f"{_CORE}{name}"):
                result = function(*tensors)
                wait()
            return result
        finally:
            self._inside = False

    def _timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*tensors: Any) -> Any:
            if self._is_annotating and not self._inside:
                return self._annotated(name, function, tensors)
            if self._spans is None or self._inside:
                return function(*tensors)
            on_gpu, self._inside = tensors[0].is_cuda, True
            begin = _now(on_gpu)
            try:
                return function(*tensors)
            finally:
                self._spans.append((begin, _now(on_gpu)))
                self._inside = False

        timed.untimed = function  # type: ignore[attr-defined]
        return timed


def _longest(times_us: Mapping[str, Sequence[float]], most: int) -> list[dict[str, Any]]:
    """Return the kernels with the longest total time in the format of `NetworkTimer.kernels`, from
    the durations of the calls of each kernel.
    """
    totals_us = Counter({name: sum(times) for name, times in times_us.items()})
    all_us = max(totals_us.total(), 1e-9)
    rows = []
    for name, total_us in totals_us.most_common(most):
        rows.append(
            {
                "kernel": name[:_NAME_CHARACTERS],
                "calls": len(times_us[name]),
                "ms": total_us / 1e3,
                "share": total_us / all_us,
            }
        )
    return rows


def _nothing() -> None:
    """Do nothing, as a CPU computes synchronously."""


def _now(on_gpu: bool) -> Any:
    if not on_gpu:
        return time.perf_counter()
    event = require("torch").cuda.Event(enable_timing=True)
    event.record()
    return event


def profile(act: Callable[[], object]) -> dict[str, Any]:
    """Run a call under torch's profiler; on a machine without a GPU, operators of the CPU take the
    place of kernels.

    Returns:
        "launches": calls that start a kernel or a graph; "kernels"; "busy_ms": the time in which at
        least one kernel ran; "gaps": the longest times without a kernel, "MS ms before KERNEL",
        which the profiler itself lengthens.
    """
    torch = require("torch")
    on_gpu = torch.cuda.is_available()
    events = _profiled(act)
    kind = torch.autograd.DeviceType.CUDA if on_gpu else torch.autograd.DeviceType.CPU
    spans = sorted(
        (one.time_range.start, one.time_range.end, one.name)
        for one in events
        if one.device_type == kind
    )
    busy, gaps = busy_time(spans)
    return {
        "launches": sum("Launch" in one.name for one in events if one.device_type != kind),
        "kernels": len(spans),
        "busy_ms": busy / 1e3,
        "gaps": [f"{gap / 1e3:.2f} ms before {name[:60]}" for gap, name in gaps[:_SHOWN]],
    }


def _profiled(act: Callable[[], object]) -> Sequence[Any]:
    """Run a call under torch's profiler, and return the profiler's events."""
    torch = require("torch")
    kinds = torch.profiler.ProfilerActivity
    activities = [kinds.CPU, *([kinds.CUDA] if torch.cuda.is_available() else [])]
    with torch.profiler.profile(activities=activities) as profiled:
        act()
    events: Sequence[Any] = profiled.events()
    return events


def busy_time(spans: Sequence[Span]) -> tuple[float, list[tuple[float, str]]]:
    """Return the time that ascending spans cover, µs, and the gaps between them, µs, the longest
    first.
    """
    busy, gaps, end = 0.0, [], spans[0][0] if spans else 0.0
    for begin, stop, name in spans:
        if begin > end:
            gaps.append((begin - end, name))
        busy += max(0.0, stop - max(begin, end))
        end = max(end, stop)
    return busy, sorted(gaps, reverse=True)


def waits(act: Callable[[], object]) -> Counter[str]:
    """Run a call, and count how often the CPU waits for the GPU at each place, FILE:LINE; there are
    none without a GPU.
    """
    torch = require("torch")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        if torch.cuda.is_available():
            torch.cuda.set_sync_debug_mode("warn")
        try:
            act()
        finally:
            if torch.cuda.is_available():
                torch.cuda.set_sync_debug_mode("default")
    return Counter(f"{one.filename}:{one.lineno}" for one in said if _WAIT in str(one.message))
