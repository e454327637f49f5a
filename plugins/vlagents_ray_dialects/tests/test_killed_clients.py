"""The sessions of killed clients end within five seconds, over each dialect with a connection, and
the metric `vlagents_sessions` always counts the sessions that are held.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import killed_clients
import pytest
from asgi_server import served
from dialect_server import ALL, client_of
from eval_fakes import wait_for
from in_process_replicas import Replicas
from served_agents import Witness

from vlagents_ray.registry import names
from vlagents_ray.serve.engine.engine import Engine

CLIENTS = 4
ENDED_S = 5.0  # time from the end of a client to the end of its session
OWN_PORT = {"gr00t": "zmq", "lerobot": "grpc", "lerobot_remote": "zenoh", "vlagents": "numpy"}
# Over HTTP, a client has no connection, and its session ends when it is closed or idle.
WITHOUT_CONNECTION = {"openvla"}
SETTINGS = ALL | {"xpolicylab": {"mapping": {"preset": "xpolicylab", "action": {"actions": {}}}}}


def kill_clients(dialect: str, port: int, engine: Engine) -> None:
    """Start clients in another process, kill it, and require the sessions before and after."""

    def held() -> tuple[int, int]:
        """Return the number of sessions, and the sum of their metric."""
        sessions = engine.sessions
        return len(sessions), sum(sessions.by_transport().values())

    command = [sys.executable, killed_clients.__file__, dialect, str(port), str(CLIENTS)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == f"{CLIENTS} clients have acted\n".encode()
            assert held() == (CLIENTS, CLIENTS)
        finally:
            process.kill()
    wait_for(lambda: held() == (0, 0), timeout_s=ENDED_S)


@pytest.mark.slow
@pytest.mark.parametrize("dialect", killed_clients.PATHS)
def test_killed_clients_of_the_servers_port_leave_no_session(dialect: str) -> None:
    engine = Engine(Witness())
    engine.start()
    with served(client_of(engine, SETTINGS).app) as port:
        kill_clients(dialect, port, engine)
    engine.close()


@pytest.mark.slow
@pytest.mark.parametrize("dialect", OWN_PORT)
def test_killed_clients_of_a_dialects_port_leave_no_session(
    dialect: str, open_dialect: Callable[..., int], replicas: Replicas
) -> None:
    pytest.importorskip(OWN_PORT[dialect])
    settings: dict[str, Any] = {}
    if dialect == "lerobot_remote":
        from remote_robot import SETTINGS as REMOTE

        settings = REMOTE
    port = open_dialect(dialect, idle_s=600.0, **settings)
    kill_clients(dialect, port, replicas.engines[0])


def test_each_dialect_is_here() -> None:
    tested = {*killed_clients.PATHS, *OWN_PORT, *WITHOUT_CONNECTION}
    assert tested == set(names("dialects"))
