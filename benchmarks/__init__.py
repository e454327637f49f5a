"""Measurements, which run in a checkout: `python -m benchmarks.NAME --help`.

`rtt` compares round trips with those of other policy servers (`peers`), and `throughput` the
actions per second of many clients. `robots` counts the ticks in time of robots, `evaluation`
compares whole evaluations, and `success` the success of a policy with each transport and setting.
`policy` measures a policy without a server, `gpu` everything that needs a GPU; `checkpoints` writes
the checkpoints with random weights that both can use.
"""
