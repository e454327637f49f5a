"""A server with two replicas starts and stops without error messages, prints the address of its
metrics, and sends its WebSocket clients a reason when it stops.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
import yaml
from eval_fakes import wait_for
from ray_processes import START_S, free_address
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from vlagents_ray.serve.launch.deployment_file import IMPORT_PATH

pytestmark = [pytest.mark.server, pytest.mark.slow]
SERIES = "ray_vlagents_sessions"
# Ray warns, rightly, if a replica on a busy machine does not report the length of its queue within
# 0.1 s. Servers keep this limit, since after it a router skips a replica that hangs.
QUEUE_LENGTH_S = {"RAY_SERVE_QUEUE_LENGTH_RESPONSE_DEADLINE_S": "60"}


def test_two_replicas_start_and_stop_in_silence_and_close_websockets_with_a_reason(
    tmp_path: Path,
) -> None:
    """If both end at once, Serve ends HAProxy, and with it all connections, before the replicas."""
    application = {"import_path": IMPORT_PATH, "args": {"policy": "noop", "replicas": 2}}
    (tmp_path / "two.yaml").write_text(yaml.safe_dump({"applications": [application]}))
    port = free_address().rpartition(":")[2]
    command = [
        sys.executable,
        "-c",
        "from vlagents_ray.cli import main; main()",
        "serve",
        "two.yaml",
        "--port",
        port,
    ]
    log = tmp_path / "log"
    with log.open("w") as output:
        server = subprocess.Popen(
            command,
            stdout=output,
            stderr=output,
            cwd=tmp_path,
            env=os.environ | QUEUE_LENGTH_S,
            start_new_session=True,
        )
    try:
        wait_for(lambda: server.poll() is not None or "Ctrl-C stops" in log.read_text(), START_S)
        assert server.poll() is None, log.read_text()
        [url] = re.findall(r"^metrics for Prometheus: (http://\S+)$", log.read_text(), re.MULTILINE)
        wait_for(lambda: SERIES in metrics(url), START_S)
        # Before this line is printed, the connection might go through Serve's own proxy.
        websocket = connect(f"ws://127.0.0.1:{port}/v1/stream")
    finally:
        server.send_signal(signal.SIGTERM)
        server.wait(START_S)
    with websocket, pytest.raises(ConnectionClosed) as closed:
        websocket.recv(timeout=10)
    assert closed.value.rcvd is not None
    assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (
        1012,
        "the replica is stopping; connect again",
    )
    printed = log.read_text()
    assert server.returncode == 0, printed
    expected = (
        r"serving|  policy|  API|  live page|metrics|in a Ray program|log of Ray|Ctrl-C stops"
    )
    assert [line for line in printed.splitlines() if not re.match(expected, line)] == []


def metrics(url: str) -> str:
    with urllib.request.urlopen(url, timeout=10) as answer:
        text: str = answer.read().decode()
    return text
