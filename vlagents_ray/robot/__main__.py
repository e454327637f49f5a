"""Name the command that drives a robot; `python -m vlagents_ray.robot` is not one."""

import sys

if __name__ == "__main__":
    sys.exit(
        "error expected a command, got the package vlagents_ray.robot; run: python -m vlagents_ray "
        "robot --help"
    )
