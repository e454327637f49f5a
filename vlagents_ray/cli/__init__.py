"""The command `vlagents-ray`."""

from __future__ import annotations

import sys


def main() -> None:
    """Entry point of the console script; says what to install where the light install cannot do it."""
    try:
        from vlagents_ray.cli.main import app
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("vlagents_ray"):
            raise
        sys.stderr.write(
            f"vlagents-ray: {error.name!r} is not installed; this is the light install of a robot's computer.\n"
            "For the commands: pip install 'vlagents-ray[serve]', and 'vlagents-ray[sim]' to evaluate.\n"
        )
        sys.exit(1)
    app()
