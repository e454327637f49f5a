"""An exit status that programs read; see `console.errors` for the others."""

# The status of `vlagents-ray eval` if its time is over and episodes are left (EX_TEMPFAIL of
# sysexits.h).
OUT_OF_TIME = 75
