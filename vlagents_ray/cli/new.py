"""Skeletons of a policy, an environment and a dialect, which work at once and pass their own tests."""

from __future__ import annotations

import importlib.util
import keyword
import re
from collections.abc import Mapping
from pathlib import Path
from string import Template
from typing import Annotated

import typer

from vlagents_ray.cli.console import errors, out
from vlagents_ray.errors import ConfigError

new = typer.Typer(no_args_is_help=True, help="Write a working skeleton, with its test, into the current folder.")
Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the module: lower case, such as my_policy.")]

_POLICY = {
    "$name.py": '''\
"""The policy $title: put your model in place of what `initialize` and `act_batch` do."""

import numpy as np
from pydantic import BaseModel, Field

from vlagents_ray import Act, ActionSpec, Agent, CameraSpec, Contract, StateSpec


class ${title}Config(BaseModel, extra="forbid"):
    """The settings: `config:` in $name.yaml, or `--set gain=0.5` on the command line."""

    gain: float = Field(default=1.0, ge=0, le=1, description="scales every action")


class $title(Agent):
    """Answers with actions that follow from the pose alone, by random weights."""

    Config = ${title}Config
    shared = ("config", "weights")  # what all sessions share; each session has its own copy of everything else

    def __init__(self, config=None):
        self.config = config or ${title}Config()

    @property
    def contract(self):
        """What the policy needs and gives: a robot or an environment that does not fit is refused."""
        return Contract(
            cameras={"front": CameraSpec()},  # of any size; CameraSpec(224, 224) of one
            state={"xyzrpy": StateSpec(6, "m+rad")},
            action=ActionSpec(dim=4, delta=True),
        )

    def initialize(self):
        """Load the weights, once in a replica and before the first session.

        An evaluation identifies them by the files that the settings name. For weights from elsewhere set
        `self.weights_id = {"digest": "...", "revision": None}`, so that results of two weights are not mixed.
        """
        self.weights = np.random.default_rng(0).normal(0, 0.3, (6, 4)).astype(np.float32)

    def reset(self, obs, instruction, **kwargs):
        """Begin an episode, on a copy of the policy that belongs to this session alone."""
        self.instruction = instruction
        return {}

    def act_batch(self, obs, sessions):
        """One forward pass for all sessions that wait: `sessions[i]` is the copy that `obs[i]` belongs to."""
        poses = np.stack([one.state["xyzrpy"] for one in obs]).astype(np.float32)  # (B, 6)
        actions = self.config.gain * np.tanh(poses @ self.weights)  # (B, 4)
        return [Act(action) for action in actions]
''',
    "test_$name.py": """\
from $name import $title

from vlagents_ray.testing import check_agent


def test_the_policy_keeps_its_contract():
    check_agent($title())  # a policy that parses its instructions needs its own: instructions=["go home"]
""",
    "$name.yaml": """\
# vlagents-ray serve $name.yaml
applications:
  - name: $name
    route_prefix: /
    import_path: vlagents_ray.serve.app:build
    args:
      policy: $name:$title
      config: {gain: 1.0}
      batch: {max_size: 16}
      resources: {num_gpus: 0}
""",
}
_ENV = {
    "$name.py": '''\
"""The environment $title: put your simulator in place of the point that moves.

An evaluation identifies it by this file, the modules that it imports, and the files that its options name.
"""

import numpy as np

from vlagents_ray import ActionSpec, CameraSpec, Contract, Obs, StateSpec
from vlagents_ray.envs.base import EvalEnv, one_row


class $title(EvalEnv):
    """A point on a square of 2 m has to come within 0.1 m of a goal."""

    max_steps = 100

    def __init__(self, size=96):  # pixels; `--env-set size=128`, or `env_options: {size: 128}` in a file of runs
        self.size = size

    @property
    def contract(self):
        """What the environment gives and takes: a policy that does not fit is refused."""
        return Contract(
            cameras={"front": CameraSpec(self.size, self.size)},
            state={"position": StateSpec(2, "m"), "goal": StateSpec(2, "m")},
            instruction=True,
            action=ActionSpec(dim=2, space="ee_position", delta=True, low=-1.0, high=1.0),
            control_hz=10.0,
        )

    @property
    def instruction(self):
        return "move the point to the goal"

    def reset(self, *, seed, options=None):
        """Begin the episode of this seed: the same seed gives the same episode, whatever was played before."""
        rng = np.random.default_rng(seed)
        self.position, self.goal = rng.uniform(-1, 1, (2, 2)).astype(np.float32)
        self.steps = 0
        return self.observe(), {}

    def step(self, act):
        """Take one action, (2,): a share of the 0.1 m that the point moves at most."""
        action = np.clip(one_row(act, self.contract), -1, 1)
        self.position = np.clip(self.position + 0.1 * action, -1, 1).astype(np.float32)
        self.steps += 1
        distance = float(np.linalg.norm(self.goal - self.position))
        success = distance < 0.1
        return self.observe(), -distance, success, self.steps >= self.max_steps, {"success": success}

    def observe(self):
        """New arrays each time: the caller keeps the last ones."""
        picture = np.full((self.size, self.size, 3), 255, np.uint8)  # RGB
        for place, colour in ((self.goal, (0, 160, 0)), (self.position, (200, 0, 0))):
            x, y = ((place + 1) / 2 * (self.size - 9)).astype(int)
            picture[y : y + 9, x : x + 9] = colour
        state = {"position": self.position.copy(), "goal": self.goal.copy()}
        return Obs(cameras={"front": picture}, state=state)

    def close(self):
        pass
''',
    "test_$name.py": """\
from $name import $title

from vlagents_ray.testing import check_env


def test_the_environment_keeps_its_contract():
    check_env($title())
""",
    "$name.yaml": """\
# vlagents-ray eval $name.yaml
policies:
  - {source: random, config: {action_dim: 2}}
suites:
  - {envs: ["$name:$title"], episodes: 10}
workers: 2
video: failures
""",
}
_DIALECT = {
    "$name.py": '''\
"""The dialect $title: put your client's protocol in place of `decode`, `encode` and the path."""

import json

from vlagents_ray.serve.config.dialects import DialectConfig, MappingSetting
from vlagents_ray.serve.dialects.http import HttpDialect
from vlagents_ray.wire import json_numpy


def decode(data, limits):
    """Read the body of a request, such as {"q": [0.0, ...], "task": "lift the cup"}, within the server's limits."""
    return json_numpy.loads(data, limits)


def encode(row):
    """Write an action, (D,) float32, as the client reads it: a list of numbers."""
    return json.dumps(row.tolist()).encode()


class ${title}Config(DialectConfig):
    """The settings: `dialects:` in $name.yaml."""

    mapping: MappingSetting = {"state": {"joints": "q"}, "instruction": "task"}  # our names: the client's


class $title(HttpDialect):
    """Answers each POST with one action."""

    Config = ${title}Config
    clients = "$name"
    paths = {"POST /$name": "act"}  # the method that serves each of them

    async def act(self, http):
        return await self.answer(
            http, lambda data, budget: decode(data, budget.limits), lambda rows: encode(rows[0])
        )
''',
    "test_$name.py": """\
import numpy as np
import pytest
from $name import $title, decode, encode

from vlagents_ray.errors import MalformedMessage
from vlagents_ray.protocol.messages import DEFAULT_LIMITS
from vlagents_ray.serve.config.dialects import DialectArgs


def test_an_observation_is_read_and_an_action_written():
    assert decode(b'{"q": [0.5, 0.25], "task": "lift the cup"}', DEFAULT_LIMITS)["q"] == [0.5, 0.25]
    assert encode(np.array([0.5, 1], np.float32)) == b"[0.5, 1.0]"


def test_garbage_is_refused():
    with pytest.raises(MalformedMessage):
        decode(b"\\x00garbage", DEFAULT_LIMITS)


def test_a_deployment_file_may_name_it():
    settings = DialectArgs(**{"$name:$title": {}})
    assert isinstance(getattr(settings, "$name:$title"), $title.Config)
""",
    "$name.yaml": """\
# vlagents-ray serve $name.yaml
applications:
  - name: $name
    route_prefix: /
    import_path: vlagents_ray.serve.app:build
    args:
      policy: noop
      dialects: {"$name:$title": {}}
      resources: {num_gpus: 0}
""",
}


@new.command()
def policy(name: Name) -> None:
    """Write NAME.py, test_NAME.py and NAME.yaml: a policy of your own, its test, and its deployment file."""
    with errors():
        _write(name, _POLICY)
        out.print(f"vlagents-ray serve {name}.yaml                    serves it")
        out.print(f"vlagents-ray eval tabletop --policy {name}.yaml   evaluates it")


@new.command("env")
def environment(name: Name) -> None:
    """Write NAME.py, test_NAME.py and NAME.yaml: an environment of your own, its test, and a file of runs."""
    with errors():
        _write(name, _ENV)
        out.print(f"vlagents-ray eval {name}.yaml   plays ten episodes in it")


@new.command()
def dialect(name: Name) -> None:
    """Write NAME.py, test_NAME.py and NAME.yaml: a protocol of your own, its test, and a deployment file."""
    with errors():
        _write(name, _DIALECT)
        out.print(f"vlagents-ray serve {name}.yaml   serves a policy that does nothing; then, in a second terminal:")
        out.print(f'curl -d \'{{"q": [0, 0], "task": "lift the cup"}}\' http://localhost:8000/{name}')


def _write(name: str, files: Mapping[str, str]) -> None:
    """Write the files into the current folder, or none of them. Raises `ConfigError` for a name that cannot be."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        raise ConfigError(f"NAME: got {name!r}, want the name of a Python module in lower case, such as my_policy")
    names = {"name": name, "title": "".join(word.title() for word in name.split("_"))}
    texts = {Path(Template(path).substitute(names)): Template(text).substitute(names) for path, text in files.items()}
    there = [str(path) for path in texts if path.exists()]
    if there:
        raise ConfigError(f"{', '.join(there)}: there already, and nothing was written; choose another NAME")
    if importlib.util.find_spec(name) is not None:
        raise ConfigError(f"NAME: {name!r} is a module that is installed, and yours would hide it; choose another one")
    for path, text in texts.items():
        with path.open("x") as file:
            file.write(text)
    out.print(f"wrote {', '.join(map(str, texts))}. Next, in this folder:")
    out.print(f"pytest test_{name}.py   checks it")
