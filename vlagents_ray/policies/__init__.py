"""Policies, and what model families share; `vlagents_ray.registry` maps the names to the
classes.
"""
