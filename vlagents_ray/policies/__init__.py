"""Policies, and the code that model families share.

`vlagents_ray.registry` maps the names of policies to their classes.
"""
