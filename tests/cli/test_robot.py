"""`vlagents-ray robot`: a person at a terminal drives a simulation or corrects a policy, and the
run is recorded.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import json
import os
import pty
import re
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from dropped_signals import SendsSignal
from typer.testing import CliRunner

from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs
from vlagents_ray.cli.main import app
from vlagents_ray.cli.robot import _restarting as restarting
from vlagents_ray.cli.robot import command_parser
from vlagents_ray.cli.robot import main as drive
from vlagents_ray.contract import StateSpec
from vlagents_ray.policies.scripted import Scripted
from vlagents_ray.robot import Watchdog
from vlagents_ray.robot.simulated import SimulatedRobot
from vlagents_ray.success import Solved, SuccessCurve

MAIN = "from vlagents_ray.cli import main; main()"
REPEATS = 20  # number of repeats, during which the loop has ten ticks
QUICK = ["--env", "tabletop/lift", "--env-set", "width=32", "--env-set", "height=32"]


def robot(*words: str) -> Any:
    return CliRunner().invoke(app, ["robot", *words], env={"COLUMNS": "200"})


@contextlib.contextmanager
def at_a_terminal(
    code: str, *options: str
) -> Iterator[tuple[Any, Callable[[str], object], Iterator[str]]]:
    """Run Python code at a new terminal. Yield its process, a function that types keys there, and
    its output.
    """
    ours, its = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-c", code, *options],
        stdin=its,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # noqa: PLW1509 - no other thread runs here
    ) as process:
        assert process.stdout is not None
        too_long = threading.Timer(60, process.kill)  # ends the output if it takes too long
        too_long.start()
        try:
            yield (
                process,
                lambda keys: os.write(ours, keys.encode()),
                map(str.strip, process.stdout),
            )
        finally:
            too_long.cancel()
            process.kill()
    os.close(ours)
    os.close(its)


def frames(root: Path, episode: int) -> dict[str, Any]:
    return pq.read_table(root / f"data/chunk-000/file-{episode:03d}.parquet").to_pydict()


def labels(root: Path) -> list[str]:
    return [
        pq.read_table(path).to_pylist()[0]["label"]
        for path in sorted(root.glob("meta/episodes/*/*.parquet"))
    ]


def until(lines: Iterator[str], text: str) -> None:
    """Wait for a line with this text."""
    printed = []
    for line in lines:
        printed.append(line)
        if text in line:
            return
    raise AssertionError(f"{text!r} is not in the output: {printed}")


@pytest.mark.slow
def test_a_human_drives_a_simulation_and_labels_its_episodes(tmp_path: Path) -> None:
    words = ["robot", *QUICK, "--teleop", "keyboard", "--record", str(tmp_path)]
    with at_a_terminal(MAIN, *words) as (process, press, lines):
        for verdict, repeats in (("y", REPEATS), ("x", REPEATS // 2), ("n", REPEATS // 2)):
            until(lines, "seed")
            for _ in range(repeats):  # like a terminal while a key is pressed
                press("w")
                time.sleep(0.05)
            press(verdict)
        until(lines, "seed")
        press("q")
        until(lines, "recorded: 2 episodes")
        assert process.wait(30) == 0
    assert labels(tmp_path) == ["success", "failure"]
    first = frames(tmp_path, 0)
    assert all(first["intervention"])
    assert not any(first["policy_known"])
    assert max(action[0] for action in first["action"]) == 0.5


@pytest.mark.slow
def test_a_human_corrects_a_policy(tmp_path: Path) -> None:
    words = [
        "robot",
        "scripted",
        *QUICK,
        "--teleop",
        "keyboard",
        "--record",
        str(tmp_path),
        "--hz",
        "10",
    ]
    with at_a_terminal(MAIN, *words) as (process, press, lines):
        until(lines, "the policy moves the robot")
        press("s")
        until(lines, "you move the robot")
        press("\n")  # return control
        until(lines, "the policy moves the robot")
        until(lines, "success")  # the policy solves the task after the correction
        until(lines, "seed")
        press("q")
        assert process.wait(30) == 0
    seen = frames(tmp_path, 0)
    human = seen["intervention"]
    first, last = human.index(True), len(human) - human[::-1].index(True)
    assert all(human[first:last])
    assert 0 < first < last < len(human)
    assert all(seen["policy_known"])
    assert labels(tmp_path) == ["success"]


def test_a_policy_alone_is_loaded_once_and_recorded_without_columns_that_nobody_fills(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    loads: list[Scripted] = []
    monkeypatch.setattr(Scripted, "initialize", lambda self: loads.append(self))  # noqa: PLW0108 - a method
    run = robot("scripted", *QUICK, "--episodes", "2", "--hz", "200", "--record", str(tmp_path))
    assert run.exit_code == 0, run.output
    assert run.output.count("success: ") == 2
    assert run.output.count("ticks of the policy; age of its actions p50") == 2
    assert "recorded: 2 episodes" in run.output
    assert "intervention" not in frames(tmp_path, 1)
    assert len(loads) == 1


@pytest.mark.slow
@pytest.mark.library("rerun")
def test_episodes_are_shown_in_a_viewer(tmp_path: Path) -> None:
    run = robot("scripted", *QUICK, "--episodes", "2", "--hz", "200", "--rerun", str(tmp_path))
    assert run.exit_code == 0, run.output
    assert len(list(tmp_path.glob("*.rrd"))) == 2


@pytest.mark.slow
def test_ctrl_c_says_what_was_recorded(tmp_path: Path) -> None:
    words = [
        "robot",
        "scripted",
        *QUICK,
        "--episodes",
        "9",
        "--hz",
        "200",
        "--record",
        str(tmp_path),
    ]
    with subprocess.Popen(
        [sys.executable, "-c", MAIN, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        while b"seed 2" not in process.stdout.readline():
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    kept = len(list(tmp_path.glob("data/*/*.parquet")))
    assert kept in (2, 3), "would wait for the running loop if it had begun"
    assert (process.returncode, said.decode()) == (
        130,
        f"Error: interrupted; {kept} episodes are in {tmp_path}\n",
    )


@pytest.mark.parametrize(
    ("words", "cure"),
    [
        ([], "expected a policy, --teleop, or both, got neither"),
        (["--teleop", "pedals"], "keyboard"),
        (["--teleop", "keyboard"], "expected a terminal"),
        (["scripted", "--mode", "often"], "open_loop"),
        (["http://127.0.0.1:9", "--set", "a=1"], "expected no settings"),
    ],
)
def test_wrong_settings_are_refused_with_the_cure(words: list[str], cure: str) -> None:
    run = robot(*QUICK, *words)
    assert run.exit_code == 2
    assert cure in run.output


def test_a_simulation_has_the_limits_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "slow.json").write_text('{"velocity": 1e-6}')
    words = [
        "scripted",
        *QUICK,
        "--episodes",
        "1",
        "--hz",
        "200",
        "--limits",
        str(tmp_path / "slow.json"),
    ]
    run = robot(*words)
    assert run.exit_code == 1, run.output
    assert "expected velocity of at most" in run.output


def test_a_person_restarts_the_command_by_a_signal() -> None:
    said: list[str] = []
    stopped = threading.Event()
    with (
        Watchdog(lambda _: stopped.set(), {"loop": 0.05}) as watchdog,
        restarting(watchdog, said.append),
    ):
        assert stopped.wait(30)
        os.kill(os.getpid(), signal.SIGUSR1)
        assert watchdog.control.stopped  # the loop still hangs
        watchdog._limits["loop"] = 60.0
        watchdog.heard("loop")
        assert watchdog.control.stopped
        watchdog.control.pause("paused from the live page")
        os.kill(os.getpid(), signal.SIGUSR1)
        assert not watchdog.control.stopped
        assert watchdog.control.reason is None
    assert signal.getsignal(signal.SIGUSR1) == signal.SIG_DFL


def test_a_person_restarts_the_command_by_enter_at_its_terminal() -> None:
    code = """
import threading
from vlagents_ray.robot import Watchdog
from vlagents_ray.cli.robot import _restarting

stopped, restarted = threading.Event(), threading.Event()

def say(line):
    print(line, flush=True)
    if line == "restarted":
        restarted.set()

with Watchdog(lambda _: stopped.set(), {"loop": 0.05}) as watchdog, _restarting(watchdog, say):
    assert stopped.wait(30)
    watchdog._limits["loop"] = 60.0
    watchdog.heard("loop")
    print("stopped", flush=True)
    assert restarted.wait(30)
    assert not watchdog.control.stopped
"""
    with at_a_terminal(code) as (process, type_keys, lines):
        assert next(lines) == "stopped"
        type_keys("\n")
        assert next(lines) == "restarted"
        assert process.wait(30) == 0


def test_with_a_keyboard_as_leader_each_key_has_one_consumer_and_enter_restarts_nothing() -> None:
    """The command line of docs/interventions.md, with a policy in its process."""
    code = """
import sys
import vlagents_ray.cli.robot as command
from vlagents_ray import Act, ActionSpec, Agent, Contract
import vlagents_ray_robot.teleoperation as teleoperation
import numpy as np

class Still(Agent):
    contract = Contract(action=ActionSpec(dim=6, delta=True))
    transport = "local"

    def __init__(self, *_, **__): ...

    def act(self, obs):
        return Act(np.zeros(6, np.float32))

class Seen(teleoperation.Keyboard):
    def _press(self, key):
        taken = super()._press(key)
        print("keyboard", repr(key), taken, flush=True)
        return taken

class Stopped(command.Watchdog):
    def start(self):
        super().start()
        self.trip("a person is in the way")

import vlagents_ray.robot.loop as loop
command.RemoteAgent, loop.Watchdog = Still, Stopped
teleoperation.open_keyboard = Seen.open_leader
sys.exit(command.main(sys.argv[1:]))
"""
    options = ["http://gpu-box:8000", "--teleop", "keyboard", "--step", "0.01"]
    with at_a_terminal(code, *options) as (process, type_keys, lines):
        while "a person is in the way" not in next(lines):
            pass
        for _ in range(20):
            type_keys("w")
        type_keys("\n\nc")
        said = list(itertools.islice(lines, 24))
        assert said[:20] == ["keyboard 'w' True"] * 20
        assert said[20:22] == [r"keyboard '\n' True"] * 2, "Enter returns control and takes it over"
        assert said[22:] == ["keyboard 'c' False", "restarted"]
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 128 + signal.SIGTERM


@pytest.mark.slow
@pytest.mark.parametrize("wish", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_the_command_stops_the_robot_when_it_is_told_to_end(wish: signal.Signals) -> None:
    code = """
import time
import vlagents_ray.cli.robot as command

def run(options):
    try:
        print("moving", flush=True)
        time.sleep(60)
        print("told in vain", flush=True)
    finally:
        print("stopped", flush=True)

command._run = run
command.main(["http://nowhere"])
"""
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "moving\n"
        process.send_signal(wish)
        assert process.stdout.read() == "stopped\n"


class Served(Agent):
    """A stand-in for the connected agent, with absolute targets that grow by 0.01 per tick."""

    transport = "local"
    contract: Contract | None = Contract(action=ActionSpec(dim=2, delta=False), chunk=1)  # type: ignore[assignment]
    success_curves: tuple[SuccessCurve, ...] = ()
    slow_s = 0.0
    tick = 0

    def __init__(self, *_: object, **__: object) -> None: ...

    def act(self, obs: Obs) -> Act:
        time.sleep(self.slow_s * (self.tick > 0))
        self.tick += 1
        return Act(np.full(2, 0.01 * (self.tick - 1), np.float32))


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Let the command connect to an agent with these attributes."""

    def serve(**attributes: Any) -> None:
        for name, value in attributes.items():
            monkeypatch.setattr(Served, name, value)

    monkeypatch.setattr("vlagents_ray.cli.robot.RemoteAgent", Served)
    return serve


class Interrupting(SimulatedRobot):
    """A robot whose driver is interrupted in a destructor."""

    observed = 0

    def observe(self) -> Obs:
        self.observed += 1
        if self.observed == 5:
            SendsSignal(signal.SIGTERM)
        return super().observe()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.usefixtures("served")
def test_a_signal_whose_exception_python_drops_ends_the_loop_before_its_next_tick(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("vlagents_ray.cli.robot.SimulatedRobot", Interrupting)
    begun = time.monotonic()
    with pytest.raises(SystemExit) as ended:
        drive(["http://nowhere", "--seconds", "60", "--hz", "10"])
    assert ended.value.code == 128 + signal.SIGTERM
    assert time.monotonic() - begun < 30
    assert "ticks without an action of the policy" in capsys.readouterr().out


SHORT = ["http://nowhere", "--seconds", "1"]
ATTEMPTS = 5  # other work of the machine may disturb such a short run


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["async", "open_loop", "ensemble"])
@pytest.mark.usefixtures("served")
def test_a_policy_of_single_actions_drives_in_each_mode(
    capsys: pytest.CaptureFixture[str], mode: str
) -> None:
    for _ in range(ATTEMPTS):
        status = drive([*SHORT, "--hz", "10", "--mode", mode])
        said = re.search(
            r"ticks without an action of the policy: (\d+) of (\d+)", capsys.readouterr().out
        )
        assert said is not None
        safe, ticks = map(int, said.groups())
        if safe < 0.5 * ticks:  # no safe ticks on an idle machine
            break
    assert safe < 0.5 * ticks
    assert status == (1 if safe else 0)


def test_the_simulated_robot_takes_actions_of_which_nothing_is_stated(
    served: Callable[..., None],
) -> None:
    served(contract=Contract(action=ActionSpec(dim=2)))
    # A busy machine may miss ticks.
    assert drive(["http://nowhere", "--seconds", "0.3", "--hz", "10"]) in (0, 1, 3)


CURVE = SuccessCurve(
    "tabletop", 20.0, "async", {"execute": 4}, {0: Solved(99, 100, 25), 3: Solved(95, 100, 28)}
)
DECLARED = Contract(action=ActionSpec(dim=2, delta=False), chunk=8)


@pytest.mark.parametrize(
    ("words", "attributes", "line"),
    [
        (
            [],
            {"contract": DECLARED, "success_curves": (CURVE,)},
            r"mode async: the contract declares absolute actions; measured: 95 % of 100 at 3 rows,",
        ),
        (
            [],
            {"contract": Contract(action=ActionSpec(dim=2), chunk=8)},
            r"mode open_loop, which executes 4 of 8 rows .*: the contract does not .*; no measured",
        ),
        (
            [],
            {"contract": DECLARED, "slow_s": 0.5},
            r"mode open_loop, .*: \d+ rows of delay \(\d+ ms\) is more than half of a chunk of 8 ",
        ),
        (["--mode", "ensemble"], {"contract": DECLARED}, r"mode ensemble: as set; no measured"),
    ],
    ids=["measured", "undeclared", "late", "explicit"],
)
def test_the_command_names_the_mode_its_reason_and_the_measured_success(
    served: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    attributes: dict[str, Any],
    line: str,
) -> None:
    slow_s = attributes.get("slow_s", 0.0)  # at 10 Hz five rows, or a part of one

    def act(_: Agent, obs: Obs) -> Act:
        time.sleep(slow_s)
        return Act(np.zeros((8, 2), np.float32))

    served(act=act, **attributes)
    drive(["http://nowhere", "--hz", "10", "--seconds", "0.1", *words])
    lines = [text for text in capsys.readouterr().out.splitlines() if text.startswith("mode ")]
    assert len(lines) == 1
    assert re.match(line, lines[0]), lines


def test_a_run_of_safe_actions_does_not_look_like_success(
    served: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    served(slow_s=0.3)
    for _ in range(ATTEMPTS):  # on a busy machine the run may have hardly any ticks
        status = drive([*SHORT, "--mode", "async"])
        said = capsys.readouterr()
        if status == 3:
            break
        caplog.clear()
    assert status == 3
    assert "MOSTLY SAFE ACTIONS, exit status 3" in said.out
    assert (said.out + said.err + caplog.text).count("--deadline-ms") == 1


def test_the_command_lets_a_human_take_over_and_records_that(
    served: Callable[..., None], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    served(contract=Contract(action=ActionSpec(dim=2, delta=False)))
    assert (
        drive([*SHORT, "--teleop", "scripted_leader:HoldingLeader", "--record", str(tmp_path)]) == 0
    )
    said = capsys.readouterr().out
    ticks = int(re.search(r"an operator moved the robot: (\d+)", said)[1])  # type: ignore[index]
    rows = pq.read_table(tmp_path / "data/chunk-000/file-000.parquet").to_pydict()
    assert rows["intervention"] == [True] * ticks
    assert rows["action"] == [[0.25, 0.25]] * ticks


RELATIVE = Contract(action=ActionSpec(dim=2, delta=True))
SIMULATED = "vlagents_ray.robot.simulated:SimulatedRobot"


@pytest.mark.parametrize(
    ("contract", "words", "said"),
    [
        (
            RELATIVE,
            [*SHORT, "--safe", "hold"],
            "ConfigError: safe: expected 'zero' or 'auto', got 'hold', which",
        ),
        (
            RELATIVE,
            [*SHORT, "--measure", "joints"],
            "ConfigError: measure: expected None for relative actions",
        ),
        (None, ["http://nowhere", "--robot", SIMULATED], "safe='hold'"),
        (
            None,
            [*SHORT, "--robot", "builtins:dict"],
            "--robot builtins:dict: expected a class .*, got a class without observe, apply, stop",
        ),
    ],
)
def test_what_does_not_fit_ends_the_command_before_anything_is_timed(
    served: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
    contract: Contract | None,
    words: list[str],
    said: str,
) -> None:
    served(contract=contract)
    assert drive(words) == 2
    printed = capsys.readouterr()
    assert re.search(said, printed.err, re.DOTALL)
    assert "empty loop" not in printed.out


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        (["--hz", "0"], "argument --hz: expected a number above 0, got '0'"),
        (["--hz", "nan"], "argument --hz: expected a number above 0, got 'nan'"),
        (["--seconds", "-1"], "argument --seconds: expected a number above 0, got '-1'"),
        (["--execute", "0"], "argument --execute: expected a whole number from 1, got '0'"),
        (["--horizon", "1.5"], "argument --horizon: expected a whole number from 1, got '1.5'"),
        (["--max-age-s", "0"], "argument --max-age-s: expected a number above 0, got '0'"),
        (["--deadline-ms", "-1"], "argument --deadline-ms: expected a number from 0, got '-1'"),
        (["--silent-s", "soon"], "argument --silent-s: expected a number above 0, got 'soon'"),
        (
            ["--mode", "open_loop", "--rtc"],
            "--merge and --rtc: expected --mode async with them, got --mode open_loop",
        ),
        (
            ["--teleop", "elsewhere:Pedal"],
            "--teleop elsewhere:Pedal: No module named 'elsewhere'; go to the folder of",
        ),
        (
            ["--robot", "elsewhere:Arm"],
            "--robot elsewhere:Arm: No module named 'elsewhere'; go to the folder of",
        ),
    ],
)
def test_options_are_checked_before_a_server_is_asked(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    wanted: str,
) -> None:
    monkeypatch.setattr("vlagents_ray.cli.robot.RemoteAgent", None)
    try:
        status: object = drive([*SHORT, *options])
    except SystemExit as ended:
        status = ended.code
    assert status == 2
    said = capsys.readouterr().err
    assert wanted in said
    assert said.count("\n") <= 4, "an error must not list all options"


def test_an_address_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert drive(["nonsense"]) == 2
    assert "expected http(s)://" in capsys.readouterr().err


ON_AN_ARM = """
import sys
import numpy as np
import vlagents_ray.cli.robot as command
from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs

class Still(Agent):
    contract = Contract(action=ActionSpec(dim=2, delta=False))
    transport = "local"

    def __init__(self, *_, **__): ...

    def act(self, obs):
        return Act(np.zeros((8, 2), np.float32))

class Arm:
    applied = 0

    def observe(self):
        return Obs(state={"joints": np.zeros(2, np.float32)})

    def apply(self, action):
        Arm.applied += 1
        if Arm.applied == 3:
            print("the arm moves", flush=True)

    def stop(self):
        print(f"the arm stops after {Arm.applied}", flush=True)

    def close(self):
        print(f"closed after {Arm.applied}", flush=True)

class Leader:
    def engaged(self):
        return False

    def action(self, obs):
        return np.zeros(2, np.float32)

sys.modules["arm"] = sys.modules["__main__"]
command.RemoteAgent = Still
sys.exit(command.main(["http://gpu-box:8000", "--robot", "arm:Arm", "--seconds", "60", *sys.argv[1:]]))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wish", "status"),
    [(signal.SIGINT, 130), (signal.SIGTERM, 128 + signal.SIGTERM), (signal.SIGHUP, 129)],
)
def test_a_signal_ends_a_run_on_an_arm_with_its_table_and_its_recording(
    tmp_path: Path, wish: signal.Signals, status: int
) -> None:
    words = ["--record", str(tmp_path / "demos"), "--teleop", "arm:Leader"]
    with at_a_terminal(ON_AN_ARM, *words) as (process, _, lines):
        until(lines, "the arm moves")
        process.send_signal(wish)
        said = list(lines)
        assert process.wait(30) == status
    text = "\n".join(said)
    assert "Traceback" not in text
    assert "within 2 ms" in text, "the table"
    assert f"recorded: 1 episodes in {tmp_path / 'demos'}" in text
    assert text.index("the arm stops") < text.index("closed")
    assert frames(tmp_path / "demos", 0)["action"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "label", "status"),
    [("y", "success", 0), ("n", "failure", 0), ("q", "none", 0), ("x", None, 0)],
)
@pytest.mark.parametrize("leader", ["arm:Leader", "keyboard"])
def test_the_keys_on_an_arm_are_named_at_the_start_and_end_and_label_the_run(
    tmp_path: Path, leader: str, key: str, label: str | None, status: int
) -> None:
    words = [
        "--record",
        str(tmp_path / "demos"),
        "--teleop",
        leader,
        "--step",
        "0.01",
        "--deadline-ms",
        "5000",
    ]
    with at_a_terminal(ON_AN_ARM, *words) as (process, press, lines):
        until(lines, "keys: p pauses")
        until(lines, "the arm moves")
        press("p")
        until(lines, "paused")
        press("p")
        until(lines, "the policy continues")
        press(key)
        said = "\n".join(lines)
        assert process.wait(30) in (status, 1), (
            "a run with a tick without an action of the policy must end with 1"
        )
    assert "Traceback" not in said
    stopped, closed = re.search(r"stops after (\d+)", said), re.search(r"closed after (\d+)", said)
    assert stopped is not None
    assert closed is not None
    assert stopped[1] == closed[1], "the arm must not move after the key"
    assert f"recorded: {int(label is not None)} episodes" in said
    if label is not None:
        assert labels(tmp_path / "demos") == [label]


ON_AN_ARM_WITH_A_SLOW_ANSWER = ON_AN_ARM.replace(
    "class Arm:",
    """
import time

class Slow(Still):
    answers = 0

    def act(self, obs):
        Slow.answers += 1
        if Slow.answers == 10:  # after the command has measured the delay
            time.sleep(1.0)
        return super().act(obs)

class Arm:""",
).replace("command.RemoteAgent = Still", "command.RemoteAgent = Slow")


@pytest.mark.slow
@pytest.mark.parametrize("restart", ["auto", "manual", "signal"])
def test_after_a_stop_the_command_says_once_that_the_server_answers_and_the_robot_continues(
    restart: str,
) -> None:
    mode = "auto" if restart == "auto" else "manual"
    words = ["--silent-s", "0.3", "--restart", mode, "--teleop", "arm:Leader"]
    with at_a_terminal(ON_AN_ARM_WITH_A_SLOW_ANSWER, *words) as (process, press, lines):
        until(lines, "stopped by the watchdog: server: silent for")
        if restart == "auto":
            until(lines, "the server answers again: the robot continues")
        else:
            until(lines, "the server answers again: Enter or C restarts the robot")
            if restart == "manual":
                press("\n")
            else:
                process.send_signal(signal.SIGUSR1)
            until(lines, "restarted")
        press("q")
        said = "\n".join(lines)
        process.wait(30)
    assert "Traceback" not in said
    assert "answers again" not in said
    assert "restarted" not in said


def test_without_a_terminal_the_command_says_so() -> None:
    run = subprocess.run(
        [sys.executable, "-c", ON_AN_ARM, "--seconds", "0.2"],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert "no keys, as there is no terminal" in run.stdout


class FaultyArm(Served):
    """An arm whose constructor fails."""

    def __init__(self, port: str = "") -> None:
        raise OSError(f"[Errno 2] could not open port {port}")

    observe = apply = stop = lambda *_: None


class Unmade:
    """A leader that needs arguments."""

    def __init__(self, port: str) -> None: ...

    def engaged(self) -> bool: ...  # type: ignore[empty-body]

    def action(self, obs: Obs) -> np.ndarray: ...  # type: ignore[empty-body]


HERE = f"{__name__}"
ARM = ["--robot", SIMULATED]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--hz", "1e9"], "--hz: expected a number of at most 10000, got '1e9'"),
        (["--hz", "inf"], "--hz: expected a number of at most 10000, got 'inf'"),
        (["--robots", "x:Y"], "--robots x:Y; did you mean '--robot'"),
        (["--robots=x:Y"], "--robots=x:Y; did you mean '--robot'"),
        (["--recrd", "x"], "did you mean '--record'"),
        (["--1234567"], "unrecognized arguments: --1234567; --help lists the options"),
        (["--ca", "x"], "read from a variable: export SSL_CERT_FILE=ca.pem"),
        (["--cacert=x"], "read from a variable: export SSL_CERT_FILE=ca.pem"),
        (
            ["--api-key", "vlr_secret"],
            "read from a variable: export VLAGENTS_RAY_API_KEY=vlr_...\n$",
        ),
        (
            ["--robot-set", "foo=1"],
            "--robot-set: expected --robot with it, got none; name the robot",
        ),
        (["--robot", "{here}:FaultyArn"], "has no 'FaultyArn'; did you mean 'FaultyArm'"),
        (["--robot", "json:Armature"], "has no 'Armature'; write the name of a class"),
        (["--robot", "nope"], "expected module:Class, as in my_arm:MyArm, got 'nope'"),
        (["--safe", "holdd"], "expected one of .*, got 'holdd'.*did you mean 'hold'"),
        (["--mode", "open-loop"], "did you mean 'open_loop'"),
        (["--merge", "newst"], "did you mean 'newest'"),
        (["--transport", "smh"], "did you mean 'shm'"),
        (["--restart", "autom"], "did you mean 'auto'"),
        (["--teleop", "keybord"], "did you mean 'keyboard'"),
        (["--seconds", "inf"], "--seconds: expected a number of at most .*, got 'inf'"),
        (["--silent-s", "inf"], "--silent-s: expected a number of at most .*, got 'inf'"),
        (["--timeout-s", "1e300"], "expected a number of at most"),
        (["--execute", "99999999999"], "expected a number of at most"),
        (["--record", "/proc/x"], "/proc/x: expected at least 50 MB of free .*; make room"),
        (["--record", "{file}"], "{file}: exists and is not a folder .*; choose another folder"),
        (["--record", "{file}/below"], "a part of the path is not a folder .*; choose another"),
        (["--record", "{folder}"], "not a LeRobotDataset, and not empty; record into a new folder"),
        (["--record", "{damaged}"], "recorder .*record into a new folder"),
        (["--rerun", "{file}"], "{file}|rerun"),
        (["--limits", "{file}"], "limits {file}: "),
        (["--limits", "{folder}"], "LeRobotDataset v3.0, got no file {folder}/meta/info.json; see"),
        (["--limits", "/nowhere.yaml"], "a LeRobotDataset v3.0, got no file /nowhere.yaml; see"),
        (["--limits", "{limits}"], "limits {limits}: expected only .*; did you mean 'velocity'"),
        (["--stats", "{folder}", *ARM], "statistics"),
        (["--robot", "ros:{folder}"], "cannot be read as a file of ROS topics"),
        (["--robot", "ros:/nowhere.yaml"], "cannot be read as a file of ROS topics"),
        ([*ARM, "--robot-set", "foo=1"], "unexpected keyword argument 'foo'; it accepts"),
        ([*ARM, "--robot-set", "foo"], "expected KEY=VALUE"),
        (
            ["--robot", "{here}:FaultyArm", "--robot-set", "port=/dev/x"],
            "could not be made: OSError: .*port /dev/x",
        ),
        (["--robot", "{here}:FaultyArm", "--robot-set", "port=3"], "port: expected str, got 3"),
        (["--robot", "broken_syntax:Arm"], "SyntaxError: .*correct the module 'broken_syntax'"),
        (
            ["--robot", "raising_module:Arm"],
            "ZeroDivisionError: .*correct the module 'raising_module'",
        ),
        (["--robot", "lerobot:nothing"], "lerobot"),
        (["--robot", ":Arm"], "--robot :Arm"),
        (["--robot", "a..b:Arm"], "--robot a..b:Arm"),
        (
            ["--teleop", "{here}:Unmade"],
            "--teleop .*expected a class that can be made without arguments, got TypeError",
        ),
        (["--teleop", "builtins:dict"], "got a class without engaged, action"),
        (["--teleop", "broken_syntax:Leader"], "SyntaxError"),
        (["--measure", "elbow", *ARM, "--max-step", "1"], "elbow"),
        (
            ["--measure", "jonts", *ARM],
            "--measure: expected parts of the robot's state, of .*'joints'.*, got 'jonts'",
        ),
    ],
)
@pytest.mark.usefixtures("served")
def test_each_wrong_argument_is_an_error_with_its_cure(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    words: list[str],
    said: str,
) -> None:
    modules = tmp_path / "modules"
    modules.mkdir()
    (modules / "broken_syntax.py").write_text("class Arm(:\n")
    (modules / "raising_module.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(str(modules))
    (tmp_path / "file").write_text("a file")
    (tmp_path / "limits.yaml").write_text("velocty: 3")
    (tmp_path / "damaged/meta").mkdir(parents=True)
    (tmp_path / "damaged/meta/info.json").write_text("{")
    places = {name: str(tmp_path / name) for name in ("file", "damaged")} | {
        "folder": str(tmp_path),
        "limits": str(tmp_path / "limits.yaml"),
        "here": HERE,
    }
    given = [word.format(**places) for word in words]
    try:
        status: object = drive([*SHORT, "--seconds", "0.05", *given])
    except SystemExit as ended:
        status = ended.code
    error = capsys.readouterr().err
    assert status == 2, error
    assert re.search(said.format(**places), error, re.DOTALL), error
    require_said_once(error)


def require_said_once(error: str) -> None:
    """Fail if a message contains our own errors within others, or a part twice."""
    assert len(re.findall(r"(?:ConfigError|StorageFailed|InvalidInput): ", error)) <= 1, error
    parts = [part.strip() for part in re.split(r"[;\n]", error) if part.strip()]
    for part, other in itertools.permutations(parts, 2):
        assert part not in other, (part, error)


class ArmOfParts:
    """An arm, or a pair, whose joints and grippers are parts of the state, and which reaches each
    command at once.
    """

    parts: tuple[tuple[str, int], ...] = (("joints", 6), ("gripper", 1))

    def __init__(self) -> None:
        self.pose = np.zeros(sum(size for _, size in self.parts), np.float32)

    def observe(self) -> Obs:
        state = {}
        first = 0
        for name, size in self.parts:
            state[name] = self.pose[first : first + size].copy()
            first += size
        return Obs({"front": np.zeros((32, 32, 3), np.uint8)}, state=state)

    def apply(self, action: np.ndarray) -> None:
        self.pose = action.copy()

    def stop(self) -> None: ...


class Aloha(ArmOfParts):
    parts = (("left/joints", 6), ("left/gripper", 1), ("right/joints", 6), ("right/gripper", 1))


class Released:
    """A leader that never takes over."""

    def engaged(self) -> bool:
        return False

    def action(self, obs: Obs) -> np.ndarray:
        raise AssertionError("the leader is not engaged")


PAIR = {
    "ArmOfParts": Contract(
        state={"joints": StateSpec(6, "rad"), "gripper": StateSpec(1)},
        action=ActionSpec(dim=7, space="joint", delta=False, gripper_open=1.0, gripper_closed=0.0),
        chunk=8,
    ),
    "Aloha": Contract(
        state={name: StateSpec(size) for name, size in Aloha.parts},
        action=ActionSpec(
            dim=14,
            space="joint",
            delta=False,
            gripper_open=1.0,
            gripper_closed=0.0,
            arms=("left", "right"),
        ),
        chunk=8,
    ),
}
MEASURE = {"ArmOfParts": "joints,gripper", "Aloha": ",".join(name for name, _ in Aloha.parts)}
# A valid value of each option for a robot; None for an option that every run has.
OPTIONS: dict[str, list[str] | None] = {
    "--robot": None,
    "--robot-set": None,  # the classes have no arguments
    "--instruction": ["stack the cups"],
    "--seconds": None,
    "--hz": ["50"],
    "--real-time": [],
    "--teleop": [f"{HERE}:Released"],
    "--step": ["0.01"],
    "--allow-remote-stop": [],
    "--record": ["{folder}/recorded"],
    "--rerun": None,  # needs the library of the viewer
    "--mode": ["ensemble"],
    "--execute": ["2"],
    "--horizon": ["4"],
    "--merge": ["average", "--mode", "async"],
    "--rtc": ["--mode", "async"],
    "--max-age-s": ["5"],
    "--deadline-ms": ["500"],
    "--safe": ["hold"],
    "--max-step": ["0.5"],
    "--limits": ["{folder}/limits.yaml"],
    "--soft-start-s": ["0"],
    "--measure": ["{measure}"],
    "--stats": ["{folder}/stats.json"],
    "--ignore-mismatch": [],
    "--silent-s": ["5"],
    "--restart": ["auto"],
    "--transport": ["http"],
    "--timeout-s": ["5"],
}


def test_each_option_for_a_robot_is_run() -> None:
    _, robot_actions, env_actions = command_parser()
    options = {action.option_strings[0] for action in robot_actions}
    both = {"--hz", "--teleop", "--step", "--record", "--rerun", "--mode", "--execute"}
    assert OPTIONS.keys() == options | both | {"--max-step", "--limits", "--soft-start-s"}
    assert not OPTIONS.keys() & {action.option_strings[0] for action in env_actions}


@pytest.mark.slow
@pytest.mark.parametrize("option", [name for name, value in OPTIONS.items() if value is not None])
@pytest.mark.parametrize("arm", PAIR)
def test_each_option_suits_one_arm_and_a_pair(
    served: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    arm: str,
    option: str,
) -> None:
    contract = PAIR[arm]
    dim = contract.action.dim or 0

    def act(_: Agent, obs: Obs) -> Act:
        pose = np.concatenate([np.ravel(values) for values in obs.state.values()])
        return Act(np.tile(pose + np.float32(0.001), (8, 1)))

    served(contract=contract, act=act)
    ranges = {"min": [-3.0] * dim, "max": [3.0] * dim}
    (tmp_path / "stats.json").write_text(json.dumps({"action": ranges}))
    (tmp_path / "limits.yaml").write_text("velocity: 1.0\nacceleration: 50\njerk: 5000")
    words = ["http://nowhere", "--robot", f"{HERE}:{arm}", "--seconds", "0.1", option]
    for value in OPTIONS[option] or []:
        words.append(value.format(folder=tmp_path, measure=MEASURE[arm]))
    status = drive(words)
    printed = capsys.readouterr()
    assert status in (0, 1), printed.err  # 1: a busy machine had ticks without an action
    assert "rows of the plan per tick: " in printed.out
    if option != "--measure":
        assert f"no measured pose: .*; give --measure {MEASURE[arm]}" in printed.out.replace(
            "the first action is not compared with the pose of the robot, and may be anywhere "
            "within the limits",
            ".*",
        )
    if option == "--record":
        assert "recorded: 1 episodes" in printed.out
        assert "GB free" in printed.out


@pytest.mark.parametrize(
    ("measure", "said"),
    [
        ("left/joints,right/joints", None),  # without the grippers
        ("left/joints,left/gripper,right/joints,right/gripper", None),
        (
            "left/joints",
            r"expected parts with 14 numbers, .*, or 12 without grippers, got 6 in left",
        ),
        ("left/joints,left/gripper,right/joints", "got 13 in left/joints .6., left/gripper .1."),
        ("left/joints,rihgt/joints", "got 'rihgt/joints'; did you mean 'right/joints'"),
    ],
)
def test_the_measured_pose_of_a_pair_has_the_numbers_of_an_action(
    served: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
    measure: str,
    said: str | None,
) -> None:
    served(contract=PAIR["Aloha"], act=lambda *_: Act(np.zeros((8, 14), np.float32)))
    robot_words = ["--robot", f"{HERE}:Aloha", "--seconds", "0.1", "--max-step", "0.1"]
    status = drive(["http://nowhere", *robot_words, "--measure", measure])
    error = capsys.readouterr().err
    assert (status == 2) == (said is not None), error
    if said is not None:
        assert re.search(said, error), error
        require_said_once(error)


def test_a_limit_that_is_exceeded_is_in_the_unit_of_the_contract(
    served: Callable[..., None], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "limits.yaml").write_text("velocity: 0.5")
    words = ["--robot", f"{HERE}:ArmOfParts", "--limits", str(tmp_path / "limits.yaml")]
    rows = np.cumsum(np.full((8, 7), 0.1, np.float32), axis=0)
    served(contract=PAIR["ArmOfParts"], act=lambda *_: Act(rows))
    drive(["http://nowhere", *words, "--seconds", "0.2", "--soft-start-s", "0"])
    assert "expected velocity of at most 0.5 rad/s, got" in capsys.readouterr().out
