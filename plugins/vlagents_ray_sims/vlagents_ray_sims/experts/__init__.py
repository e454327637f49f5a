"""Scripted experts, which solve tasks of these simulators without learning.

The policy `scripted` runs the expert that its setting `expert` names, such as
"vlagents_ray_sims.experts.metaworld:MetaWorldExpert".
"""
