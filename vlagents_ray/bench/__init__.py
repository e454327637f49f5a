"""Measurements that users can repeat on their own machines: `vlagents-ray bench …`.

`rtt` and `link` take round trips of every transport of ours and of other policy servers (`peers/`), in turns;
`throughput` loads one replica with many clients; `policy` measures one without a server, `model` is one of a real one's
size, `checkpoints/` makes random checkpoints of real ones; `tuning/` chooses settings of one; `report/` writes the page
of it all, judges it, and compares two runs. `clients` are ours; each runs in a process that obeys a line protocol
(`line_process`, `peers/peer.py`), or in a Ray actor. What only developers repeat is the folder `benchmarks/` of the
checkout.
"""
