"""Policies, one file a family. `vlagents_ray.registry.POLICIES` maps their names to the classes."""
