"""LeRobot's policy type `vlagents`: a policy on a vlagents_ray server, for LeRobot's own commands.

LeRobot imports this package when one of its commands starts, and finds the policy's class and its
processors by the names of the modules next to the configuration.
"""

from lerobot_policy_vlagents.configuration_vlagents import VlagentsConfig

__all__ = ["VlagentsConfig"]
