"""A command whose Ray is lost ends with one sentence and status 1, whatever it is doing."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from contextlib import suppress

import pytest

from vlagents_ray.signals import interrupts, own_sigterm, stop_signals

# A command with a Ray whose head is lost at the first check; `{body}` is the work of the command in
# the meantime.
COMMAND = """
import atexit, sys, time, types
sys.modules["ray"] = types.ModuleType("ray")  # not asked here, and a second to import
import typer
from vlagents_ray.ray_tools import head_monitor
from vlagents_ray.cli import ray_session
from vlagents_ray.cli.console import errors
from vlagents_ray.errors import ClusterLost, EnvFailed

class Lost:
    node = "a node"
    def __init__(self, cure):
        self.cure = cure
    def answers(self):
        raise ClusterLost(f"the raylet has ended; {{self.cure}}")

head_monitor.PERIOD_S, head_monitor.HeadMonitor = 0.05, Lost
nodes = ["a node"]
ray_session.node_of_this_process = lambda: nodes[0]
ray_session._LEAVE_S, ray_session._EXIT_S = {leave_s}, 0.2
atexit.register(time.sleep, 60)  # as Ray's farewell to a cluster that is not there

def command():
    with errors(), ray_session.exit_if_ray_is_lost("start it again") as loss:
        {body}

typer.run(command)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "leave_s"),
    [
        ("time.sleep(60)", 0.2),  # a call of Ray that does not return
        ("time.sleep(0.5); raise EnvFailed('workers do not start')", 30),  # Ray's own error
        ("Lost('start it again').answers()", 30),  # the evaluation itself notices the loss
    ],
    ids=["stuck", "failing", "noticing"],
)
def test_it_ends_with_one_sentence(body: str, leave_s: float) -> None:
    ended = run(body, leave_s)
    assert ended.returncode == 1
    assert ended.stderr.strip() == "Error: ClusterLost: the raylet has ended; start it again"


def test_a_servers_sentence_is_the_last_line_whatever_rays_native_threads_say_of_it() -> None:
    native = "[os.write(2, b'E native\\n') and time.sleep(0.001) for _ in iter(int, 1)]"
    body = (
        f"import os, threading; threading.Thread(target=lambda: {native}, "
        "daemon=True).start(); "
        "loss.wait()"
    )
    ended = run(body)
    assert ended.returncode == 1
    assert re.fullmatch(
        r"(E native\n)+Error: ClusterLost: the raylet has ended; start it again\n", ended.stderr
    )


def test_a_command_that_leaves_ray_by_itself_is_left_alone() -> None:
    body = "nodes[0] = None; time.sleep(0.5); atexit.unregister(time.sleep)"
    ended = run(body, 0.1, "0.3, Lost")
    assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize("noticed", [True, False])
def test_one_that_was_interrupted_says_so_though_the_signal_ended_ray_as_well(
    noticed: bool,
) -> None:
    farewell = "atexit.unregister(time.sleep); atexit.register(time.sleep, 1)"
    body = f"time.sleep({0.5 if noticed else 0}); {farewell}; raise KeyboardInterrupt"
    ended = run(body)
    assert (ended.returncode, ended.stderr.strip()) == (130, "Error: interrupted")


@pytest.mark.slow
def test_a_server_that_hangs_while_it_leaves_ends_and_says_where() -> None:
    """In an earlier version, the shutdown after Ctrl-C could hang forever without any message."""
    interrupt = "import os, threading; threading.Timer(0.5, os.kill, (os.getpid(), 2)).start()"
    body = f"{interrupt}; ray_session._END_S = 1.0; loss.wait()"
    ended = run(body, lost="60, Lost")
    assert ended.returncode == 1
    assert "Timeout (0:00:01)!" in ended.stderr
    assert "most recent call first" in ended.stderr


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 15], ids=["Ctrl-C", "SIGTERM"])
def test_an_interrupt_that_python_drops_ends_the_command_all_the_same(number: int) -> None:
    """An earlier server continued to serve if the signal arrived in one of Ray's callbacks during
    the start.
    """
    dropped = (
        f"class Gone:\n            def __del__(self): __import__('signal').raise_signal({number})"
    )
    body = f"{dropped}\n        Gone()\n        atexit.unregister(time.sleep)\n        loss.wait()"
    ended = run(body, lost="60, Lost")
    assert ended.returncode == 130
    assert "Exception ignored in" in ended.stderr, "Python did not drop the exception"
    assert ended.stderr.endswith("Error: interrupted\n")


def test_an_evaluation_does_not_begin_after_an_interrupt_that_was_dropped() -> None:
    with interrupts():
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt), stop_signals():
            pytest.fail("it began")
    with stop_signals() as stop:
        assert not stop.is_set()


def test_sigterm_while_ray_starts_interrupts_the_command() -> None:
    with interrupts():
        with pytest.raises(KeyboardInterrupt), own_sigterm():
            sys.exit(signal.SIGTERM)  # like the handler of `ray.init`
        with pytest.raises(KeyboardInterrupt):  # the command's own handler is active again
            signal.raise_signal(signal.SIGTERM)


@pytest.mark.parametrize(
    "words", [["policies"], ["robot", "http://127.0.0.1:9"]], ids=["policies", "robot"]
)
def test_ctrl_c_while_modules_are_imported_ends_the_command_without_a_traceback(
    words: list[str],
) -> None:
    command = [
        sys.executable,
        "-X",
        "importtime",
        "-c",
        "from vlagents_ray.cli import main; main()",
        *words,
    ]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if line.endswith("numpy.version\n"):
                break
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    printed = [line for line in said.splitlines() if not line.startswith("import time:")]
    assert printed == [
        "Error: interrupted before the command began; nothing was started or written"
    ]


def run(
    body: str, leave_s: float = 30, lost: str = "0.05, Lost"
) -> subprocess.CompletedProcess[str]:
    """Run a command with this body in a separate process. If `lost` begins with a longer period,
    Ray is not checked for that time.
    """
    code = COMMAND.format(body=body, leave_s=leave_s).replace("0.05, Lost", lost)
    environment = os.environ | {"COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, "-c", code],
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
        env=environment,
    )
