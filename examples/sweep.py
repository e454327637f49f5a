"""Evaluate a sweep over the rotation of a camera from its calibration and the noise of actions.

Two policies differ in an option of their resets, and five suites in an option of the environment:
ten cases, all on the same seeds. `python sweep.py`, in the folder of this file, runs them in this
process, in seconds, with the policy and the environment of own_policy.py and own_env.py; run again,
it continues an interrupted sweep.

As a file, the same plan is run by `vlagents-ray eval FILE` with a served policy and many
workers: examples/evaluations/sweep.yaml sweeps over the checkpoints of a training run,
examples/evaluations/realtime.yaml over latencies.
"""

from itertools import groupby

from own_policy import Servo, ServoConfig

from vlagents_ray.evaluate import EvalConfig, evaluate

CALIBRATED = 120  # degrees
TURNS, SPREADS = (0, 30, 60, 90, 120), (0.0, 1.0)  # degrees; standard deviation of each action


def main():
    """Play the episodes without a result, and print a row for each policy."""
    plan = EvalConfig(
        policies=[
            {"name": f"spread {spread}", "options": {"spread": spread}} for spread in SPREADS
        ],
        suites=[
            {
                "name": f"{turn}°",
                "envs": ["own_env:CraneEnv"],
                "env_options": {"camera_turn": CALIBRATED + turn},
            }
            for turn in TURNS
        ],
        out="runs/sweep",
        workers=0,
        video="none",
        resume=True,
    )
    summary = evaluate(plan, agent_factory=lambda: Servo(ServoConfig(camera_turn=CALIBRATED)))
    print("success, 95 % interval".ljust(24), *(f"{turn}°".ljust(15) for turn in TURNS))
    for policy, group in groupby(summary.cases, lambda case: case.policy_id):
        cases = list(group)
        print(policy.ljust(24), *(str(case.success_once).ljust(15) for case in cases))
        print("".ljust(24), *(f"{case.mean_steps:.1f} steps".ljust(15) for case in cases))
    print("with curves, and policies compared pairwise: runs/sweep/report.html")


if __name__ == "__main__":
    main()
