"""The command `vlagents-ray open-loop`, which computes a policy's errors on a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from vlagents_ray.bounds import MOST_EPISODES, MOST_ROWS
from vlagents_ray.cli.console import errors, fresh, out
from vlagents_ray.cli.options import (
    ConfigDir,
    ServeSet,
    Set,
    find_policy,
    parse_list,
    policy_overrides,
)
from vlagents_ray.errors import ConfigError


def open_loop_command(
    folder: Annotated[
        Path, typer.Argument(metavar="DATASET", help="A LeRobotDataset, or a folder of them.")
    ],
    policy: Annotated[
        str,
        typer.Option(metavar="POLICY", help="The policy: a name, a deployment file, or a URL."),
    ],
    out_dir: Annotated[
        Path | None,
        typer.Option("--out", metavar="FOLDER", help="Folder of the errors; default: a new one."),
    ] = None,
    episodes: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBERS", help="Numbers of the episodes, such as 0-9,12; default: all."
        ),
    ] = None,
    horizon: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MOST_ROWS,
            metavar="N",
            help="Number of rows of a chunk that are compared; default: all.",
        ),
    ] = None,
    stride: Annotated[
        int,
        typer.Option(
            min=1,
            max=MOST_EPISODES,
            metavar="N",
            help="Compare every Nth frame of a dataset without recorded answers.",
        ),
    ] = 1,
    camera_map: Annotated[
        str | None,
        typer.Option(
            metavar="PAIRS",
            help="Cameras of the policy and of the dataset, such as base=top,wrist=left; default: "
            "equal names.",
        ),
    ] = None,
    state: Annotated[
        str | None,
        typer.Option(
            metavar="PARTS",
            help="Parts of observation.state in their order, separated by commas, such as "
            "joints,gripper.",
        ),
    ] = None,
    settings: Set = [],  # noqa: B006
    serve_settings: ServeSet = [],  # noqa: B006
    config_dir: ConfigDir = None,
) -> None:
    """Send the observations of a dataset to a policy, and compare its actions with the recorded
    ones.

    A dataset is a server's recording, or any LeRobotDataset. The errors by joint and by step of the
    horizon are printed, and written as JSON.
    """
    with errors():
        # These modules are imported late, so that the help of the command line is fast.
        from vlagents_ray.evaluate.artifacts.storage import require_folder
        from vlagents_ray.recorded_dataset import Names
        from vlagents_ray_learn.open_loop.comparison import (
            OpenLoopPlan,
            candidate,
            compare,
            open_datasets,
            recorded_rows,
            write_result,
        )

        names = Names(
            cameras=parse_camera_map(camera_map or ""),
            state=None if state is None else parse_list(state),
        )
        plan = OpenLoopPlan(
            episodes=None if episodes is None else parse_episodes(episodes),
            horizon=horizon,
            stride=stride,
            names=names,
        )
        source = find_policy(policy, config_dir)
        overrides = policy_overrides(settings, serve_settings)
        datasets = open_datasets(folder)
        result_folder = out_dir or fresh(Path("runs/open_loop"))
        require_folder(result_folder)
        with candidate(source, overrides, recorded_rows(datasets)) as open_session:
            result = compare(datasets, open_session, plan)

        table = result.to_json()
        out.print(
            f"{table['frames']} frames of {table['sessions']} sessions, against the recorded "
            f"{result.against}: "
            f"mean absolute error {table['mae']:.4g}, root mean square {table['rmse']:.4g}, "
            f"largest {table['max']:.4g}"
        )
        if table["equal"] is not None:
            out.print(f"equal to the bit: {table['equal']} of {table['frames']} answers")
        for joint in table["by_joint"]:
            out.print(
                f"  {joint['joint']}: {joint['mae']:.4g}, {joint['rmse']:.4g}, {joint['max']:.4g}"
            )
        out.print(f"wrote {write_result(result, source, result_folder)}")


def parse_camera_map(text: str) -> dict[str, str]:
    """Parse the option `--camera-map`.

    Args:
        text: Pairs of names, such as "base=top,wrist=left".

    Returns:
        The policy's name of a camera -> the dataset's name.

    Raises:
        ConfigError: The text is not such a list.
    """
    cameras = {}
    for pair in parse_list(text):
        name, equals, camera = pair.partition("=")
        if not equals:
            raise ConfigError(
                f"--camera-map: expected POLICY=DATASET, such as base=top,wrist=left, got {pair!r}"
            )
        cameras[name] = camera
    return cameras


def parse_episodes(text: str) -> Sequence[int]:
    """Return the numbers in a list such as "0-9,12".

    Raises:
        ConfigError: The text is not such a list, or it has too many numbers.
    """
    episodes: list[int] = []
    for interval in parse_list(text):
        first, dash, last = interval.partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise ConfigError(
                f"--episodes: expected numbers and ranges, such as 0-9,12, got {interval!r}"
            )
        numbers = range(int(first), int(last or first) + 1)
        if not numbers or len(episodes) + len(numbers) > MOST_EPISODES:
            raise ConfigError(
                f"--episodes: expected up to {MOST_EPISODES} numbers, from low to high, got "
                f"{interval!r}"
            )
        episodes += numbers
    return episodes
