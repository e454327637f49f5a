"""Measurements, which run in a checkout: `python -m benchmarks.NAME --help`.

`rtt` and `link` compare round trips with those of other policy servers (`peers`), on one machine
and over a link; `calls` counts the calls and system calls of an inference call, and `act_path`
lists the files and classes that such a call enters; `throughput` loads one replica with many
clients; `policy` measures a policy without a server; `report` measures round trips and throughput,
compares them with targets, and writes docs/measured_tables.md; `checkpoints` writes checkpoints
with random weights. `overhead` compares an evaluation with bare environments, `evaluation` with the
peers' evaluations; `soak` runs a long evaluation; `scaling` adds workers on a Ray cluster over
several `hosts`, which are simulated on one machine; `autoscaling` samples replicas while `robots`
and rollouts start and end, `scaling_trace` samples replicas during a burst of robots with SLOs, and
`simulated_scaling` computes such traces; `hop` measures a child process behind a replica,
`adapters` measures sessions with many fine-tunes, `push` new weights while sessions act, `rollouts`
the transitions of a learner, `fleet` counts the robots that each system serves in time,
and `fleet_events` measures a fleet during failures and pushes; `clients` measures clients in other
languages, `ros` a robot behind topics of ROS 2, `far_away` a robot whose policy is behind
a long, lossy or cut link.
"""
