"""The commands `vlagents-ray merge`, `bundle` and `verify`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vlagents_ray.bounds import MOST_EPISODES
from vlagents_ray.cli.console import errors, out, print_json, table
from vlagents_ray.cli.options import AsJson, finite
from vlagents_ray.cli.results import Folder

if TYPE_CHECKING:
    from vlagents_ray_results.verification import Verification


def merge_command(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="FOLDER...", help="Folders of results, which are not changed."),
    ],
    into: Annotated[Path, typer.Option("--out", metavar="FOLDER", help="New folder.")],
    keep_first: Annotated[
        bool,
        typer.Option(
            "--keep-first",
            help="If folders have different outcomes of an episode, keep the outcome of the first "
            "folder.",
        ),
    ] = False,
    accept_changes: Annotated[
        bool,
        typer.Option(
            "--accept-changes",
            help="Merge even if files or weights differ. The report lists the differences.",
        ),
    ] = False,
) -> None:
    """Merge results, so that each episode occurs once, with its videos and trajectories."""
    from vlagents_ray.evaluate import print_summary
    from vlagents_ray_results.merge import merge

    with errors():
        print_summary(
            out, merge(into, folders, keep_first=keep_first, accept_changes=accept_changes)
        )


def bundle_command(
    folder: Folder,
    file: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="The bundle; default: FOLDER.bundle.zip."),
    ] = None,
    videos: Annotated[
        bool, typer.Option("--videos", help="Include the videos, which may be large.")
    ] = False,
) -> None:
    """Write an evaluation as one file that others can reproduce: its database, the changes of the
    code since its commit, the trajectories, and digests of all files.
    """
    from vlagents_ray.evaluate.artifacts.storage import require_folder_of
    from vlagents_ray_results.bundle import write_bundle

    with errors():
        path = file or folder.absolute().with_name(f"{folder.absolute().name}.bundle.zip")
        require_folder_of(path)
        digest = write_bundle(folder, path, videos=videos)
    out.print(f"bundle: {path}, {path.stat().st_size / 1e6:.1f} MB\nto cite: sha256:{digest}")


def verify_command(
    bundle: Annotated[
        Path, typer.Argument(metavar="BUNDLE", help="A file that `vlagents-ray bundle` wrote.")
    ],
    replay: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=MOST_EPISODES,
            metavar="N",
            help="Execute the actions of N episodes, drawn at random; default: all episodes.",
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=2**32 - 1,
            metavar="N",
            help="Seed with which these episodes are drawn; default: a new one, which is printed.",
        ),
    ] = None,
    into: Annotated[
        Path | None,
        typer.Option("--out", metavar="FOLDER", help="Keep the results in this new folder."),
    ] = None,
    trust: Annotated[
        bool,
        typer.Option("--trust", help="Also create environments whose settings name code or files."),
    ] = False,
    max_gb: Annotated[
        float,
        typer.Option(
            min=0,
            max=1e6,
            callback=finite,
            metavar="GB",
            help="Reject a bundle whose content is larger than this, in GB.",
        ),
    ] = 16.0,
    as_json: AsJson = False,
) -> None:
    """Execute the recorded actions of a bundle here, without its policy, and print the success
    rates of the reproduced episodes.

    An episode is reproduced if it ends here at the same step with the same outcome. The bundle may
    come from a stranger.

    Exit status: 0 if all executed episodes were reproduced, otherwise 1. `--replay 0` only unpacks
    the bundle.
    """
    from vlagents_ray_results.verification import verify

    with errors():
        verification = verify(
            bundle, into=into, replay=replay, seed=seed, trust=trust, most_bytes=int(max_gb * 1e9)
        )
    if as_json:
        print_json(verification.to_json())
    else:
        _print_verification(verification)
        if into is not None:
            out.print(f"results: {into}")
    raise typer.Exit(not verification.is_complete and replay != 0)


def _print_verification(verification: Verification) -> None:
    """Print the rates of the reproduced episodes, the other episodes with their reasons, and the
    differences of the software.
    """
    from vlagents_ray.evaluate.results.changes import short

    tried = len(verification.episodes)
    others = [episode for episode in verification.episodes if not episode.is_reproduced]
    if tried:
        rates = table("policy", "env", "reproduced", "success in %", box=None)
        if others:
            rates.add_column("if the others had failed, or succeeded")
        for rate in verification.rates:
            success = rate.success_once
            bounds = []
            if others:
                low, high = rate.with_others or (success.rate or 0.0, success.rate or 0.0)
                bounds = [f"{100 * low:.0f} to {100 * high:.0f}%"]
            episodes = f"{success.episodes} of {rate.tried}"
            rates.add_row(rate.policy, rate.env, episodes, str(success), *bounds)
        out.print(rates)

    if others:
        not_reproduced = table("not reproduced", "policy", "there and here", box=None)
        for episode in others:
            name = f"{episode.task}#{episode.episode}@{episode.seed}"
            not_reproduced.add_row(name, episode.policy, episode.reason)
        out.print()
        out.print(not_reproduced)

    drawn = ""
    if tried < verification.counted:
        drawn = f"; drawn from {verification.counted} by --seed {verification.seed}"
    out.print(f"\n{verification.reproduced} of {tried} episodes reproduced{drawn}")
    if verification.has_clock:
        out.print(
            "real-time mode: the executed actions were repeated; that the policy computed them in "
            "time is not reproduced"
        )
    for change in verification.accepted_changes:
        out.print(f"the author accepted a change between episodes: {change}")
    for change in verification.differences:
        there, here = short(change.was or "none"), short(change.now or "none")
        out.print(f"differs: {change.subject}: {change.name}: {there} there, {here} here")
    out.print(f"bundle sha256:{verification.digest}")
