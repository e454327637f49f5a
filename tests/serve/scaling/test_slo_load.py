"""The capacity that a replica's robots need, as it is reported to autoscaling and to other
replicas.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from in_flight import answered

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.interface import SLO, Act, Agent, Obs
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.fleet import USABLE, CostCurve
from vlagents_ray.serve.queue.batch_window import BatchWindow
from vlagents_ray.serve.scaling import slo_load as slo_loads
from vlagents_ray.serve.scaling.slo_load import RobotsLoadMeter, robots_load

COSTS = CostCurve(0.0293, 0.00806)
FRESH = {"hz": 10, "rows": 8, "age_ms": 200}  # a replica serves seven such robots


class Chunks(Agent):
    contract = Contract(action=ActionSpec(dim=7, delta=True), chunk=8)

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros((8, 7), np.float32))


class Replica:
    """An engine with a clock that a test sets."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.engine = Engine(Chunks(), clock=lambda: self.now)

    def reset(self, session: str, step: int | None = None) -> None:
        """Begin an episode of a robot. If the robot resumes, it sends the `step` of an earlier
        episode.
        """
        request = Request("reset", Obs(), kwargs={SLO: FRESH}, step=step)
        assert answered(self.engine, session, request).error is None


@pytest.fixture
def replica(monkeypatch: pytest.MonkeyPatch) -> Iterator[Replica]:
    monkeypatch.setattr(BatchWindow, "curve", lambda _: COSTS)
    replica = Replica()
    replica.engine.start()
    yield replica
    replica.engine.close()


def test_the_load_is_kept_for_a_moment_while_the_sessions_stay(
    replica: Replica, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads = []

    def counted(engine: Engine) -> slo_loads.RobotsLoad:
        reads.append(replica.now)
        return robots_load(engine)

    monkeypatch.setattr(slo_loads, "robots_load", counted)
    meter = RobotsLoadMeter(replica.engine)
    replica.reset("a")
    for _ in range(10):
        assert meter.read().robots == 1
    assert len(reads) == 1

    replica.reset("b")
    assert meter.read().robots == 2
    assert len(reads) == 2
    replica.now += 1.0
    meter.read()
    assert len(reads) == 3


def test_robots_that_came_from_another_replica_are_counted_apart_for_a_while(
    replica: Replica,
) -> None:
    """The other replica may also count these robots, until it is known that they have left or that
    the replica has ended.
    """
    replica.reset("new")
    replica.reset("resumed", step=17)
    one_robot = USABLE / 7
    assert robots_load(replica.engine) == pytest.approx((2, 2 * one_robot, one_robot))

    state = replica.engine.moves.export("new", replica.now)
    replica.engine.sessions.close("new")
    replica.engine.sessions.free("new")
    replica.engine.moves.adopt("new", state)
    assert robots_load(replica.engine) == pytest.approx((2, 2 * one_robot, 2 * one_robot))

    replica.reset("new", step=18)
    replica.now += slo_loads.MOVED_S + 0.1
    assert robots_load(replica.engine) == pytest.approx((2, 2 * one_robot, 0.0))
