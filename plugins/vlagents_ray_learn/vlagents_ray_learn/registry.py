"""What this distribution registers: an entry for each command."""

from vlagents_ray.registry import RegistryEntry

OPEN_LOOP = RegistryEntry(
    "vlagents_ray_learn.open_loop.command:open_loop_command",
    "Compare a policy's actions with those of a dataset.",
)
