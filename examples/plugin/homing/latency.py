"""A part of a replica, which counts the calls of the policy, and answers `GET /homing/latency`."""

import threading

from starlette.responses import JSONResponse
from starlette.routing import Route

from vlagents_ray.serve.config.parts import PartConfig
from vlagents_ray.serve.engine.observer import Observer
from vlagents_ray.serve.replica.part import ReplicaPart


class LatencyConfig(PartConfig):
    """The settings: `parts:` in homing.yaml."""

    name: str = "calls"


class Latency(ReplicaPart, Observer):
    """Sums up how long the policy's calls took. Several threads call `on_answer`."""

    Config = LatencyConfig

    def open(self):
        self.lock = threading.Lock()
        self.calls, self.total_ms = 0, 0.0

    def observer(self):
        return self

    def on_answer(self, pending, reply):
        if pending.request.op == "act" and reply.error is None:
            with self.lock:
                self.calls += 1
                self.total_ms += reply.timing["policy_ms"]

    def routes(self):
        return [Route("/homing/latency", self.show)]

    async def show(self, request):
        mean_ms = self.total_ms / self.calls if self.calls else None
        return JSONResponse({self.settings.name: self.calls, "mean_ms": mean_ms})

    def describe(self):
        return {"path": "/homing/latency"}
