"""GR00T's checkpoints and policies are made as LeRobot's others are."""

from tests.families.lerobot.conftest import loaded, made

__all__ = ["loaded", "made"]
