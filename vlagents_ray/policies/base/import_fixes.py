"""Fixes for torchvision and LeRobot if their wheels do not fit this machine, applied when they are
imported.

PyPI's torchvision for Linux is compiled against CUDA. Its operators do not load with a CPU-only
torch, so `import torchvision` fails. LeRobot 0.4.4 reads videos with torchcodec, which needs an
installed FFmpeg, or with torchvision's `VideoReader`, which newer versions lack. If the wheels fit,
nothing is changed.

This file imports nothing of this package. `vlagents-ray venv create` copies it into each
environment that it makes, with a `.pth` file that calls `install`, so that LeRobot's own commands
also work there.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

Execute = Callable[[ModuleType], None]

log = logging.getLogger(__name__)
_operators: list[Any] = []  # operators exist as long as the object that defined them


def install() -> None:
    """Fix later imports of torchvision and of LeRobot's `video_utils`; imports nothing itself."""
    # The class is compared by name, since an environment also has a copy of this file.
    names = {type(finder).__name__ for finder in sys.meta_path}
    if _Finder.__name__ not in names:
        sys.meta_path.insert(0, _Finder())


class _Finder:
    """Finds the modules of `_FIXES` as Python does, and executes them with the fixes."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of a module of `_FIXES`, with a loader that applies the fix; None for any
        other module.
        """
        fix = _FIXES.get(name)
        if fix is None:
            return None

        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module
            spec.loader.exec_module = partial(fix, execute)  # type: ignore[method-assign]
        return spec


def _torchvision(execute: Execute, module: ModuleType) -> None:
    """Declare the missing operators that the import looks up.

    Calling such an operator still raises an error.
    """
    torch = importlib.import_module("torch")
    try:
        execute(module)
    except RuntimeError as error:
        if "torchvision::" not in str(error) or torch.version.cuda or torch.version.hip:
            raise
    else:
        return

    # Remove the partly imported modules of the failed import.
    submodules = [name for name in sys.modules if name.startswith("torchvision.")]
    for name in submodules:
        del sys.modules[name]
        vars(module).pop(name.removeprefix("torchvision."), None)

    library = torch.library.Library("torchvision", "FRAGMENT")
    for operator in ("nms", "qnms"):
        library.define(f"{operator}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    _operators.append(library)
    execute(module)


def _video_utils(execute: Execute, module: Any) -> None:
    """Read videos with PyAV, which includes FFmpeg, if LeRobot's own decoders are missing."""
    execute(module)
    if importlib.util.find_spec("torchcodec") is not None:
        try:
            importlib.import_module("torchcodec.decoders")
        except (ImportError, OSError, RuntimeError) as error:
            log.warning(
                "torchcodec does not load (%s); videos are read with PyAV",
                str(error).partition("\n")[0],
            )
            module.get_safe_default_codec = _pyav
    else:
        # LeRobot's own function warns at every import.
        module.get_safe_default_codec = _pyav
    if not hasattr(importlib.import_module("torchvision.io"), "VideoReader"):
        module.decode_video_frames_torchvision = decode_frames


def _pyav() -> str:
    return "pyav"


_FIXES: dict[str, Callable[[Execute, ModuleType], None]] = {
    "torchvision": _torchvision,
    "lerobot.datasets.video_utils": _video_utils,
}


def decode_frames(
    video_path: Path | str,
    timestamps: Sequence[float],
    tolerance_s: float,
    *_: object,
    **__: object,
) -> Any:
    """Return the frames that are nearest to the given timestamps, s.

    This replaces LeRobot's `decode_video_frames_torchvision`.

    Returns:
        (N, 3, H, W) float32 in [0, 1].

    Raises:
        ValueError: LeRobot's `FrameTimestampError`: a timestamp is `tolerance_s` or more from its
            nearest frame.
    """
    av, np, torch = (importlib.import_module(name) for name in ("av", "numpy", "torch"))

    frames: list[Any] = []
    with av.open(str(video_path)) as container:
        stream = container.streams.video[0]
        first = max(0.0, min(timestamps) - tolerance_s)
        # Decoding begins at the last key frame that is not after that time.
        container.seek(int(first / stream.time_base), stream=stream)
        for frame in container.decode(stream):
            frames.append(frame)
            if frame.time >= max(timestamps) - tolerance_s:
                break

    nearest: list[Any] = []
    too_far: list[float] = []
    for timestamp in timestamps:
        frame = min(frames, key=lambda frame: abs(frame.time - timestamp), default=None)
        nearest.append(frame)
        if frame is None or abs(frame.time - timestamp) >= tolerance_s:
            too_far.append(timestamp)
    if too_far:
        raise importlib.import_module("lerobot.datasets.video_utils").FrameTimestampError(
            f"{video_path}: has no frame within {tolerance_s} s of {too_far} s"
        )

    pixels = np.stack([frame.to_ndarray(format="rgb24") for frame in nearest])
    return torch.from_numpy(pixels).permute(0, 3, 1, 2).float() / 255
