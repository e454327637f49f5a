"""Typical mistakes of first users on a command line: each is answered at once, with one message
that names the cure.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from typer.main import get_command
from typer.testing import CliRunner

from vlagents_ray import InvalidObservation, Obs
from vlagents_ray.cli.light import OTHERS, ROBOT
from vlagents_ray.cli.main import app
from vlagents_ray.protocol.values import require_obs
from vlagents_ray.registry import names, pip_install

LONGEST_S = 20.0  # CPU time limit for one mistake
POLICIES = """
import os
import numpy as np
from vlagents_ray import Act, ActionSpec, Agent, Contract, StateSpec


class Base(Agent):
    @property
    def contract(self):
        return Contract(state={"xyzrpy": StateSpec(6, "m+rad")}, action=ActionSpec(dim=4, delta=True))

    def initialize(self):
        pass

    def reset(self, obs, instruction, **options):
        return {}


class WithoutAct(Base):
    pass


class WrongKey(Base):
    def act(self, obs):
        return Act(obs.info["absent"])


class WrongShape(Base):
    def act(self, obs):
        return Act(np.zeros(3, np.float32))


class NotFinite(Base):
    def act(self, obs):
        return Act(np.full(4, np.nan, np.float32))


class Enormous(Base):
    def act(self, obs):
        return Act(np.full(4, 1e30, np.float32))


class Text(Base):
    def act(self, obs):
        return "forward"


class Ends(Base):
    def act(self, obs):
        raise SystemExit(5)


class EndsItsProcess(Base):
    def act(self, obs):
        os._exit(0)


class DoesNotLoad(Base):
    def initialize(self):
        raise FileNotFoundError("weights.bin")

    def act(self, obs):
        return Act(np.zeros(4, np.float32))


class NoAgent:
    pass
"""
POLICY, SUITE = {"source": "noop"}, {"envs": ["tabletop"]}
APP = {"import_path": "vlagents_ray.serve.app:build", "args": {"policy": "noop"}}
EVAL = [
    "eval",
    "tabletop",
    "--episodes",
    "1",
    "--workers",
    "0",
    "--video",
    "none",
    "--out",
    "out",
    "--policy",
]


def run(**changes: Any) -> str:
    return yaml.safe_dump({"policies": [POLICY], "suites": [SUITE]} | changes)


def served(**changes: Any) -> str:
    return yaml.safe_dump({"applications": [APP | changes]})


def with_args(**changes: Any) -> str:
    return served(args={"policy": "noop"} | changes)


# (words, parts of the message). A text in place of a word is the content of a file x.yaml, whose
# name becomes the word.
COMMANDS: dict[str, tuple[list[str], list[str]]] = {
    "no command of this name": (["evl"], ["evl", "eval"]),
    "no option of this name": (["eval", "tabletop", "--episods", "3"], ["--episods", "--episodes"]),
    "no out to resume": (["eval", "tabletop", "--policy", "noop", "--resume"], ["--out"]),
    "no policy": (["eval", "tabletop", "--out", "out"], ["--policy"]),
    "env misspelt": ([*EVAL, "noop", "tabeltop"], ["tabeltop", "tabletop"]),
    "policy misspelt": ([*EVAL, "noope"], ["noope", "noop"]),
    "policy file absent": ([*EVAL, "nope.yaml"], ["nope.yaml", "does not exist"]),
    "module absent": ([*EVAL, "absent:Policy"], ["absent"]),
    "class absent": ([*EVAL, "own:Nope"], ["Nope", "write the name of a class"]),
    "module with a syntax error": (
        [*EVAL, "syntax:Policy"],
        ["'syntax' raised SyntaxError", "syntax.py, line 1", "correct the module"],
    ),
    "module that raises": (
        [*EVAL, "raising:Policy"],
        ["'raising' raised ZeroDivisionError", "(raising.py:2)", "correct the module"],
    ),
    "module that needs another name": (
        [*EVAL, "importing:Policy"],
        ["'importing' raised ImportError", "absent_name", "(importing.py:1)"],
    ),
    "env in a module with a syntax error": (
        [*EVAL, "noop", "syntax:Env"],
        ["'syntax' raised SyntaxError", "correct the module"],
    ),
    "serve: module with a syntax error": (
        ["serve", "--set", "gain=1", "syntax:Policy"],
        ["'syntax' raised SyntaxError", "correct the module"],
    ),
    "an address without http": ([*EVAL, "localhost:8000"], ["'localhost:8000'", "http://"]),
    "a port beyond the last": ([*EVAL, "http://localhost:99999"], ["99999", "1 to 65535"]),
    "no agent": ([*EVAL, "own:NoAgent"], ["Agent"]),
    "setting misspelt": ([*EVAL, "noop", "--set", "chunks=2"], ["chunks", "chunk"]),
    "setting of another type": (
        [*EVAL, "noop", "--set", "delta=maybe"],
        ["delta", "'maybe'", "boolean", "true or false"],
    ),
    "setting without a value": ([*EVAL, "noop", "--set", "delta"], ["delta", "KEY=VALUE"]),
    "env setting misspelt": ([*EVAL, "noop", "--env-set", "maxsteps=3"], ["maxsteps", "max_steps"]),
    "env setting negative": ([*EVAL, "scripted", "--env-set", "width=-5"], ["width", "-5"]),
    "--workers 0 in a cluster": ([*EVAL, "noop", "--address", "auto"], ["--address", "workers"]),
    "too many episodes": (
        ["eval", "tabletop", "--policy", "noop", "--out", "o", "--episodes", "99999999999"],
        ["1000000"],
    ),
    "until without watch": ([*EVAL, "noop", "--until", "3"], ["--until", "--watch"]),
    "codec of another name": (
        ["eval", run(policies=[POLICY | {"codec": "png"}])],
        ["'png'", "'lossless'"],
    ),
    "transport of another name": (
        ["eval", run(policies=[POLICY | {"transport": "grpc"}])],
        ["'grpc'", "'auto'"],
    ),
    "file absent": (["eval", "nope.yaml"], ["nope.yaml", "does not exist; "]),
    "file with options of suites": (
        ["eval", run(), "--episodes", "3"],
        ["episodes", "write these settings in the file"],
    ),
    "file empty": (["eval", " "], ["a mapping with", "policies", "got an empty file"]),
    "file a list": (["eval", "- 1"], ["list", "a mapping with"]),
    "file with a tab": (["eval", "policies:\n\t- x"], ["not YAML", "line 2", "spaces"]),
    "key twice": (["eval", run(workers=0) + "workers: 3\n"], ["'workers'", "twice", "keep one"]),
    "key misspelt": (["eval", run(suites=[SUITE | {"episods": 3}])], ["episods", "episodes"]),
    "text for a number": (
        ["eval", run(suites=[SUITE | {"episodes": "two"}])],
        ["'two'", "integer"],
    ),
    "half an episode": (
        ["eval", run(suites=[SUITE | {"episodes": 2.5}])],
        ["expected a valid integer, got 2.5"],
    ),
    "negative": (["eval", run(suites=[SUITE | {"episodes": -2}])], ["-2", "1"]),
    "exponent": (["eval", run().replace("envs:", "episodes: 1e12\n  envs:")], ["1000000"]),
    "text for a list": (["eval", run(suites=[{"envs": "tabletop"}])], ["'tabletop'", "[tabletop]"]),
    "word of no list": (["eval", run(video="all_of_them")], ["all_of_them", "'failures'"]),
    "no space after a colon": (
        ["eval", run(policies=[{"source:scripted": None}])],
        ["write a space after the colon"],
    ),
    "entries without a dash": (
        ["eval", run(policies=POLICY)],
        ["policies: expected a valid list, got dict", "begin each of its entries"],
    ),
    "a word that YAML reads as a boolean": (
        ["eval", run(policies=[{"source": False}])],
        ["source: expected a valid string, got False", "quotation marks"],
    ),
    "a date": (
        ["eval", run().replace("source: noop", "source: 2026-01-01")],
        ["source: expected a valid string, got date", "quotation marks"],
    ),
    "a list as a path": (["eval", run(out=["a"])], ["out: expected a path, got list"]),
    "a number as a path": (["eval", run(out=5)], ["out: expected a path, got 5"]),
    "an anchor at the top": (
        ["eval", "a: &a [tabletop]\n" + run()],
        ["a: there is no such setting"],
    ),
    "an anchor in itself": (
        ["eval", "policies: &a [*a]\n"],
        ["not YAML", "names a value that contains it", "line 1"],
    ),
    "several documents": (["eval", run() + "---\n" + run()], ["not YAML", "document"]),
    "a tag of Python": (
        ["eval", "policies: !!python/object/apply:os.system [id]\n"],
        ["not YAML", "line 1"],
    ),
    "nested too deeply": (["eval", "policies: " + "[" * 3000], ["not YAML", "nested too deeply"]),
    "no entries": (["eval", run(policies=[])], ["policies: expected at least 1 entry, got none"]),
    "an empty key": (["eval", run(suites=None)], ["suites: expected a valid list, got nothing"]),
    "a number as a key": (
        ["eval", "1: 2\n" + run()],
        ["1: expected a name as a key", "quotation marks"],
    ),
    "a folder as a file": (["eval", "folder.yaml"], ["expected a file, got a folder"]),
    "slurm: setup absent": (
        ["slurm", "serve", "noop", "--dry-run", "--setup", "no.sh"],
        ["--setup: expected a file of shell lines", "no.sh"],
    ),
    "no source": (["eval", run(policies=[{"name": "x"}])], ["source", "url"]),
    "source and url": (
        ["eval", run(policies=[POLICY | {"url": "http://x:1"}])],
        ["source", "url", "both"],
    ),
    "one name twice": (["eval", run(policies=[POLICY, POLICY])], ["name"]),
    "many steps": (
        ["eval", run(policies=[POLICY | {"steps": {"first": 0, "last": 10**9, "every": 1}}])],
        ["10000", "every"],
    ),
    "serve: file absent": (["serve", "nope.yaml"], ["nope.yaml", "does not exist"]),
    "serve: key misspelt": (["serve", with_args(replicsa=2)], ["replicsa", "replicas"]),
    "serve: batch of 0": (["serve", with_args(batch={"max_size": 0})], ["max_size", "1"]),
    "serve: replicas without end": (["serve", with_args(replicas=10**9)], ["replicas", "10000"]),
    "serve: import path": (
        ["serve", served(import_path="vlagents_ray.serve.ap:build")],
        ["import_path", "'vlagents_ray.serve.app:build'"],
    ),
    "serve: file empty": (["serve", " "], ["mapping", "applications"]),
    "serve: hub id": (["serve", "lerobot/smolvla_base"], ["deployments/lerobot.yaml"]),
    "serve: no checkpoint": (
        ["serve", "pi0"],
        ["checkpoint", "deployments/pi0.yaml", "docs/policies/pi0.md"],
    ),
    "serve: no keys": (["serve", "noop", "--host", "0.0.0.0"], ["keys create", "--insecure"]),  # noqa: S104
    "serve: keys file absent": (
        ["serve", "noop", "--keys", "nope.json"],
        ["nope.json", "keys create"],
    ),
    "serve: half of TLS": (["serve", "noop", "--tls-cert", "x.pem"], ["--tls-key"]),
    "serve: text for a port": (
        ["serve", "noop", "--port", "80x"],
        ["--port", "expected a valid integer, got '80x'"],
    ),
    "serve: port beyond the last": (
        ["serve", "noop", "--port", "99999"],
        ["--port", "got '99999'", "65535"],
    ),
    "serve: a module's file": (["serve", "own.py"], ["'own:MyPolicy'", "'own.py'"]),
    "serve: a module": (["serve", "own"], ["'own:MyPolicy'"]),
    "serve: a module by its path": (["serve", "./own.py"], ["'own:MyPolicy'"]),
    "serve: a folder": (["serve", "."], ["deployment file (.yaml)", "folder '.'"]),
    "eval: a module's file": ([*EVAL, "own.py"], ["'own:MyPolicy'"]),
    "key: expired before": (
        ["keys", "create", "x", "--days", "-5"],
        ["--days", "got '-5'", "0.001"],
    ),
    "key: expired at once": (["keys", "create", "x", "--days", "0"], ["--days", "0.001"]),
    "key: name": (["keys", "create", "a b"], ["'a b'", "letters"]),
    "key: rate": (["keys", "create", "x", "--rate", "0"], ["--rate", "0.001"]),
    "keys: a folder": (
        ["keys", "list", "--keys", "."],
        ["expected a key file", "folder .", "keys.json"],
    ),
    "key: a folder": (["keys", "create", "x", "--keys", "."], ["expected a key file", "folder ."]),
    "key: scope": (["keys", "create", "x", "--scope", "wach"], ["'wach'", "did you mean 'watch'"]),
    "key: priority": (
        ["keys", "create", "x", "--priority", "simulaton"],
        ["did you mean 'simulation'"],
    ),
    "key: revoke without a file": (["keys", "revoke", "x"], ["keys create"]),
    "key: revoke another": (
        ["keys", "revoke", "arm1", "--keys", "k.json"],
        ["arm1", "'arm-1'", "did you mean"],
    ),
    "new: kind": (["init", "polic", "x"], ["polic", "policy"]),
    "init: name": (["init", "policy", "1 bad"], ["1 bad", "my_policy"]),
    "init: installed": (["init", "policy", "numpy"], ["'numpy'", "hide"]),
    "init: keyword": (["init", "policy", "class"], ["'class'", "module"]),
    "venv create": (["venv", "create", "nothing.txt"], ["nothing.txt", "requirements file"]),
    "venv create: misspelt": (["venv", "create", "lerobt"], ["'lerobt'", "did you mean 'lerobot'"]),
    "policies: misspelt": (["policies", "opnpi"], ["'opnpi'", "'openpi'"]),
    "report: nothing there": (["report", "nowhere"], ["nowhere", "results"]),
    "report: empty database": (["report", "emptied"], ["results.db", "empty file"]),
    "report: text as database": (["report", "texted"], ["results.db"]),
    "eval: tracker": (
        ["eval", "tabletop", "--policy", "noop", "--track", "wandbb", "--dry-run", "--out", "o"],
        ["got 'wandbb', which is not registered", "'wandb'"],
    ),
    "export: kind": (["export", "nowhere", "--out", "x.csv", "--to", "xlsx"], ["'xlsx'", "csv"]),
    "export: setting": (
        ["export", "done", "--out", "x.csv", "--to", "csv", "--set", "cut_idle=true"],
        ["--set, for --to csv", "cut_idle: there is no such setting"],
    ),
    "export: folder": (
        ["export", "done", "--out", "no/x.csv", "--to", "csv"],
        ["no", "create it first"],
    ),
    "bundle: folder": (["bundle", "nowhere", "--out", "no/x.zip"], ["no/x.zip", "create it first"]),
    "export: a dataset": (
        ["export", "dataset", "--out", "x.csv", "--to", "csv"],
        ["expected results of an evaluation, got a LeRobotDataset"],
    ),
    "export: a folder as the file": (
        ["export", "done", "--to", "csv", "--out", "."],
        ["expected a file", "folder"],
    ),
    "bundle: a folder as the file": (
        ["bundle", "done", "--out", "."],
        ["expected a file", "folder"],
    ),
    "verify: a text": (["verify", "own.py"], ["own.py"]),
    "verify: a folder": (["verify", "."], [".: expected a bundle", "got a folder"]),
    "verify: results": (
        ["verify", "done"],
        ["got a folder of results", "`vlagents-ray bundle done`"],
    ),
    "verify: nothing": (["verify", "nowhere"], ["nowhere", "got no file"]),
    "merge: a folder twice": (["merge", "done", "./done/", "--out", "m"], ["done: is named twice"]),
    "merge: a folder by a link": (
        ["merge", "done", "link", "--out", "m"],
        ["link: is named also as done"],
    ),
    "report: a folder twice": (["report", "done", "done"], ["done: is named twice"]),
    "demo: a file": (["demo", "--out", "own.py"], ["own.py: expected a folder, got a file"]),
    "doctor: no such Python": (
        ["doctor", "--python", "nowhere"],
        ["--python", "nowhere", ".venv-lerobot/bin/python"],
    ),
    "doctor: an environment's folder": (
        ["doctor", "--python", "venv"],
        ["a folder; did you mean venv/bin/python?"],
    ),
    "venv create: a module": (
        ["venv", "create", "own.py", "--out", "e"],
        ["own.py", "requirements file"],
    ),
    "replay: nothing there": (["replay", "nowhere"], ["nowhere", "results.db"]),
    "replay: no episode": (["replay", "done"], ["expected a key such as ['tabletop#0@0:"]),
    "replay: a dataset": (["replay", "dataset"], ["dataset", "vlagents-ray open-loop dataset"]),
    "open-loop: nothing there": (
        ["open-loop", "nowhere", "--policy", "noop"],
        ["nowhere", "LeRobotDataset"],
    ),
    "open-loop: no policy": (["open-loop", "dataset"], ["--policy"]),
    "open-loop: episodes": (
        ["open-loop", "dataset", "--policy", "noop", "--episodes", "a-b"],
        ["'a-b'", "0-9,12"],
    ),
}
# Mistakes that are found when the environment is created, after the folder of results.
MADE = {"env setting negative"}
# These run in this process until the policy's error: (policy, parts of the message).
EPISODES = {
    "WithoutAct": ["act or act_batch"],
    "WrongKey": ["KeyError", "own.py:", "its process wrote the traceback to stderr"],
    "WrongShape": ["(3,)", "4"],
    "NotFinite": ["NaN or infinity"],
    "Enormous": ["size 1e+30", "at most 1e+09"],
    "Text": ["str", "Act"],
    "Ends": ["SystemExit"],
    "EndsItsProcess": ["os._exit(0)", "raise an exception instead", "own.py:"],
    "DoesNotLoad": ["weights.bin", "own.py:"],
}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("results") / "done"
    options = [
        "--episodes",
        "1",
        "--workers",
        "0",
        "--video",
        "none",
        "--env-set",
        "max_steps=2",
        "--out",
        str(path),
    ]
    done = CliRunner().invoke(app, ["eval", "tabletop", "--policy", "scripted", *options])
    assert done.exit_code == 0, done.output
    return path


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, results: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own", raising=False)
    # Otherwise Python would write a cache next to own.py, which would look like a result.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "own.py").write_text(POLICIES)
    (tmp_path / "syntax.py").write_text("class Policy(:\n")
    (tmp_path / "raising.py").write_text("a = 0\nb = 1 / a\n")
    (tmp_path / "importing.py").write_text("from json import absent_name\n")
    (tmp_path / "folder.yaml").mkdir()
    for name, text in (("emptied", ""), ("texted", "no database")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.db").write_text(text)
    (tmp_path / "dataset" / "meta").mkdir(parents=True)
    (tmp_path / "dataset" / "meta" / "info.json").write_text("{}")
    (tmp_path / "done").symlink_to(results)
    (tmp_path / "link").symlink_to(results)
    (tmp_path / "venv/bin").mkdir(parents=True)
    (tmp_path / "venv/bin/python").touch()
    key = {"name": "arm-1", "sha256": "0" * 64}
    (tmp_path / "k.json").write_text(json.dumps({"keys": [key]}))
    return tmp_path


def answer(words: list[str]) -> tuple[int, str]:
    """Run a command line in this process, and return its status and its message on one line."""
    began = time.process_time()
    done = CliRunner().invoke(app, words, env={"COLUMNS": "1000", "TERMINAL_WIDTH": "1000"})
    assert time.process_time() - began < LONGEST_S
    assert done.exception is None or isinstance(done.exception, SystemExit), repr(done.exception)
    assert "Traceback" not in done.output
    return done.exit_code, " ".join(done.output.split())


@pytest.mark.slow
@pytest.mark.parametrize("mistake", COMMANDS)
def test_a_mistake_on_the_command_line_is_answered_with_its_cure(
    mistake: str, folder: Path
) -> None:
    words, parts = COMMANDS[mistake]
    (folder / "x.yaml").write_text(words[1] if len(words) > 1 else "")
    before = sorted(os.listdir(folder))
    is_text = len(words) > 1 and (":" in words[1] or words[1] in (" ", "- 1"))
    status, message = answer([words[0], "x.yaml", *words[2:]] if is_text else words)
    assert status == 2, message
    assert [part for part in parts if part not in message] == [], message
    assert sorted(os.listdir(folder)) == sorted([*before, *(["out"] if mistake in MADE else [])])


@pytest.mark.parametrize(
    "words",
    [
        ["keys", "create", "x", "--keys", "new.json"],
        *(["init", kind, "mine"] for kind in ("policy", "env", "dialect", "plugin")),
    ],
    ids=" ".join,
)
def test_a_full_disk_is_named_and_nothing_is_left(
    words: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, real = sorted(os.listdir(folder)), Path.open

    def opened(path: Path, mode: str = "r", **options: Any) -> Any:
        if mode != "x":
            return real(path, mode, **options)
        path.touch()
        return open("/dev/full", "w")

    def of_descriptor(descriptor: int, *_: Any, **_options: Any) -> Any:
        os.close(descriptor)
        return open("/dev/full", "w")

    monkeypatch.setattr(Path, "open", opened)
    monkeypatch.setattr(os, "fdopen", of_descriptor)
    status, message = answer(words)
    assert (status, message) == (
        1,
        "Error: the disk is full (No space left on device); make room, and repeat the command",
    )
    assert sorted(os.listdir(folder)) == before


@pytest.mark.parametrize(
    ("word", "guess"), [("robbot", "; did you mean 'robot'?\n"), ("serve", ".\n")]
)
def test_a_command_that_the_light_install_lacks_is_answered_with_those_that_it_has(
    word: str, guess: str
) -> None:
    program = "import sys; sys.modules['typer'] = None; from vlagents_ray.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, word], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert f"this is the light install of a robot's computer{guess}" in done.stderr
    assert pip_install("serve") in done.stderr
    assert done.stderr.startswith("Error: 'typer' is not installed")


@pytest.mark.parametrize(("words", "status"), [(["-h"], 0), (["--help"], 0), ([], 2)])
def test_the_help_of_the_light_install_has_its_commands_and_what_the_others_need(
    words: list[str], status: int
) -> None:
    program = "import sys; sys.modules['typer'] = None; from vlagents_ray.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, *words],
        capture_output=True, text=True, check=False, env={**os.environ, "COLUMNS": "100"},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (status, "")
    words_of_help = " ".join(done.stdout.split())
    assert "robot Drive a robot or simulation with a policy, an operator, or both." in words_of_help
    for extra in ("serve", "sim"):
        assert " ".join(pip_install(extra).split()) in words_of_help


def test_the_light_install_names_all_commands_that_it_lacks() -> None:
    commands = get_command(app).commands  # type: ignore[attr-defined]
    of_plugins = set(names("commands"))
    assert {"robot", *itertools.chain(*OTHERS.values())} == set(commands) - of_plugins
    assert commands["robot"].help.strip() == ROBOT


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["nonsense"],
        ["serve"],
        ["serve", "no-such-policy"],
        ["eval", "tabletop", "--nonsense"],
        ["eval", "tabletop"],
        ["robot", "--nonsense"],
        ["robot", "nonsense"],
        ["robot", "check"],
        ["robot", "check", "nonsense:Arm"],
        ["slurm", "nonsense"],
    ],
    ids=" ".join,
)
def test_all_errors_of_commands_have_one_form(words: list[str]) -> None:
    """Of click, of argparse, of this package and of its plug-ins."""
    done = subprocess.run(
        [sys.executable, "-m", "vlagents_ray", *words], capture_output=True, text=True, check=False
    )
    assert done.returncode
    [line] = [line for line in done.stderr.splitlines() if line.lower().startswith("error")]
    assert line.startswith("Error: "), line


@pytest.mark.slow
@pytest.mark.parametrize("policy", EPISODES)
def test_a_mistake_in_a_policy_is_answered_with_its_place(policy: str) -> None:
    status, message = answer([*EVAL, f"own:{policy}"])
    assert status in (1, 2, 3), message
    error = message.rpartition(" error ")[2] or message
    assert [part for part in EPISODES[policy] if part not in error] == [], message


IMAGE, STATE = np.zeros((4, 4, 3), np.uint8), np.zeros(6, np.float32)
OBSERVATIONS = {
    "none": None,
    "a dict": {"front": IMAGE},
    "an array": IMAGE,
    "cameras a list": Obs([IMAGE]),  # type: ignore[arg-type]
    "state an array": Obs({}, state=STATE),  # type: ignore[arg-type]
    "image none": Obs({"front": None}),  # type: ignore[dict-item]
    "image a list": Obs({"front": [[1, 2], [3]]}),  # type: ignore[dict-item]
    "state none": Obs(state={"q": None}),  # type: ignore[dict-item]
    "state text": Obs(state={"q": "hello"}),  # type: ignore[dict-item]
    "state texts": Obs(state={"q": ["a", "b"]}),  # type: ignore[dict-item]
    "state ragged": Obs(state={"q": [[1, 2], [3]]}),  # type: ignore[dict-item]
    "state a set": Obs(state={"q": {1, 2}}),  # type: ignore[dict-item]
    "state complex": Obs(state={"q": np.zeros(6, complex)}),
    "state an array of text": Obs(state={"q": np.array(["1", "2"])}),
    "gripper text": Obs(gripper="open"),  # type: ignore[arg-type]
    "info a list": Obs(info=[1]),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("mistake", OBSERVATIONS)
def test_what_is_no_observation_is_not_sent(mistake: str) -> None:
    with pytest.raises(InvalidObservation, match=r"expected .*got "):
        require_obs(OBSERVATIONS[mistake])


def test_an_observation_may_hold_lists_and_other_numbers() -> None:
    require_obs(
        Obs(
            {"front": IMAGE},
            1,
            {"q": [1, 2.5], "w": np.arange(3), "b": np.ones(2, bool)},
            {"a": [1]},
        )
    )  # type: ignore[dict-item]
    require_obs(Obs(gripper=np.float32(0.5)))  # type: ignore[arg-type]
