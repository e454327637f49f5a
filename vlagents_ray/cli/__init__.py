"""The command `vlagents-ray`."""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
from types import FrameType

from vlagents_ray.naming import did_you_mean

# Garbage collection traverses all modules imported so far. With Python's threshold of 700 new
# objects, collections take a tenth of the time of the imports, and free nothing.
_COLLECT_AT = 10_000


def main() -> None:
    """Run the console script; if only the light install exists, print which packages to install."""
    gc.set_threshold(_COLLECT_AT)

    # This handler applies until a command installs its own handler, see `cli.console.errors`.
    default = signal.signal(signal.SIGINT, _end_at_once)

    if sys.argv[1:] == ["--version"]:  # this module is also in the light install
        from vlagents_ray.cli.help_page import version_line

        sys.stdout.write(f"{version_line()}\n")
        return

    # This command is in the light install; during the command, Ctrl-C stops the robot.
    if sys.argv[1:2] == ["robot"]:
        from vlagents_ray.cli.robot import main as robot

        find_modules_here()
        signal.signal(signal.SIGINT, default)
        try:
            sys.exit(robot(sys.argv[2:]))
        except KeyboardInterrupt:
            sys.stderr.write("Error: interrupted\n")
            sys.exit(130)

    try:
        from vlagents_ray.cli.main import app
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("vlagents_ray"):
            raise
        if sys.argv[1:] in ([], ["-h"], ["--help"]):
            from vlagents_ray.cli.light import help_page

            sys.stdout.write(help_page().text())
            sys.exit(0 if sys.argv[1:] else 2)
        from vlagents_ray.registry import pip_install

        guess = did_you_mean(" ".join(sys.argv[1:2]), ["robot"]) or "."
        sys.stderr.write(
            f"Error: {error.name!r} is not installed; this is the light install of a "
            f"robot's computer{guess}\n"
            "It has `vlagents-ray robot`; `vlagents-ray -h` lists all. For the other commands: "
            f"{pip_install('serve')}; to evaluate: {pip_install('sim')}\n"
        )
        sys.exit(1)

    find_modules_here()
    # Otherwise Python would free all objects of Ray when it exits, which takes half a second.
    atexit.register(gc.freeze)
    app()


def _end_at_once(_number: int, _frame: FrameType | None) -> None:
    """End the process at Ctrl-C while it imports the commands."""
    os.write(2, b"Error: interrupted before the command began; nothing was started or written\n")
    os._exit(130)


def find_modules_here() -> None:
    """Let Python import modules from the working directory, as `python -m` and Ray's workers do,
    unless PYTHONSAFEPATH is set.
    """
    if getattr(sys.flags, "safe_path", False):  # Python 3.10 has no such flag
        return
    try:
        folder = os.getcwd()
    except FileNotFoundError:  # the working directory was removed
        return
    if folder not in sys.path:
        sys.path.insert(0, folder)
