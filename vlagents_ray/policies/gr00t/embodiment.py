"""The robot of a GR00T checkpoint, as its processor's metadata describe it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec
from vlagents_ray.errors import ConfigError

CONFIG, STATISTICS = "processor_config.json", "statistics.json"
_CONVERTED = {"RELATIVE": False, "DELTA": True}  # representations of actions -> whether decoded ones are deltas
_SPACES = {"NON_EEF": "joint", "EEF": "ee_pose"}
_ROTATIONS = {"XYZ_ROT6D": "rot6d", "XYZ_ROTVEC": "axis_angle"}
_CURE = "save the checkpoint's processor with its dataset's statistics, as GR00T's training does"


@dataclass(frozen=True)
class Embodiment:
    """The inputs and the actions of one robot of a checkpoint."""

    value: str  # its name, by which GR00T's code finds it, as it does by that of its own `EmbodimentTag`
    cameras: tuple[str, ...]
    state: Mapping[str, int]  # groups and their widths, in the model's order
    action: Mapping[str, int]
    moments: Mapping[str, tuple[int, ...]]  # of "video" and "state": the observations read, 0 the newest, -1 before it
    horizon: int  # rows of a chunk
    spec: ActionSpec

    @property
    def history(self) -> int:
        """The number of consecutive observations that the model reads from."""
        return 1 - min(min(moments, default=0) for moments in self.moments.values())

    @classmethod
    def of(cls, folder: Path, name: str | None) -> Embodiment:
        """Read an embodiment from the folder of a processor.

        Args:
            folder: With `processor_config.json` and `statistics.json`.
            name: The embodiment's; None: the only one.

        Raises:
            ConfigError: There is no such embodiment, or its statistics are incomplete.
        """
        try:
            settings = json.loads((folder / CONFIG).read_text(encoding="utf-8"))["processor_kwargs"]
            statistics = json.loads((folder / STATISTICS).read_text(encoding="utf-8"))
            configs = settings["modality_configs"]
        except FileNotFoundError as error:
            have = sorted(one.name for one in folder.iterdir())
            raise ConfigError(
                f"checkpoint {folder}: has no {Path(error.filename).name}, has {have}; {_CURE}"
            ) from error
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(
                f"checkpoint {folder}: {CONFIG} and {STATISTICS} are not those of GR00T's processor "
                f"({type(error).__name__}: {error}); {_CURE}"
            ) from error
        known = sorted(set(configs) & set(statistics))
        chosen = name if name is not None else known[0] if len(known) == 1 else None
        if chosen is None or chosen not in known:
            others = sorted(set(configs) - set(statistics))
            raise ConfigError(
                f"embodiment: got {name!r}, want one of {known}"
                f"{f'; {others} have no statistics in this checkpoint' if others else ''}"
            )
        config, numbers = configs[chosen], statistics[chosen]
        names = ("q01", "q99") if settings.get("use_percentiles") else ("min", "max")
        widths = {
            kind: {group: _width(folder, numbers, kind, group, names) for group in config[kind]["modality_keys"]}
            for kind in ("state", "action")
        }
        return cls(
            chosen,
            tuple(config["video"]["modality_keys"]),
            widths["state"],
            widths["action"],
            {kind: tuple(config[kind]["delta_indices"]) for kind in ("video", "state")},
            len(config["action"]["delta_indices"]),
            _action(
                config["action"].get("action_configs") or (),
                sum(widths["action"].values()),
                converted=bool(settings.get("use_relative_action")),
            ),
        )

    def require_fits(self, config: Any) -> None:
        """Raise `ConfigError` unless a model of this `config` has room for the state, the actions and their rows."""
        for what, got, most in (
            ("state", sum(self.state.values()), config.max_state_dim),
            ("action", sum(self.action.values()), config.max_action_dim),
            ("chunk", self.horizon, config.action_horizon),
        ):
            if got > most:
                raise ConfigError(
                    f"embodiment {self.value!r}: its {what} has {got} {'rows' if what == 'chunk' else 'numbers'}, the "
                    f"model at most {most}: is the processor that of another checkpoint?"
                )


def _width(folder: Path, numbers: Mapping[str, Any], kind: str, group: str, names: tuple[str, str]) -> int:
    """Return the width of a group of the state or of actions, whose bounds are finite."""
    bounds = [np.asarray(numbers.get(kind, {}).get(group, {}).get(name, ()), np.float64) for name in names]
    if bounds[0].ndim != 1 or not bounds[0].size or bounds[0].shape != bounds[1].shape:
        raise ConfigError(
            f"checkpoint {folder}: {STATISTICS} has no {list(names)} of {kind} {group!r}, has those of "
            f"{sorted(numbers.get(kind, {}))}; without them its numbers have no units: {_CURE}"
        )
    if not np.isfinite(bounds).all():
        raise ConfigError(f"checkpoint {folder}: {list(names)} of {kind} {group!r} are not all finite; {_CURE}")
    return int(bounds[0].size)


def _action(groups: Any, dim: int, *, converted: bool) -> ActionSpec:
    """Describe the actions by their relative groups.

    Checkpoints call everything else absolute, displacements such as LIBERO's as well, so that nothing is said of it.
    GR00T converts relative groups to absolute ones if the processor says `use_relative_action`.
    """
    stated = [group for group in groups if converted and group["rep"] in _CONVERTED]
    deltas = {_CONVERTED[group["rep"]] for group in stated}
    spaces = {_SPACES.get(group["type"]) for group in stated}
    rotations = {_ROTATIONS.get(group["format"]) for group in stated}
    return ActionSpec(
        dim=dim,
        delta=deltas.pop() if len(deltas) == 1 else None,
        space=spaces.pop() if len(spaces) == 1 else None,
        rotation=rotations.pop() if len(rotations) == 1 else None,  # type: ignore[arg-type]
    )
