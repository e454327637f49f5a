"""Upper bounds of numbers in plans and options, so that a slip of the keyboard is answered at
once, not computed.
"""

from __future__ import annotations

MOST_EPISODES = 1_000_000  # largest number of episodes of each environment and seed
MOST_SEED = 4_000_000_000  # with its episodes below 2**32, the range of many simulators' seeds
MOST_STEP = 10**12  # largest step of training
MOST_STEPS_NAMED = 10_000  # checkpoints of one sweep
MOST_ROWS = 10_000  # largest number of rows of an action chunk
MOST_WORKERS = 10_000
MOST_RETRIES = 1_000
MOST_CPUS = 10_000  # also GPUs
MOST_S = 10_000_000  # s, about 116 days; the timers of Python and Ray take it
MOST_BYTES = 2**50
