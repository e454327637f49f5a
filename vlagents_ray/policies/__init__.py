"""Policies: one file or folder for each model family.

`vlagents_ray.registry.POLICIES` maps their names to the classes.
"""
