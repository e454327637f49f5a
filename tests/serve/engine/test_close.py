"""An engine that closes waits only for its policy, not for its other threads, one of which may be
stuck.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import pytest
from eval_fakes import wait_for

from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.serve.engine.engine import Engine

BOUND_S = 10.0  # much shorter than a stuck thread's wait, and much longer than closing takes


class Zero(Agent):
    """A policy that acts at once."""

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(1, np.float32))


def decoding(engine: Engine, robot: bool) -> ThreadPoolExecutor:
    """Return the threads that decode messages; the first message starts them."""
    engine.admission.submit(lambda: None, robot).result(BOUND_S)
    return engine.admission._threads[robot]


def preparing(engine: Engine) -> ThreadPoolExecutor:
    """Return the threads that prepare observations."""
    preparations = engine.intake._preparations
    assert preparations is not None
    return preparations._threads


THREADS: dict[str, Callable[[Engine], ThreadPoolExecutor]] = {
    "decode-robots": lambda engine: decoding(engine, robot=True),
    "decode-others": lambda engine: decoding(engine, robot=False),
    "prepare": preparing,
    "policy-background": lambda engine: engine._background._thread,
}


@pytest.mark.parametrize("name", THREADS)
def test_closing_drops_what_waits_for_a_thread_and_leaves_what_runs_there(name: str) -> None:
    engine = Engine(Zero())
    engine.start()
    threads = THREADS[name](engine)
    moves_on = threading.Event()
    entered = threading.Semaphore(0)

    def stuck() -> str:
        entered.release()
        assert moves_on.wait(60)
        return "done"

    running: list[Future[str]] = [threads.submit(stuck) for _ in range(threads._max_workers)]
    for _ in running:
        assert entered.acquire(timeout=BOUND_S)
    waiting = threads.submit(stuck)

    closing = threading.Thread(target=engine.close)
    closing.start()
    closing.join(BOUND_S)
    try:
        assert not closing.is_alive()
        assert waiting.cancelled()
        assert not any(job.done() for job in running)
    finally:
        moves_on.set()
    assert [job.result(BOUND_S) for job in running] == ["done"] * len(running)


def test_a_closed_engine_decodes_no_further_message() -> None:
    engine = Engine(Zero())
    engine.start()
    engine.close()
    with pytest.raises(PolicyUnavailable, match="stopping"):
        engine.admission.submit(lambda: None, robot=True)


@pytest.mark.parametrize("name", THREADS)
def test_the_threads_of_a_closed_engine_end(name: str) -> None:
    engine = Engine(Zero())
    engine.start()
    threads = THREADS[name](engine)
    threads.submit(lambda: None).result(BOUND_S)
    engine.close()
    wait_for(lambda: not any(thread.is_alive() for thread in threads._threads), BOUND_S)
