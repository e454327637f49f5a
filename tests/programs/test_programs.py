"""Third-party programs from PyPI, each in a separate environment, act with a policy of this
package.

The list is in `tests/support/programs.py`. The server consists of a replica's endpoints in this
process.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import program_clients as clients
import pytest
from asgi_server import served
from dialect_server import METADATA
from in_process_replicas import Replicas
from peer_environment import drive, environment
from programs import PROGRAMS

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.protocol.messages import DEFAULT_LIMITS
from vlagents_ray.registry import dialect_class
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.dialects.base import (
    GatewayContext,
    ReplicaContext,
    RouteDialect,
    dialect_routes,
)
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.ports import free_port, reserve

ROWS = 4


def chunk(acts: int, dim: int) -> np.ndarray:
    """Return the rows of the act with that number. The values in [0, 1] are exact in float32, and
    differ between rows.
    """
    return (np.arange(ROWS * dim, dtype=np.float32).reshape(ROWS, dim) + 64 * (acts - 1)) / 1024


class Witness(Agent):
    """A policy that records its observations. Its gripper is 1 when open."""

    # Observations of all sessions, with the instruction and the act's number.
    seen: ClassVar[list[tuple[Obs, str | None, int]]] = []

    def __init__(self, dim: int) -> None:
        self.dim = dim

    @property
    def contract(self) -> Contract:
        return Contract(
            action=ActionSpec(dim=self.dim, gripper_open=1.0, gripper_closed=0.0), chunk=ROWS
        )

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, object]:
        self.instruction, self.acts = instruction, 0
        return {}

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        self.seen.append((obs, self.instruction, self.acts))
        return Act(chunk(self.acts, self.dim))


@contextmanager
def serving(dim: int, dialects: Mapping[str, Any]) -> Iterator[int]:
    """Yield the port of a replica with this dialect on its own port, or of a gateway with it."""
    Witness.seen.clear()
    with ExitStack() as stack:
        replicas = Replicas([Witness(dim)])
        stack.callback(replicas.close)
        [engine] = replicas.engines
        [(name, settings)] = dialects.items()
        cls = dialect_class(name)
        if issubclass(cls, RouteDialect):
            routes = dialect_routes(
                DialectArgs(**dialects), ReplicaContext(engine, lambda: METADATA, DEFAULT_LIMITS)
            )
            inside = build_http_app(engine, lambda: METADATA, DEFAULT_LIMITS, more=routes)
            yield stack.enter_context(served(AccessMiddleware(inside, None, "app")))
            return
        port, agent = free_port(), lambda *_: replicas.agent()
        context = GatewayContext("app", agent, DEFAULT_LIMITS, 4, 60.0, engine.contract, NoKey.OPEN)
        dialect = cls(name, cls.Config(port=port, **settings), context)
        stack.callback(dialect.close)
        dialect.serve(reserve(name, "127.0.0.1", port))
        yield port


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.program(name))
        for name, one in PROGRAMS.items()
        if one.client
    ],
)
def test_it_executes_the_policys_actions(name: str) -> None:
    program = PROGRAMS[name]
    python = environment(program.client, [*program.options, *program.requirements], program.python)
    with serving(program.dim, program.dialects) as port:
        said = drive(python, program.client, port, script=Path(clients.__file__))
    executed, seen = np.array(said["executed"]), Witness.seen
    assert len(executed) == clients.STEPS
    assert len(seen) == clients.STEPS // program.used
    stateless = "openvla" in program.dialects
    assert [acts for _, _, acts in seen] == (
        [1] * len(seen) if stateless else list(range(1, len(seen) + 1))
    )
    for number, (obs, instruction, _) in enumerate(seen):
        assert instruction == clients.TASK
        assert sorted(obs.cameras) == sorted(said["cameras"])
        for image in obs.cameras.values():
            middle = image[image.shape[0] // 2, image.shape[1] // 2].astype(int)
            # One program sends JPEG images.
            assert np.abs(middle - clients.picture(number * program.used)[0, 0]).max() <= 1
        assert bool(obs.state) == bool(said["state"])
        for key, part in said["state"].items():
            np.testing.assert_array_equal(obs.state[key], np.float32(part))
        assert obs.gripper == (None if said["gripper"] is None else pytest.approx(said["gripper"]))
    expected = np.concatenate([chunk(acts, program.dim)[: program.used] for _, _, acts in seen])
    np.testing.assert_allclose(executed, expected[:, : executed.shape[1]], atol=1e-6)


def run_example(name: str, *options: str, **variables: str) -> str:
    """Run an example of openpi to its end with its pinned packages, and return its output."""
    program = PROGRAMS[f"openpi examples/{name}"]
    folder = Path(os.environ["OPENPI_SRC"]) / "examples" / name
    theirs = ["--requirement", str(folder / "requirements.txt"), *program.requirements]
    command = [str(environment(name, theirs, program.python)), str(folder / "main.py"), *options]
    done = subprocess.run(
        command,
        env=os.environ | variables,
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    acts = [acts for _, _, acts in Witness.seen]
    assert acts == list(range(1, len(acts) + 1))  # a single session
    assert all(
        not np.array_equal(one.cameras["front"], other.cameras["front"])
        for (one, _, _), (other, _, _) in pairwise(Witness.seen)
    )
    return done.stdout


@pytest.mark.source("OPENPI_SRC")
@pytest.mark.program("openpi examples/simple_client")
@pytest.mark.parametrize(
    ("env", "preset", "dim"), [("DROID", "openpi-droid", 8), ("ALOHA_SIM", "openpi-aloha", 14)]
)
def test_openpis_simple_client_measures_the_server(env: str, preset: str, dim: int) -> None:
    with serving(dim, {"openpi": {"mapping": preset}}) as port:
        options = ("--host", "127.0.0.1", "--port", str(port), "--env", env, "--num-steps", "5")
        assert "client_infer_ms" in run_example("simple_client", *options)
    assert len(Witness.seen) == 7  # two warm-up calls are included


@pytest.mark.source("OPENPI_SRC")
@pytest.mark.program("openpi examples/aloha_sim")
def test_openpis_aloha_example_plays_an_episode(tmp_path: Path) -> None:
    with serving(14, {"openpi": {"mapping": "openpi-aloha"}}) as port:
        options = (
            "--args.host",
            "127.0.0.1",
            "--args.port",
            str(port),
            "--args.action-horizon",
            str(ROWS),
        )
        run_example("aloha_sim", *options, "--args.out-dir", str(tmp_path), MUJOCO_GL="egl")
    assert len(Witness.seen) == 300 // ROWS
    assert [video.suffix for video in tmp_path.iterdir()] == [".mp4"]
