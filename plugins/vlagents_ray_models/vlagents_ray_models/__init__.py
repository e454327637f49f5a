"""Model families: LeRobot, GR00T, π0, openpi, OpenVLA, Octo, Diffusion Policy, V-JEPA 2-AC, and
exported models.
"""
