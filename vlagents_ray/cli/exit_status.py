"""Exit statuses of commands that programs read; the others are those of `console`."""

OUT_OF_TIME = 75  # `vlagents-ray eval` when its time is over and episodes are left (EX_TEMPFAIL of sysexits.h)
