"""The options `--rerun` and `--foxglove`: a folder, an address, or "live"."""

from __future__ import annotations

from collections.abc import Callable

from vlagents_ray.errors import ConfigError
from vlagents_ray.viewers import foxglove, rerun
from vlagents_ray.viewers.viewer import EpisodeFormat, EpisodeViewer

_FORMATS: dict[str, Callable[[str], EpisodeFormat]] = {
    "rerun": rerun.RerunRecordings,
    "foxglove": foxglove.FoxgloveRecordings,
}
_LIVE = {"rerun": rerun.LIVE, "foxglove": foxglove.LIVE}
_SCHEMES = {"rerun": "rerun+", "foxglove": "ws://"}


def open_viewers(rerun_target: str | None = None, foxglove_target: str | None = None) -> list[EpisodeViewer]:
    """Open the viewers that have a target.

    Args:
        rerun_target: A folder for `.rrd` files; the address of a viewer, "rerun+http://HOST:PORT/proxy"; or "live", the
            viewer on this machine.
        foxglove_target: A folder for `.mcap` files; an address at which viewers may connect, "ws://HOST:PORT"; or
            "live", which lets those of this machine connect.

    Returns:
        The viewers; close each of them.

    Raises:
        ConfigError: A target is another address, or nothing listens there, or it is taken.
        MissingDependency: A viewer's extra is not installed.
    """
    targets = {"rerun": rerun_target, "foxglove": foxglove_target}
    return [EpisodeViewer(open_target(name, target)) for name, target in targets.items() if target]


def open_target(name: str, target: str) -> EpisodeFormat:
    """Open the target of a viewer, as `open_viewers` does."""
    if "://" in target and not is_live(name, target):
        raise ConfigError(f"{name}: got {target!r}, want a folder, 'live', or an address such as {_LIVE[name]}")
    return _FORMATS[name](_LIVE[name] if target == "live" else target)


def is_live(name: str, target: str) -> bool:
    """Whether the target of a viewer is a connection, not a folder."""
    return target == "live" or target.startswith(_SCHEMES[name])


def require_no_server(foxglove_target: str | None) -> str | None:
    """Return a target of Foxglove; raises `ValueError` for an address, which several processes cannot share."""
    if foxglove_target is not None and is_live("foxglove", foxglove_target):
        raise ValueError(f"got {foxglove_target!r}, want a folder: only one process can listen at an address")
    return foxglove_target
