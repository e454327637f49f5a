"""A whole loop of learning on two cores: a small policy learns to lift pucks of the tabletop from images and words.

`vlagents-ray learn tabletop` runs it: demonstrations of a teacher, behaviour cloning (BC), then reinforcement learning
with the teacher's advice (RPD) and without it (PPO), each of whose versions is evaluated on the same seeds.
"""
