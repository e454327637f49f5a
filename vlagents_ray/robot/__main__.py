"""Print the command that drives a robot, since `python -m vlagents_ray.robot` is not a command."""

import sys

if __name__ == "__main__":
    sys.exit(
        "Error: expected a command, got the package vlagents_ray.robot; run: python -m "
        "vlagents_ray robot --help"
    )
