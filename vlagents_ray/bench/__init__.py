"""Measurements that users can repeat on their own machines: `vlagents-ray bench …` and `vlagents-ray tune`.

`rtt` measures round trips by every transport, in turns; `throughput` loads one replica with many clients; `policy`
measures a policy without a server. `tuner` measures variants of a deployment file, each in a process
(`tuning_process`), and `tuning_choice` chooses. `figures` has what all results have in common. Each of the `clients`
runs in a process that obeys a line protocol (`line_process`, `line_client`), or in a Ray actor. What only developers
repeat is the folder `benchmarks/` of the checkout.
"""
