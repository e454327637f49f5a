"""`vlagents-ray tune`: the settings of a deployment file that serve best on this machine.

`tuner` measures variants of the file, each in a process (`tuning_process`, `measured_policy`), and `tuning_choice`
chooses. Processes obey a line protocol (`line_process`, `line_client`), as those of the folder `benchmarks/` of the
checkout do.
"""
