"""Exit statuses of commands that programs read; the others are those of `console`."""

# `vlagents-ray eval` when its time is over and episodes are left (EX_TEMPFAIL of sysexits.h)
OUT_OF_TIME = 75
