"""The time of a policy's network alone, and what one act does on a GPU."""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.registry import require

Span = tuple[float, float, str]  # begin and end, µs, and the name of a kernel

_SHOWN = 5  # gaps
# In torch's warning; its debug mode warns of itself in other words.
_WAIT = "called a synchronizing CUDA operation"


class NetworkTimer:
    """Times the cores of policies: with events of CUDA on a GPU, by the clock on a CPU.

    What surrounds the cores does not count: images, tokens, copies to the device, results.
    """

    def __init__(self) -> None:
        self._spans: list[tuple[Any, Any]] | None = None  # None unless `measure` runs
        self._inside = False  # whether a core runs; one may call another

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
        ) -> Callable[..., Any]:
            cores = [getattr(part, "untimed", part) for part in parts]
            return self._timed(mark(compilation, name, function, rows, cores))

        Compilation.core = core  # type: ignore[method-assign, assignment]
        try:
            yield
        finally:
            Compilation.core = mark  # type: ignore[method-assign]

    def measure(self, act: Callable[[], object]) -> float | None:
        """Run an act that waits for its result; return the time of its cores, ms, or None if the
        policy has none.
        """
        self._spans = []
        try:
            act()
            took = [(end - begin) * 1e3 if isinstance(end, float) else begin.elapsed_time(end)
                    for begin, end in self._spans]  # fmt: skip
        finally:
            self._spans = None
        return sum(took) if took else None

    def _timed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*tensors: Any) -> Any:
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


def _now(on_gpu: bool) -> Any:
    if not on_gpu:
        return time.perf_counter()
    event = require("torch").cuda.Event(enable_timing=True)
    event.record()
    return event


def profile(act: Callable[[], object]) -> dict[str, Any]:
    """Run an act under torch's profiler; on a machine without a GPU, operators of the CPU take the
    place of kernels.

    Returns:
        "launches": calls that start a kernel or a graph; "kernels"; "busy_ms": the time in which at
        least one kernel ran; "gaps": the longest times without one, "MS ms before KERNEL", which
        the profiler itself lengthens.
    """
    torch = require("torch")
    kinds, on_gpu = torch.profiler.ProfilerActivity, torch.cuda.is_available()
    with torch.profiler.profile(
        activities=[kinds.CPU, *([kinds.CUDA] if on_gpu else [])]
    ) as profiled:
        act()
    events = profiled.events()
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
    """Run an act, and count the places, FILE:LINE, at which the CPU waits for the GPU; none
    without a GPU.
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
