"""The exit status of an evaluation with episodes left; see `console.errors` for all other exit
statuses.
"""

# The status of `vlagents-ray eval` if the time limit has passed and episodes are left (EX_TEMPFAIL
# of sysexits.h).
OUT_OF_TIME = 75
