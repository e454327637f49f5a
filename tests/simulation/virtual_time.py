"""Event loops under one virtual clock. The next due event runs immediately; the seed decides the
order of events that are due at the same time.
"""

from __future__ import annotations

import asyncio
import heapq
from collections.abc import Callable, Coroutine
from typing import Any


class Clock:
    """The time in s, and the scheduled events."""

    def __init__(self) -> None:
        self.now = 0.0
        self.errors: list[BaseException] = []  # errors that no code caught
        self._due: list[tuple[float, int, asyncio.Handle, Loop]] = []
        self._count = 0

    def add(self, when: float, handle: asyncio.Handle, loop: Loop) -> None:
        """Run `handle` at that time, unless its process is dead or frozen."""
        self._count += 1
        heapq.heappush(self._due, (when, self._count, handle, loop))

    def run(self, until: float, over: Callable[[], bool]) -> None:
        """Run until the time `until`, until `over` is true, or until no event is left."""
        due = self._due
        while due and not over():
            when, _, handle, loop = heapq.heappop(due)
            if when > until:
                return
            self.now = max(self.now, when)
            if handle._cancelled or loop.ended:
                continue
            if loop.frozen_until > self.now:
                self.add(loop.frozen_until, handle, loop)
                continue
            asyncio._set_running_loop(loop)
            handle._run()
        asyncio._set_running_loop(None)


class Loop(asyncio.AbstractEventLoop):
    """The event loop of one process, which may be killed and frozen."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.ended = False
        self.frozen_until = 0.0
        self._tasks: set[asyncio.Task[Any]] = set()

    def time(self) -> float:
        return self._clock.now

    def call_soon(self, callback: Any, *args: Any, context: Any = None) -> asyncio.Handle:
        handle = asyncio.Handle(callback, args, self, context)
        self._clock.add(self._clock.now, handle, self)
        return handle

    call_soon_threadsafe = call_soon

    def call_later(
        self, delay: float, callback: Any, *args: Any, context: Any = None
    ) -> asyncio.TimerHandle:
        return self.call_at(self._clock.now + delay, callback, *args, context=context)

    def call_at(
        self, when: float, callback: Any, *args: Any, context: Any = None
    ) -> asyncio.TimerHandle:
        handle = asyncio.TimerHandle(when, callback, args, self, context)
        self._clock.add(when, handle, self)
        return handle

    def create_future(self) -> asyncio.Future[Any]:
        return asyncio.Future(loop=self)

    def create_task(self, coro: Coroutine[Any, Any, Any], **options: Any) -> asyncio.Task[Any]:  # type: ignore[override]
        task = asyncio.Task(coro, loop=self)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    def close(self) -> None:
        """Drop all pending events, as at the end of a process; the effects of `finally` blocks
        are invisible to others.
        """
        self.ended = True
        for task in list(self._tasks):
            task._log_destroy_pending = False  # type: ignore[attr-defined]

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        self._clock.errors.append(context.get("exception") or RuntimeError(context["message"]))

    def get_debug(self) -> bool:
        return False

    def is_running(self) -> bool:
        return True

    def _timer_handle_cancelled(self, handle: asyncio.TimerHandle) -> None:
        pass
