"""The folders in which compiled programs are kept, so that the next start, and the next replica, finds them.

They hold machine code, which is executed when it is read. They are therefore in the home of the user, where nobody else
may write; torch's own choice is a folder of a known name in /tmp. The compilers recognise programs of another model or
library by themselves, and write each file at once, so that replicas may share a folder. JAX's programs for a CPU are
not kept: with JAX 0.5.3, openpi's own loop of π0 computes other actions once its program was read from a file.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

logger = logging.getLogger(__name__)

_TORCH = "TORCHINDUCTOR_CACHE_DIR"


def keep_torch_programs() -> None:
    """Let torch keep its programs in the user's cache, unless `TORCHINDUCTOR_CACHE_DIR` names another folder.

    Torch writes its own choice, /tmp/torchinductor_USER, into that variable when it first needs it.
    """
    chosen = Path(os.environ.get(_TORCH, "")).name
    if (not chosen or chosen.startswith("torchinductor_")) and (folder := _folder("torch")) is not None:
        os.environ[_TORCH] = str(folder)


def keep_jax_programs(jax: Any, platform: str) -> None:
    """Let JAX keep its programs in the user's cache, unless `JAX_COMPILATION_CACHE_DIR` names another folder.

    Args:
        jax: The module.
        platform: Of the device for which it compiles, such as "gpu"; nothing is kept for "cpu".
    """
    if platform == "cpu":
        return
    chosen = getattr(jax.config, "jax_compilation_cache_dir", "an older JAX, without this setting")
    if chosen is None and (folder := _folder("jax")) is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))


def _folder(library: str) -> Path | None:
    """Return the folder of a library's programs; None, with a warning, if it cannot be made."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = cache / "vlagents_ray" / "programs" / library
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        logger.warning("compiled programs are not kept for the next start: %s", error)
        return None
    return folder
