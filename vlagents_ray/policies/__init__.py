"""Policies, and the code that the model families share.

`vlagents_ray.registry` maps the name of each policy to its class.
"""
