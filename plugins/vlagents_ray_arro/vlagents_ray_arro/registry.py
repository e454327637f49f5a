"""The registry entries of this distribution."""

from vlagents_ray.registry import RegistryEntry

ARRO = RegistryEntry("vlagents_ray_arro:Arro")
