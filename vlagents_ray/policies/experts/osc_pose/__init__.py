"""Experts that move a hand by robosuite's OSC_POSE, in LIBERO and in robosuite."""
