"""The entries that this distribution registers, one for each command."""

from vlagents_ray.registry import RegistryEntry

PLAN = RegistryEntry(
    "vlagents_ray_fleet.command:plan_command",
    "Compute the replicas and GPUs that a fleet of robots needs.",
)
