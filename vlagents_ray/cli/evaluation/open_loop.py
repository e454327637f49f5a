"""`vlagents-ray replay` of a LeRobotDataset."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vlagents_ray.cli.console import out
from vlagents_ray.cli.options import parse_list
from vlagents_ray.errors import ConfigError


def is_dataset(folder: Path) -> bool:
    """Return whether a folder is a LeRobotDataset, or has such datasets in it."""
    return (folder / "meta/info.json").is_file() or any(folder.glob("*/meta/info.json"))


def replay_dataset(
    folder: Path,
    policy: str | None,
    into: Path,
    *,
    episodes: str | None,
    horizon: int | None,
    every: int,
    at_once: int,
    cameras: str | None,
    state: str | None,
) -> None:
    """Play a dataset to a policy, print the errors, and write the report."""
    from vlagents_ray.open_loop.candidates import candidate
    from vlagents_ray.open_loop.recorded import Names
    from vlagents_ray.open_loop.replay import ReplayPlan, replay
    from vlagents_ray.open_loop.report import write_files

    if policy is None:
        raise ConfigError(f"{folder}: is a dataset, and wants --policy: a registered name, a deployment file or a URL")
    names = Names(_renamed(cameras), None if state is None else parse_list(state))
    chosen = None if episodes is None else parse_episodes(episodes)
    plan = ReplayPlan(chosen, horizon, every, at_once, names)
    with candidate(policy) as sessions:
        result = replay(folder, sessions, plan)
    table = result.to_json()
    out.print(
        f"{table['frames']} frames of {table['sessions']} sessions, against the recorded {result.against}: "
        f"mean absolute error {table['mae']:.4g}, root mean square {table['rmse']:.4g}, largest {table['max']:.4g}"
    )
    for one in table["by_joint"]:
        out.print(f"  {one['joint']}: {one['mae']:.4g}, {one['rmse']:.4g}, {one['max']:.4g}")
    for path in write_files(result, policy, into):
        out.print(f"wrote {path}")


def parse_episodes(text: str) -> Sequence[int]:
    """Return the numbers in a list such as "0-9,12"; raises `ConfigError` if it is none."""
    found: list[int] = []
    for part in parse_list(text):
        first, dash, last = part.partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise ConfigError(f"--episodes: got {part!r}, want numbers and ranges, such as 0-9,12")
        found += range(int(first), int(last or first) + 1)
    return found


def _renamed(text: str | None) -> dict[str, str]:
    pairs = [part.partition("=") for part in parse_list(text or "")]
    if odd := [name for name, equals, _ in pairs if not equals]:
        raise ConfigError(f"--cameras: got {odd[0]!r}, want POLICY=DATASET, such as base=top,wrist=wrist_left")
    return {name: camera for name, _, camera in pairs}
