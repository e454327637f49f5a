"""The CUDA stream of a policy's inference calls, which has priority over pushes of weights and over
loading.

All threads share torch's default stream, which has the lowest priority. On that stream, the kernels
of an inference call would alternate with the kernels of a weight push, or of a checkpoint that is
loaded on another stream.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, TypeVar

from vlagents_ray.policies.compilation import ACT_PRIORITY, CAPTURES
from vlagents_ray.policies.loading import LoadingReport

T = TypeVar("T")


class ActStream:
    """The CUDA stream of all inference calls of one policy, on any thread."""

    def __init__(self, device: Any) -> None:
        """Create the stream on a GPU, which is identified by name or index."""
        self._torch = sys.modules["torch"]
        self._device = device
        self._stream = self._torch.cuda.Stream(device, priority=ACT_PRIORITY)

    @classmethod
    def for_report(cls, report: LoadingReport) -> ActStream | None:
        """Return the stream of a loaded policy; None if it does not use a GPU with torch.

        Args:
            report: The report of the policy. It contains no device if the policy does not report
                its devices. Such a policy is assumed to use the current GPU.
        """
        torch = sys.modules.get("torch")
        if torch is None or not torch.cuda.is_initialized():
            return None
        for device in report.devices:
            if device["kind"] == "cuda" and "onnxruntime" not in device:
                return cls(device.get("device", "cuda"))
        return None if report.devices else cls("cuda")

    @contextmanager
    def selected(self) -> Iterator[None]:
        """Queue this thread's work on the policy's stream within the context.

        The work begins after all work that was queued earlier on the thread's own stream, and later
        work on the thread's own stream begins after it. A policy may therefore mix calls inside and
        outside of the context.
        """
        outer_stream = self._torch.cuda.current_stream(self._device)
        self._wait(self._stream, outer_stream)
        try:
            with self._torch.cuda.stream(self._stream):
                yield
        finally:
            self._wait(outer_stream, self._stream)

    @staticmethod
    def _wait(later: Any, earlier: Any) -> None:
        """Let later work on one stream begin after the work that is queued on another one.

        A failure of the GPU is ignored here, since the calls within the context detect it.
        """
        with suppress(RuntimeError):
            later.wait_stream(earlier)

    def run(self, function: Callable[..., T], *args: Any) -> T:
        """Return the result of a function that is called on the stream."""
        with self.selected():
            return function(*args)


class GpuCalls:
    """The context of a policy's calls, in which no CUDA graph is captured.

    A caller holds the lock of the policy, so that one thread at a time is in the context.
    """

    def __init__(self, stream: ActStream | None) -> None:
        """Select a stream in the context, if the policy has one."""
        self._stream = stream
        self._entered = ExitStack()

    def __enter__(self) -> None:
        with ExitStack() as entered:
            entered.enter_context(CAPTURES)
            if self._stream is not None:
                entered.enter_context(self._stream.selected())
            self._entered = entered.pop_all()

    def __exit__(self, *error: Any) -> None:
        self._entered.__exit__(*error)
