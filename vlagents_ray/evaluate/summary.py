"""`summary.json`: what came out, with what certainty, and what it was made with."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vlagents_ray.evaluate.config import EvalConfig
from vlagents_ray.evaluate.statistics import Rate
from vlagents_ray.evaluate.store import Store

FILE = "summary.json"
State = Literal["complete", "interrupted", "stopped"]
Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Group:
    """The episodes of one env, or of all. Rates count finished episodes: policy errors too, infrastructure not."""

    name: str
    planned: int
    success_once: Rate
    success_at_end: Rate
    policy_errors: int  # episodes that the policy broke off; not successes
    infra_failures: int  # episodes that infrastructure kept from ending; in no rate
    retries: int  # attempts that infrastructure failed and that were repeated
    steps: int
    mean_steps: float | None
    mean_return: float | None
    env_step_ms: float | None  # median of the episodes' medians
    policy_ms: float | None  # likewise
    policy_p95_ms: float | None  # median of the episodes' 95th percentiles

    @property
    def episodes(self) -> int:
        """Finished episodes."""
        return self.success_once.episodes

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        plain = asdict(self)
        rates = {"success_once": self.success_once.to_json(), "success_at_end": self.success_at_end.to_json()}
        return {"name": self.name, "planned": self.planned, "episodes": self.episodes, **rates} | {
            k: v for k, v in plain.items() if k not in rates
        }


@dataclass(frozen=True, slots=True)
class Summary:
    """The outcome of an evaluation; `to_json` is what stands in summary.json."""

    out: Path
    state: State  # "complete": went through every planned episode; "stopped": by an error
    envs: tuple[Group, ...]
    total: Group
    wall_seconds: float  # all runs together, workers' start included
    rollout_seconds: float  # from the first reset to the last step, of all runs together
    config: dict[str, Any]
    policy: dict[str, Any]  # what its server said of itself
    checkpoint: str | None  # that the episodes were played by; None if no reset named one
    transports: tuple[str, ...]
    described: dict[str, Any] = field(default_factory=dict)  # env -> `EvalEnv.describe()`
    versions: dict[str, Any] = field(default_factory=dict)

    @property
    def steps_per_second(self) -> float | None:
        """Env steps of all workers together, over the whole wall time."""
        return self.total.steps / self.wall_seconds if self.wall_seconds else None

    @property
    def rollout_steps_per_second(self) -> float | None:
        """The same without the time before the first reset."""
        return self.total.steps / self.rollout_seconds if self.rollout_seconds else None

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return {
            "state": self.state,
            "total": self.total.to_json(),
            "envs": [group.to_json() for group in self.envs],
            "wall_seconds": self.wall_seconds,
            "rollout_seconds": self.rollout_seconds,
            "steps_per_second": self.steps_per_second,
            "rollout_steps_per_second": self.rollout_steps_per_second,
            "transports": list(self.transports),
            "policy": self.policy,
            "checkpoint": self.checkpoint,
            "env_descriptions": self.described,
            "versions": self.versions,
            "config": self.config,
        }


def summarize(store: Store, config: EvalConfig, versions: dict[str, Any], state: State) -> Summary:
    """What the store knows, the results of earlier runs included."""
    episodes, attempts, runs, envs = (store.rows(table) for table in ("episodes", "attempts", "runs", "envs"))
    names = list(dict.fromkeys([*config.envs, *(row["env"] for row in episodes)]))
    env_of = {row["key"]: row["env"] for row in episodes}
    groups = []
    for name in names:
        mine = [row for row in episodes if row["env"] == name]
        planned = max(config.episodes if name in config.envs else 0, len(mine))
        groups.append(_group(name, planned, mine, [a for a in attempts if env_of.get(a["key"]) == name]))
    return Summary(
        out=config.out,
        state=state,
        envs=tuple(groups),
        total=_group("total", sum(group.planned for group in groups), episodes, attempts),
        wall_seconds=sum(_wall_seconds(run, episodes) for run in runs),
        rollout_seconds=sum(_rollout_seconds(run, episodes) for run in runs),
        config=config.model_dump(mode="json"),
        policy=store.policy() or {},
        checkpoint=next((row["checkpoint"] for row in episodes if row["checkpoint"] is not None), None),
        transports=tuple(sorted({row["transport"] for row in episodes if row["status"] != "infra_failed"})),
        described={row["env"]: json.loads(row["described"]) for row in envs if row["described"] is not None},
        versions=versions,
    )


def write_summary(summary: Summary) -> Path:
    """Write `summary.json`, whole or not at all."""
    path = summary.out / FILE
    part = path.with_suffix(".part")
    part.write_text(json.dumps(summary.to_json(), indent=2) + "\n")
    os.replace(part, path)
    return path


def versions() -> dict[str, Any]:
    """What the driver runs on: Python, packages, and the commit of the folder it was started in."""
    packages = {}
    for name in ("vlagents-ray", "ray", "numpy", "av"):
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            packages[name] = "not installed"
    return {"python": platform.python_version(), "platform": platform.platform(), **packages, "git_commit": _commit()}


def _commit() -> str | None:
    git = shutil.which("git")
    if git is None:
        return None
    command = [git, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    asked = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 (no input)
    return asked.stdout.strip() or None if asked.returncode == 0 else None


def _group(name: str, planned: int, episodes: Sequence[Row], attempts: Sequence[Row]) -> Group:
    finished = [row for row in episodes if row["status"] != "infra_failed"]
    return Group(
        name=name,
        planned=planned,
        success_once=Rate(sum(row["success_once"] for row in finished), len(finished)),
        success_at_end=Rate(sum(row["success_at_end"] for row in finished), len(finished)),
        policy_errors=sum(row["status"] == "policy_error" for row in finished),
        infra_failures=len(episodes) - len(finished),
        retries=sum(row["retried"] for row in attempts),
        steps=sum(row["steps"] for row in finished),
        mean_steps=_mean([row["steps"] for row in finished]),
        mean_return=_mean([row["episode_return"] for row in finished]),
        env_step_ms=_median([row["env_step_ms"] for row in finished]),
        policy_ms=_median([row["policy_ms"] for row in finished]),
        policy_p95_ms=_median([row["policy_p95_ms"] for row in finished]),
    )


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def _wall_seconds(run: Row, episodes: Sequence[Row]) -> float:
    """How long a run took; one that was killed, until its last episode."""
    ended = run["ended"]
    if ended is None:
        ended = max((row["finished"] for row in episodes if row["run"] == run["run"]), default=run["started"])
    return float(ended - run["started"])


def _rollout_seconds(run: Row, episodes: Sequence[Row]) -> float:
    mine = [row for row in episodes if row["run"] == run["run"]]
    if not mine:
        return 0.0
    return float(max(row["finished"] for row in mine) - min(row["finished"] - row["seconds"] for row in mine))
