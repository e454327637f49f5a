"""Measurements that users can repeat on their own machines: `vlagents-ray bench …`.

`rtt` takes round trips by every transport, in turns; `throughput` loads one replica with many clients; `policy`
measures a policy without a server, and `model` is a policy of a real one's size; `tuning/` chooses settings of a
policy; `comparison` compares two runs, and `machine` describes what their figures depend on. Each of the `clients` runs
in a process that obeys a line protocol (`line_process`, `line_client`), or in a Ray actor. What only developers repeat
is the folder `benchmarks/` of the checkout.
"""
