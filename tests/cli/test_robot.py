"""`vlagents-ray robot`: a human at a terminal drives a simulation, or corrects a policy, and it is recorded."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from vlagents_ray.cli.main import app
from vlagents_ray.policies.scripted import Scripted

REPEATS = 20  # the loop has ten ticks in that time
QUICK = ["--env", "tabletop/lift", "--env-set", "width=32", "--env-set", "height=32"]


def robot(*words: str) -> Any:
    return CliRunner().invoke(app, ["robot", *words], env={"COLUMNS": "200"})


def at_terminal(words: list[str], keys: Callable[[Callable[[str], None], Callable[[str], None]], None]) -> str:
    """Run the command at a terminal where `keys` types, and waits for what it prints; returns its output."""
    ours, its = pty.openpty()
    code = "from vlagents_ray.cli import main; main()"
    printed: list[str] = []
    with subprocess.Popen(
        [sys.executable, "-c", code, "robot", *words],
        stdin=its,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        assert process.stdout is not None

        def wait(text: str) -> None:
            for line in process.stdout or ():
                printed.append(line)
                if text in line:
                    return
            raise AssertionError(f"{text!r} was not printed: {''.join(printed)}")

        keys(lambda typed: os.write(ours, typed.encode()) and None, wait)
        printed.append(process.stdout.read())
        assert process.wait(30) == 0, "".join(printed)
    os.close(ours)
    os.close(its)
    return "".join(printed)


def frames(root: Path, episode: int) -> dict[str, Any]:
    return pq.read_table(root / f"data/chunk-000/file-{episode:03d}.parquet").to_pydict()


def labels(root: Path) -> list[str]:
    return [pq.read_table(path).to_pylist()[0]["label"] for path in sorted(root.glob("meta/episodes/*/*.parquet"))]


def test_a_human_drives_a_simulation_and_labels_its_episodes(tmp_path: Path) -> None:
    def keys(press: Callable[[str], None], wait: Callable[[str], None]) -> None:
        for verdict in ("y", "x", "n"):
            wait("seed")
            for _ in range(REPEATS):  # as a terminal does while the key is down
                press("w")
                time.sleep(0.05)
            press(verdict)
        wait("seed")
        press("q")

    said = at_terminal([*QUICK, "--leader", "keyboard", "--record", str(tmp_path)], keys)
    assert "recorded: 2 episodes" in said
    assert labels(tmp_path) == ["success", "failure"]
    first = frames(tmp_path, 0)
    assert all(first["intervention"])
    assert not any(first["policy_known"])
    assert max(action[0] for action in first["action"]) == 0.5


def test_a_human_corrects_a_policy(tmp_path: Path) -> None:
    def keys(press: Callable[[str], None], wait: Callable[[str], None]) -> None:
        wait("the policy moves the robot")
        press("s")
        wait("you move the robot")
        press("\n")  # gives back
        wait("the policy moves the robot")
        wait("seed")
        press("q")

    words = ["scripted", *QUICK, "--leader", "keyboard", "--record", str(tmp_path), "--hz", "5"]
    said = at_terminal(words, keys)
    assert "success" in said, "the policy solves it after the correction"
    seen = frames(tmp_path, 0)
    human = seen["intervention"]
    first, last = human.index(True), len(human) - human[::-1].index(True)
    assert all(human[first:last])
    assert 0 < first < last < len(human)
    assert all(seen["policy_known"])
    assert labels(tmp_path) == ["success"]


def test_a_policy_alone_is_recorded_without_columns_that_nobody_fills(tmp_path: Path) -> None:
    run = robot("scripted", *QUICK, "--episodes", "2", "--hz", "200", "--record", str(tmp_path))
    assert run.exit_code == 0, run.output
    assert run.output.count("success: ") == 2
    assert "recorded: 2 episodes" in run.output
    assert "intervention" not in frames(tmp_path, 1)


@pytest.mark.library("rerun")
def test_episodes_are_shown_in_a_viewer(tmp_path: Path) -> None:
    run = robot("scripted", *QUICK, "--episodes", "2", "--hz", "200", "--rerun", str(tmp_path))
    assert run.exit_code == 0, run.output
    assert len(list(tmp_path.glob("*.rrd"))) == 2


def test_ctrl_c_says_what_was_recorded(tmp_path: Path) -> None:
    code = "from vlagents_ray.cli import main; main()"
    words = ["robot", "scripted", *QUICK, "--episodes", "9", "--hz", "200", "--record", str(tmp_path)]
    with subprocess.Popen(
        [sys.executable, "-c", code, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        while b"seed 2" not in process.stdout.readline():
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    kept = len(list(tmp_path.glob("data/*/*.parquet")))
    assert kept in (2, 3), "with the running one, if it had begun"
    assert (process.returncode, said.decode()) == (130, f"error interrupted; {kept} episodes are in {tmp_path}\n")


def test_a_policy_of_this_process_is_loaded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    loads: list[Scripted] = []

    def load(self: Scripted) -> None:
        loads.append(self)

    monkeypatch.setattr(Scripted, "initialize", load)
    assert robot("scripted", *QUICK, "--episodes", "3", "--hz", "200").exit_code == 0
    assert len(loads) == 1


@pytest.mark.parametrize(
    ("words", "cure"),
    [
        ([], "want one of them"),
        (["--leader", "pedals"], "keyboard"),
        (["--leader", "keyboard"], "no terminal"),
        (["scripted", "--mode", "often"], "open_loop"),
        (["http://127.0.0.1:9", "--set", "a=1"], "has its settings already"),
    ],
)
def test_wrong_settings_are_refused_with_the_cure(words: list[str], cure: str) -> None:
    run = robot(*QUICK, *words)
    assert run.exit_code == 2
    assert cure in run.output
