"""LeRobot's policy type `vlagents`: a policy on a vlagents_ray server, for LeRobot's own commands.

LeRobot imports this package when one of its commands starts, and finds the policy's class and its
processors in the modules beside the configuration, by their names.
"""

from lerobot_policy_vlagents.configuration_vlagents import VlagentsConfig

__all__ = ["VlagentsConfig"]
