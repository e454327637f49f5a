"""Measures the success of a policy by the delay of its answers, in each mode of executing chunks.

A policy runs the same seeds of a simulated environment with each mode and each delay, in rows,
which are ticks of the environment's rate. The clock is simulated
(`vlagents_ray.evaluate.episode.latency`), so the speed and the load of the machine do not matter.
Each setting is compared with the synchronous episodes of the same seeds, in which the environment
waits for the policy. `--curves` writes the curves of success into the folder of a checkpoint, where
`vlagents-ray serve` finds them.

    python -m benchmarks.delays deployments/my_policy.yaml --env metaworld/drawer-open-v3
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

from benchmarks.console import Out, save
from vlagents_ray.cli.console import errors, out, table
from vlagents_ray.columns import Columns
from vlagents_ray.contract import ActionSpec
from vlagents_ray.envs.base import BatchEnv, make_batch
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.evaluate.episode.episode import Diverged, run_episodes
from vlagents_ray.evaluate.episode.records import EpisodeObserver, EpisodeResult
from vlagents_ray.evaluate.plan.config import ClockConfig
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.evaluate.results.statistics import Pairs, difference_interval
from vlagents_ray.interface import Obs
from vlagents_ray.naming import plain
from vlagents_ray.overrides import parse_overrides, parse_settings
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import (
    only_application,
    own_settings,
    read_deployment,
)
from vlagents_ray.serve.local_agent import LocalPolicy
from vlagents_ray.success import Solved, SuccessCurve, read_curves, wilson, write_curves

ROWS = (0, 1, 2, 3, 5, 8)
# Delays of successive answers, rows, which the player does not know in advance. Their number is
# prime, so that they do not repeat in step with the chunks.
_DRAWS = np.random.default_rng(0)
_DRAWN = 97
VARYING = tuple(int(rows) for rows in _DRAWS.integers(1, 5, _DRAWN))
# One answer of 20 is lost, and the answer to its repetition comes one second later at 10 Hz, the
# initial timeout of TCP (RFC 6298); the others come after one row.
LOST = tuple(11 if lost else 1 for lost in _DRAWS.random(_DRAWN) < 0.05)
DELAYS: dict[str, int | tuple[int, ...]] = {
    **{str(rows): rows for rows in ROWS},
    "1 to 4": VARYING,
    "1, or lost": LOST,
}
# Options of the environment of the default, in which the reference policy was trained.
TABLETOP = ('cameras=["front","wrist"]', "width=64", "height=64", "ends_on_success=true")
# Window of the moving average in `oscillation_m`: motions that take longer are no oscillations.
_WINDOW_S = 0.5


@dataclass(frozen=True)
class Mode:
    """A mode of executing chunks, in an evaluation and in the chunk player."""

    mode: str = "async"
    # Other settings, which `ClockConfig` and `PlayerSettings` share.
    settings: Mapping[str, Any] = field(default_factory=dict)


MODES = {
    "stop and wait": Mode("open_loop"),
    "async": Mode(),
    "async, grips at once": Mode("async", {"fresh_grip": None}),
    "prefixes": Mode("async", {"real_time_chunking": True}),
}
SYNCHRONOUS = "synchronous"


@dataclass(frozen=True)
class Episode:
    """An episode with one setting."""

    solved: bool
    ticks: int  # ticks until it was solved, or all ticks
    standing: int  # ticks without a motion: without a row, or waiting for an answer
    digest: str  # digest of the executed actions
    jerk: float | None  # m/s³
    oscillation: float | None  # m


class Motions(EpisodeObserver):
    """Records the positions of the tool, and counts the ticks without a motion.

    Args:
        spec: The actions of the environment.
        part: The part of the state whose first three values are the tool's position.
    """

    def __init__(self, spec: ActionSpec, part: str | None) -> None:
        self.positions: list[np.ndarray] = []
        self.standing = 0
        self._spec, self._part = spec, part
        self._last: np.ndarray | None = None

    def add_observation(self, obs: Obs) -> None:
        if self._part is not None:
            self.positions.append(np.array(obs.state[self._part][:3], np.float64))

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        columns = Columns.from_spec(self._spec, len(action))
        moving = [column for column in range(len(action)) if column not in columns.grippers]
        # Whether the first target is a motion is unknown.
        if self._last is not None or set(moving) <= set(columns.relative):
            still = columns.still(self._last)
            # A policy's row is never exactly the row of a robot that stands.
            self.standing += np.array_equal(action[moving], still[moving])
        self._last = action


def jerk(positions: np.ndarray, hz: float) -> float | None:
    """Return the mean norm of the third derivative of a path, m/s³; None if it is too short.

    LIBERO-LQ (https://vla2026.github.io/libero-lq) measures smoothness by the jerk of the end
    effector; here it is the third difference of its positions.

    Args:
        positions: The positions at successive ticks, (T, 3), m.
        hz: The rate of the ticks, 1/s.
    """
    if len(positions) < 4:
        return None
    return float(np.linalg.norm(np.diff(positions, 3, axis=0), axis=1).mean() * hz**3)


def oscillation(positions: np.ndarray, hz: float) -> float | None:
    """Return the root mean square distance of a path from its moving average over half a second, m;
    None if it is shorter.

    LIBERO-LQ names short-horizon oscillations of the end effector's position as its measure of
    stability.

    Args:
        positions: The positions at successive ticks, (T, 3), m.
        hz: The rate of the ticks, 1/s.
    """
    window = max(3, 2 * round(_WINDOW_S * hz / 2) + 1)
    if len(positions) < window:
        return None
    kernel = np.ones(window) / window
    mean = np.stack([np.convolve(axis, kernel, "valid") for axis in positions.T], 1)
    middle = positions[window // 2 : window // 2 + len(mean)]
    return float(np.sqrt(((middle - mean) ** 2).sum(1).mean()))


class Measurement:
    """Runs episodes of one policy in one environment, and stores them in a folder."""

    def __init__(
        self,
        policy: LocalPolicy,
        env: str,
        env_options: Mapping[str, Any],
        *,
        execute: int,
        batch: int,
        part: str | None,
        folder: Path,
    ) -> None:
        """Create the environments.

        Args:
            policy: The policy, initialized.
            env: The name of the environment.
            env_options: The options of its constructor.
            execute: The number of executed rows of a chunk.
            batch: The number of environments that run together.
            part: The part of the state with the tool's position, m, for jerk and oscillation.
            folder: The folder of the results.
        """
        self.name, self.execute = env, execute
        self._policy, self._part, self._folder = policy, part, folder
        self._env: BatchEnv = make_batch(env, batch, **env_options)
        self._sessions = policy.sessions(batch)
        if self._env.contract.control_hz is None:
            raise ConfigError(
                f"{env}: expected an environment whose contract declares control_hz, got none; "
                "declare the rate of its steps"
            )
        self.hz: float = self._env.contract.control_hz

    def episodes(self, name: str, clock: ClockConfig | None, number: int) -> list[Episode]:
        """Run the episodes with the seeds 0 to `number` - 1 that the folder does not have yet, and
        return all of them.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        file = self._folder / f"{plain(f'{self.name} {name}')}.json"
        done = [Episode(**one) for one in json.loads(file.read_text())] if file.exists() else []
        while len(done) < number:
            seeds = range(len(done), min(number, len(done) + self._env.num_envs))
            done += self._run(seeds, clock)
            file.write_text(json.dumps([asdict(one) for one in done]))
        return done[:number]

    def _run(self, seeds: Sequence[int], clock: ClockConfig | None) -> Iterator[Episode]:
        """Run one episode for each seed together."""
        motions = [Motions(self._env.contract.action, self._part) for _ in seeds]
        outcomes = run_episodes(
            self._env,
            self._policy,
            self._sessions[: len(seeds)],
            [EpisodeKey(self.name, seed, seed, "") for seed in seeds],
            execute=self.execute,
            clock=clock,
            observers=motions,
            images="requested",
        )
        for outcome, motion in zip(outcomes, motions, strict=True):
            if not isinstance(outcome, EpisodeResult):
                raise outcome.error if isinstance(outcome, Diverged) else outcome
            if outcome.error is not None:
                raise VLAgentsError(outcome.error)
            positions = np.array(motion.positions).reshape(-1, 3)
            yield Episode(
                solved=bool(outcome.success_once),
                ticks=outcome.first_success or outcome.steps,
                standing=motion.standing,
                digest=str(outcome.actions_sha256),
                jerk=jerk(positions, self.hz),
                oscillation=oscillation(positions, self.hz),
            )


def clock_of(
    mode: Mode,
    delay: int | tuple[int, ...],
    hz: float,
    settings: Mapping[str, Any] | None = None,
) -> ClockConfig:
    """Return the clock of a mode, with a delay in rows at a rate, and further settings."""
    rows = [delay] if isinstance(delay, int) else list(delay)
    latencies_s = [count / hz for count in rows]
    latency = latencies_s[0] if isinstance(delay, int) else latencies_s
    return ClockConfig.model_validate(
        {"latency": latency, "mode": mode.mode, **mode.settings, **(settings or {})}
    )


def row(
    mode: str, delay: str, episodes: Sequence[Episode], synchronous: Sequence[Episode], hz: float
) -> dict[str, Any]:
    """Return the row of a mode at a delay, compared with synchronous episodes of equal seeds."""
    number, solved = len(episodes), sum(one.solved for one in episodes)
    ticks = sum(one.ticks for one in episodes)
    paired = list(zip(episodes, synchronous, strict=True))
    counts = Counter((one.solved, other.solved) for one, other in paired)
    pairs = Pairs(
        counts[True, True], counts[True, False], counts[False, True], counts[False, False]
    )
    return {
        "mode": mode,
        "delay": delay,
        "solved": solved,
        "episodes": number,
        "interval_95": list(wilson(solved, number)),
        **pairs.to_json(),
        "difference_95": list(difference_interval([pairs.starts])),
        "equal": sum(one.digest == other.digest for one, other in paired),
        "ticks": ticks / number,
        "standing": sum(one.standing for one in episodes) / ticks,
        "tasks_per_hour": solved / ticks * hz * 3600,
        "jerk": _mean(one.jerk for one in episodes),
        "oscillation": _mean(one.oscillation for one in episodes),
    }


def curves(
    rows: Iterable[Mapping[str, Any]], env: str, hz: float, execute: int, weights: str | None
) -> list[SuccessCurve]:
    """Return the curve of each mode that was measured without a delay; delays that vary are in no
    curve.
    """
    solved: dict[str, dict[int, Solved]] = {}
    for one in rows:
        delay = DELAYS.get(one["delay"])
        if one["mode"] in MODES and isinstance(delay, int):
            entry = Solved(one["solved"], one["episodes"], one["ticks"])
            solved.setdefault(one["mode"], {})[delay] = entry
    return [
        SuccessCurve(
            env,
            hz,
            MODES[name].mode,
            {"execute": execute, **MODES[name].settings},
            entries,
            weights,
        )
        for name, entries in solved.items()
        if 0 in entries
    ]


def shown(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table for the terminal; docs/generate makes the table for the site."""
    found = table(
        "mode", "rows", "success, %", "difference", "equal", "ticks", "standing, %", "tasks/h",
        "jerk", "oscillation, mm",
    )  # fmt: skip
    for one in rows:
        low, high = (f"{100 * bound:.0f}" for bound in one["interval_95"])
        found.add_row(
            one["mode"],
            one["delay"],
            f"{100 * one['solved'] / one['episodes']:.1f} [{low}, {high}]",
            f"{100 * one['difference']:+.1f}",
            f"{one['equal']} of {one['episodes']}",
            f"{one['ticks']:.1f}",
            f"{100 * one['standing']:.0f}",
            f"{one['tasks_per_hour']:.0f}",
            "" if one["jerk"] is None else f"{one['jerk']:.1f}",
            "" if one["oscillation"] is None else f"{1e3 * one['oscillation']:.1f}",
        )
    return found


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _chosen(names: str, known: Mapping[str, Any], option: str) -> list[str]:
    """Return the names in an option, which are separated by semicolons; all if it is empty."""
    chosen = [name.strip() for name in names.split(";")] if names else list(known)
    unknown = sorted(set(chosen) - known.keys())
    if unknown:
        raise ConfigError(f"{option}: expected names of {list(known)}, got {unknown}")
    return chosen


def main(
    policy: Annotated[
        str, typer.Argument(help="A deployment file with one policy.")
    ] = "deployments/reference.yaml",
    env: Annotated[str, typer.Option(help="The environment.")] = "tabletop",
    settings: Annotated[
        list[str], typer.Option("--set", help="Setting of the policy, NAME=VALUE.")
    ] = [],  # noqa: B006 - typer copies it
    env_set: Annotated[
        list[str], typer.Option("--env-set", help="Option of the environment, NAME=VALUE.")
    ] = [],  # noqa: B006
    execute: Annotated[int, typer.Option(min=1, help="Number of executed rows of a chunk.")] = 4,
    episodes: Annotated[int, typer.Option(min=1, help="Number of seeds with each setting.")] = 500,
    batch: Annotated[
        int, typer.Option(min=1, help="Number of environments that run together.")
    ] = 25,
    modes: Annotated[str, typer.Option(help="Modes, separated by semicolons; default: all.")] = "",
    delays: Annotated[str, typer.Option(help="Delays, as in the table; default: all.")] = "",
    clock_set: Annotated[
        list[str], typer.Option("--clock", help="Setting of the clock, NAME=VALUE.")
    ] = [],  # noqa: B006
    position: Annotated[
        str, typer.Option(help="Part of the state with the tool's position; empty: none.")
    ] = "xyzrpy",
    folder: Annotated[
        Path, typer.Option(help="Folder of the episodes, which are not run again.")
    ] = Path("runs/delays"),
    checkpoint: Annotated[
        Path | None,
        typer.Option("--curves", help="Folder of the checkpoint, into which curves are written."),
    ] = None,
    out_file: Out = None,
) -> None:
    """Run each mode at each delay, and print the table."""
    with errors():
        chosen_modes = _chosen(modes, MODES, "--modes")
        chosen_delays = _chosen(delays, DELAYS, "--delays")
        overrides = [change.below("config") for change in parse_overrides(settings, "--set")]
        overrides += parse_overrides([f"batch.max_size={batch}"], "--batch")
        app = only_application(policy, read_deployment(policy, overrides=overrides))
        config = own_settings(app)
        config.pop("execute", None)  # the evaluation executes a part of the chunk, not the policy
        agent = LocalPolicy(ServerArgs.model_validate(app.args), config)
        agent.initialize()
        of_clock = parse_settings(clock_set, "--clock")
        if env in ("tabletop", "benchmarks.absolute:AbsoluteTabletop") and not env_set:
            env_set = [*TABLETOP]
        part, options = position or None, parse_settings(env_set, "--env-set")
        measured = Measurement(
            agent, env, options, execute=execute, batch=batch, part=part, folder=folder
        )
        hz, synchronous = measured.hz, measured.episodes(SYNCHRONOUS, None, episodes)
        rows = [row(SYNCHRONOUS, "0", synchronous, synchronous, hz)]
        for name in chosen_modes:
            for delay in chosen_delays:
                clock = clock_of(MODES[name], DELAYS[delay], hz, of_clock)
                found = measured.episodes(f"{name} {delay}", clock, episodes)
                rows.append(row(name, delay, found, synchronous, hz))
                out.print(f"{name}, {delay}: {rows[-1]['solved']} of {episodes}")

        out.print(shown(rows))
        weights = (agent.metadata.get("weights") or {}).get("digest")
        found_curves = curves(rows, env, hz, execute, weights)
        for curve in found_curves:
            out.print(f"{curve.mode} {dict(curve.settings)}: tolerated {curve.tolerated} rows")
        save({"env": env, "hz": hz, "execute": execute, "rows": rows}, out_file)
        if checkpoint is not None:
            kept = [one for one in read_curves(checkpoint) if one.env != env]
            write_curves(checkpoint, [*kept, *found_curves])


if __name__ == "__main__":
    typer.run(main)
