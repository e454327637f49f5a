"""Full or read-only disks for one command, mounted in a namespace that is invisible to other
processes.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

FULL = "mount -t tmpfs -o size={size} tmpfs '{folder}'"  # a size that soon fills up
READ_ONLY = "mount --bind '{folder}' '{folder}' && mount -o remount,ro,bind '{folder}'"
_HERE = Path(__file__).parent


def python_on(
    mount: str, folder: Path, code: str, *words: str, **options: str
) -> subprocess.CompletedProcess[str]:
    """Run Python `code` after `mount` was applied to `folder`. `sys.argv[1]` is the folder,
    followed by `words`. Root privileges are required.
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
