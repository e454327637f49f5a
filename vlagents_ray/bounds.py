"""Upper bounds of numbers in plans and options, which reject a mistyped number at once instead of
computing with it.
"""

from __future__ import annotations

MOST_EPISODES = 1_000_000  # largest number of episodes of each environment and seed
# This seed plus MOST_EPISODES is below 2**32, the limit of many simulators' seeds.
MOST_SEED = 4_000_000_000
MOST_STEP = 10**12  # largest step of training
MOST_STEPS_NAMED = 10_000  # checkpoints of one sweep
MOST_ROWS = 10_000  # largest number of rows of an action chunk
MOST_HZ = 10_000  # largest rate of a robot or an environment, 1/s
MOST_WORKERS = 10_000
MOST_RETRIES = 1_000
MOST_CPUS = 10_000  # largest number of CPUs, or of GPUs
# Longest time, s (about 116 days), which the timers of Python and Ray can represent.
MOST_S = 10_000_000
MOST_BYTES = 2**50
