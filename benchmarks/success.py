"""Tests whether optimizations of a policy, or the transport of its images and actions, cost
success.

The reference policy runs the same seeds of the tabletop with each setting: eager and without Ray,
which is the standard; compiled, in bfloat16, in 8 bits; in batches; over each transport; with JPEG;
with averaged chunks; with a LoRA adapter; after a push; behind `upstream` with each protocol. A
paired test (McNemar, adjusted by Holm for all settings) compares each setting with the standard.
The actions of each episode are also compared bit by bit. `benchmarks.delays` measures late answers.
"""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

from benchmarks.console import Out, save
from vlagents_ray import RemoteAgent
from vlagents_ray.cli.console import errors, out, table
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.errors import ConfigError, MissingDependency, VLAgentsError
from vlagents_ray.evaluate import EvalConfig, PolicyConfig, Results, SuiteConfig, evaluate
from vlagents_ray.evaluate.results.statistics import (
    Pairs,
    difference_interval,
    holm,
    mcnemar,
)
from vlagents_ray.images.codecs import ImageCodec
from vlagents_ray.interface import Agent
from vlagents_ray.naming import plain
from vlagents_ray.policies.base.adapter import CONFIG as ADAPTER_CONFIG
from vlagents_ray.policies.base.adapter import WEIGHTS as ADAPTER_WEIGHTS
from vlagents_ray.policies.reference import Reference
from vlagents_ray.policies.reference.checkpoint import WEIGHTS
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray.serve.ports import free_port
from vlagents_ray.success import wilson
from vlagents_ray.weights.safetensors import read_values, write_values
from vlagents_ray_dialects.upstream import Upstream
from vlagents_ray_learn import Publisher

STANDARD = "eager, in this process"
APP = "reference"
CHUNK, EXECUTE = 8, 4  # number of rows of a chunk, and number of executed rows
TOGETHER = 16  # number of episodes of a batch
QUALITIES = (30, 50, 70, 85, 95)  # qualities of JPEG; 85 is the client's default
_RAW = ImageCodec("raw")
# The layer with an adapter of rank 4 of random weights, small enough that success remains.
_ADAPTED = "context"
_KEYS = {
    "cameras": {"front": "observation/image", "wrist": "observation/wrist_image"},
    "state": {"xyzrpy": "observation/state"},
    "gripper": {"key": "observation/gripper"},
    "instruction": "prompt",
}
_VLA_EVAL = {
    "cameras": {"front": "images/agentview", "wrist": "images/wrist"},
    "state": {"xyzrpy": "states"},
    "gripper": {"key": "gripper"},
    "instruction": "task_description",
}
_GR00T = {
    "preset": "gr00t",
    "cameras": {"front": "video/front", "wrist": "video/wrist"},
    "state": {"xyzrpy": "state/xyzrpy"},
    "gripper": {"key": "state/gripper"},
    "action": {"arm": {"stop": 3}, "gripper": {"start": 3}},
}
_VLAGENTS = {
    "cameras": {"front": "arm/cameras/front", "wrist": "arm/cameras/wrist"},
    "state": {"xyzrpy": "arm/xyzrpy"},
    "gripper": {"key": "arm/gripper"},
    "instruction": "language_instruction",
}
# Scheme and path of the URL, and the mapping. RoboArena has no name for relative actions.
PROTOCOLS: dict[str, tuple[str, Any]] = {
    "openpi": ("ws://{host}/openpi", _KEYS),
    "openpi-batch": ("ws://{host}/openpi", _KEYS),
    "openvla": ("http://{host}/act", _KEYS),
    "vla_eval": ("ws://{host}/vla-eval", _VLA_EVAL),
    "gr00t": ("tcp://127.0.0.1:{gr00t}", _GR00T),
    "vlagents": ("rpyc://127.0.0.1:{vlagents}", _VLAGENTS),
}


@dataclass(frozen=True)
class Way:
    """A setting with which the reference policy is served."""

    name: str
    config: dict[str, Any] = field(default_factory=dict)  # settings of the policy
    adapter: bool = False  # whether an adapter is merged into the weights
    transport: TransportName | None = None  # transport; None if the policy is in this process
    codec: ImageCodec = _RAW
    upstream: str | None = None  # protocol of the upstream
    pushed: bool = False  # whether the server began with other weights
    together: int = 1  # number of episodes that run at the same time
    execute: int = EXECUTE
    equal: bool = False  # whether actions must be bit-identical to the standard


def ways() -> list[Way]:
    """Return all transports and settings, the standard first."""
    return [
        Way(STANDARD),
        Way("again", equal=True),
        Way("torch.compile", {"compile": "require", "batch_sizes": [1]}),
        Way("bfloat16", {"dtype": "bfloat16"}),
        Way("int8 weights", {"quantization": "int8"}),
        Way(f"batches of {TOGETHER}", transport="shm", together=TOGETHER),
        *(
            Way(name, transport=name, equal=True)
            for name in ("shm", "plasma", "websocket", "http", "handle")
        ),
        Way("lossless images", transport="websocket", codec=ImageCodec("lossless"), equal=True),
        *(
            Way(f"JPEG, quality {one}", transport="websocket", codec=ImageCodec("jpeg", one))
            for one in QUALITIES
        ),
        Way("after a push", transport="shm", pushed=True, equal=True),
        *(Way(f"upstream, {name}", upstream=name) for name in PROTOCOLS),
        Way(f"open loop, all {CHUNK} rows", execute=CHUNK),
        Way("ensemble", {"actions": "ensemble"}, execute=1),
        Way("LoRA merged", adapter=True),
    ]


@dataclass(frozen=True)
class Played:
    """The episodes with a setting, by seed: whether they were solved, and the digest of their
    actions.
    """

    way: Way
    episodes: dict[int, tuple[bool, str]]
    act_ms: float  # median over episodes of the median durations of calls, including transport, ms

    @property
    def solved(self) -> int:
        return sum(solved for solved, _ in self.episodes.values())


class Players:
    """Runs settings with one server, which starts with the first setting that needs it."""

    def __init__(self, checkpoint: Path, folder: Path, episodes: int) -> None:
        self._checkpoint, self._folder, self._episodes = (
            checkpoint.resolve(),
            folder.resolve(),
            episodes,
        )
        self._stack = contextlib.ExitStack()
        # host:port of the server, and ports of the dialects
        self._server: tuple[str, dict[str, int]] | None = None

    def __enter__(self) -> Players:
        return self

    def __exit__(self, *raised: object) -> None:
        self._stack.close()

    def play(self, way: Way) -> Played:
        """Run the episodes of a setting that have no result in the folder yet, and return all
        episodes.
        """
        cameras: dict[str, Any] = {"cameras": ["front", "wrist"], "width": 64, "height": 64}
        suite = SuiteConfig(
            envs=["tabletop"],
            env_options=cameras,
            episodes=self._episodes,
            num_envs=way.together,
        )
        policy = PolicyConfig(name=way.name, config=way.config, execute=way.execute)
        place = self._folder / plain(way.name)
        plan = EvalConfig(
            policies=[policy], suites=[suite], out=place, video="none", workers=0, resume=True
        )
        evaluate(plan, agent_factory=lambda: self._agent(way))
        counted = [one for case in Results.load(place).cases for one in case.counted]
        found = {one.key.seed: (bool(one.success_once), str(one.actions_sha256)) for one in counted}
        return Played(
            way, found, float(np.median([one.policy_ms for one in counted if one.policy_ms]))
        )

    def _agent(self, way: Way) -> Agent:
        if way.upstream is not None:
            return self._behind(way.upstream)
        if way.transport is None:
            return Reference.from_config(self._config(way))
        host, _ = self._serve()
        url = f"serve://{APP}" if way.transport in ("plasma", "handle") else f"http://{host}"
        if way.pushed:
            self._push()
        return RemoteAgent(url, transport=way.transport, codec=way.codec)

    def _behind(self, protocol: str) -> Agent:
        host, ports = self._serve()
        url, mapping = PROTOCOLS[protocol]
        contract = {"action": {"dim": 4}, "chunk": 1 if protocol == "vla_eval" else CHUNK}
        config = {
            "protocol": protocol,
            "urls": [url.format(host=host, **ports)],
            "contract": contract,
        }
        return Upstream.from_config(config | {"mapping": mapping})

    def _config(self, way: Way) -> dict[str, Any]:
        config = {"checkpoint": str(self._checkpoint), "embodiment": "tabletop"} | way.config
        return config | ({"adapter": str(self._adapter())} if way.adapter else {})

    def _serve(self) -> tuple[str, dict[str, int]]:
        if self._server is None:
            ports = {name: free_port() for name in ("gr00t", "vlagents")}
            dialects = {
                "openpi": {"mapping": _KEYS},
                "openvla": {"mapping": _KEYS, "chunk": True},
                "vla_eval": {"mapping": _VLA_EVAL, "execute": EXECUTE},
                "gr00t": {"mapping": _GR00T, "port": ports["gr00t"]},
                "vlagents": {"port": ports["vlagents"]},
            }
            batch = {"max_size": TOGETHER}  # a single request of a session is a batch of one
            document = deployment(
                "reference", config=self._config(Way(STANDARD)), batch=batch, dialects=dialects
            )
            document.applications[0].name = APP
            server = self._stack.enter_context(running_server(document, num_cpus=2))
            self._server = server.url.removeprefix("http://"), ports
        return self._server

    def _weights(self) -> dict[str, np.ndarray]:
        with (self._checkpoint / WEIGHTS).open("rb") as file:
            return {name: np.array(value) for name, value in read_values(file).items()}

    def _push(self) -> None:
        """Push other weights, then the checkpoint's weights."""
        values = self._weights()
        with Publisher(f"serve://{APP}") as learner:
            learner.push({name: -value for name, value in values.items()}, pin=True)
            learner.push(values, pin=True)

    def _low_rank(self) -> tuple[np.ndarray, np.ndarray]:
        """Return A (4, inputs) and B (outputs, 4), whose product has a hundredth of the norm of
        the layer's weights.
        """
        weight = self._weights()[f"{_ADAPTED}.weight"]
        rng = np.random.default_rng(0)
        down, up = (
            rng.standard_normal(shape, np.float32)
            for shape in ((4, weight.shape[1]), (weight.shape[0], 4))
        )
        return down, up * np.float32(0.01 * np.linalg.norm(weight) / np.linalg.norm(up @ down))

    def _adapter(self) -> Path:
        folder = self._folder / "adapter"
        folder.mkdir(parents=True, exist_ok=True)
        settings = {"peft_type": "LORA", "r": 4, "lora_alpha": 4, "target_modules": [_ADAPTED]}
        text = json.dumps(settings | {"base_model_name_or_path": str(self._checkpoint)})
        (folder / ADAPTER_CONFIG).write_text(text)
        named = zip("AB", self._low_rank(), strict=True)
        with (folder / ADAPTER_WEIGHTS).open("wb") as file:
            write_values(
                file,
                {f"base_model.model.{_ADAPTED}.lora_{name}.weight": value for name, value in named},
            )
        return folder


def compared(found: Sequence[Played]) -> list[dict[str, Any]]:
    """Return a row for each setting: its rate, the difference from the first setting, and the
    number of equal episodes.
    """
    standard = found[0]
    pairs = [_pairs(one, standard) for one in found]
    adjusted = [1.0, *holm([mcnemar(pair.only_a, pair.only_b) for pair in pairs[1:]])]
    return [
        {
            "way": one.way.name,
            "solved": one.solved,
            "episodes": len(one.episodes),
            "interval_95": list(wilson(one.solved, len(one.episodes))),
            "act_ms": one.act_ms,
            **pair.to_json(),
            "difference_95": list(difference_interval([pair.starts])),
            "p_holm": p,
            "equal": sum(
                one.episodes[seed][1] == standard.episodes[seed][1] for seed in standard.episodes
            ),
            "must_be_equal": one.way.equal,
        }
        for one, pair, p in zip(found, pairs, adjusted, strict=True)
    ]


def shown(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table for the terminal; docs/generate makes the table for the site."""
    found = table("way", "success, %", "difference", "p", "equal", "ms an act")
    for row in rows:
        low, high = (f"{100 * bound:.0f}" for bound in row["interval_95"])
        rate = f"{100 * row['solved'] / row['episodes']:.1f} [{low}, {high}]"
        cells = (
            rate,
            f"{100 * row['difference']:+.1f}",
            f"{row['p_holm']:.2g}",
            row["equal"],
            f"{row['act_ms']:.2f}",
        )
        found.add_row(row["way"], *map(str, cells))
    return found


def _pairs(one: Played, standard: Played) -> Pairs:
    counts = Counter(
        (solved, standard.episodes[seed][0]) for seed, (solved, _) in one.episodes.items()
    )
    return Pairs(counts[True, True], counts[True, False], counts[False, True], counts[False, False])


def main(
    checkpoint: Annotated[
        Path, typer.Option(help="Folder of the reference policy's weights.")
    ] = Path("examples/reference/checkpoint"),
    folder: Annotated[
        Path,
        typer.Option(
            "--folder", help="Folder of the results; episodes with a result are not run again."
        ),
    ] = Path("runs/success"),
    episodes: Annotated[
        int, typer.Option(min=1, help="Number of episodes with each setting.")
    ] = 500,
    only: Annotated[
        str, typer.Option(help="Settings, separated by semicolons; default: all.")
    ] = "",
    out_file: Out = None,
) -> None:
    """Run every setting, and print the table."""
    with errors(), Players(checkpoint, folder, episodes) as players:
        chosen = [one.strip() for one in only.split(";")] if only else [way.name for way in ways()]
        if unknown := set(chosen) - {way.name for way in ways()}:
            raise ConfigError(
                f"--only: expected ways of {[way.name for way in ways()]}, got {sorted(unknown)}"
            )
        found, skipped = list[Played](), dict[str, str]()
        for way in ways():
            if way.name not in (STANDARD, *chosen):
                continue
            try:
                found.append(players.play(way))
            except MissingDependency as error:
                skipped[way.name] = str(error)
                out.print(f"{way.name}: skipped: {error}", style="yellow")
            else:
                out.print(f"{way.name}: {found[-1].solved} of {len(found[-1].episodes)}")
        rows = compared(found)
        out.print(shown(rows))
        save({"ways": rows, "skipped": skipped}, out_file)
        if broken := [
            row["way"] for row in rows if row["must_be_equal"] and row["equal"] < row["episodes"]
        ]:
            raise VLAgentsError(
                f"expected the actions of {STANDARD!r}, bit-identical, got others in {broken}"
            )


if __name__ == "__main__":
    typer.run(main)
