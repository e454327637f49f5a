"""Full or read-only disks for one command, mounted in a namespace that no other process sees."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

FULL = "mount -t tmpfs -o size={size} tmpfs '{folder}'"  # so small that it fills up
READ_ONLY = "mount --bind '{folder}' '{folder}' && mount -o remount,ro,bind '{folder}'"
_HERE = Path(__file__).parent


def python_on(
    mount: str, folder: Path, code: str, *words: str, **options: str
) -> subprocess.CompletedProcess[str]:
    """Run `code` (`sys.argv[1]` is the folder, `words` follow) where `mount` was done to it.
    Needs root.
    """
    mounted = mount.format(folder=folder, **options)
    command = [
        "unshare",
        "--mount",
        "sh",
        "-c",
        f'{mounted} && exec "$@"',
        "sh",
        sys.executable,
        "-c",
        code,
    ]
    path = os.pathsep.join((str(_HERE), str(_HERE.parents[1])))
    return subprocess.run(
        [*command, str(folder), *words],
        capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": path},
    )  # fmt: skip
