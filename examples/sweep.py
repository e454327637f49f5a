"""Evaluate a sweep over the rotation of a camera and the noise of actions.

Two policies differ in an option of their resets, and five suites differ in an option of the
environment. This gives ten cases, all with the same seeds. In the folder of this file, `python
sweep.py` runs the cases in this process, in seconds, with the policy of own_policy.py and the
environment of own_env.py. If it is run again, it continues an interrupted sweep.

`vlagents-ray eval FILE` runs such a plan from a file, with a served policy and many
workers: examples/evaluations/sweep.yaml sweeps over the checkpoints of a training run, and
    examples/evaluations/realtime.yaml over latencies.
"""

from itertools import groupby

from own_policy import Servo, ServoConfig

from vlagents_ray.evaluate import EvalConfig, evaluate

CALIBRATED = 120  # degrees
# Degrees; the standard deviation of each action's noise.
TURNS, SPREADS = (0, 30, 60, 90, 120), (0.0, 1.0)


def main():
    """Run the episodes without a result, and print a row for each policy."""
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
