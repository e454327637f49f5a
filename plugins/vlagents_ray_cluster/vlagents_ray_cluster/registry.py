"""The entry of the command that this distribution registers."""

from vlagents_ray.registry import RegistryEntry

SLURM = RegistryEntry(
    "vlagents_ray_cluster.slurm.command:slurm",
    "Submit evaluations and servers as Slurm jobs.",
)
