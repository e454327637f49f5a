"""Measurements that users can repeat on their own machines: `vlagents-ray bench …`.

`rtt` and `link` take round trips of every transport of ours and of other policy servers (`peers/`), in turns;
`throughput` loads one replica with many clients; `overhead` compares an evaluation with bare environments,
`evaluation` with the peers' own; `soak` lets one run for long; `report` makes the README's section of it all, judged
by `targets`. `hosts` makes several hosts of one machine, with a Ray cluster over them. `ways` knows how each client is
started: as a process that obeys a line protocol (`child`, `peers/peer.py`), or as a Ray actor.
"""
