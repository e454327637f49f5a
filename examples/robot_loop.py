"""A robot's control loop with a steady rate, a guard that checks every action before the arm
executes it, and a watchdog.

The arm is simulated, and the policy draws joint targets at random. The guard therefore rejects
distant targets, and the arm holds its pose at these ticks. In two terminals:

    vlagents-ray serve random --set chunk=10 --set low=-0.3 --set high=0.3
    python robot_loop.py http://localhost:8000

docs/tutorials/robot.md describes how to connect your own arm, and docs/control_loop.md explains
chunks, modes and safe actions.
"""

import sys

from vlagents_ray import ChunkPlayer, RemoteAgent
from vlagents_ray.chunking.choice import choose_for
from vlagents_ray.robot import Guard, Watchdog, run_loop
from vlagents_ray.robot.simulated import SimulatedRobot


def main(url):
    """Drive the arm for two seconds at 50 Hz, and print the report."""
    arm = SimulatedRobot()  # replace it with your arm: observe() -> Obs, apply(action), stop()
    agent = RemoteAgent(url, timeout_s=5)
    guard = Guard(
        agent.contract,
        low=-1.0,  # limits of every joint, rad; stricter limits in the contract also apply
        high=1.0,
        max_step=0.5,  # largest change from one action to the next, rad
        # The measured pose is used for the first action and after a stop.
        measure=lambda obs: obs.state["joints"],
    )
    # The watchdog stops the arm when an answer is overdue by 1 s, or the loop has not ticked for
    # 0.2 s.
    watchdog = Watchdog(lambda _reason: arm.stop(), {"server": 1.0, "loop": 0.2})
    # This policy does not declare whether its actions are relative, so the arm stops and waits.
    choice = choose_for(agent, hz=50, safe="hold")
    print(choice.line)
    with ChunkPlayer(agent, choice.settings, check=guard) as player:
        report = run_loop(
            arm, player, hz=50, seconds=2, instruction="stack the cups", watchdog=watchdog
        )
    refused = report.safe.get("max_step", 0)
    print(
        f"{refused} of {report.jitter['ticks']} actions refused, such as:",
        report.reasons.get("max_step"),
    )
    print(
        f"{report.safe_ticks} ticks without an action of the policy, for this or another reason: "
        f"{report.safe}"
    )
    print(f"punctual within 2 ms: {report.jitter['on_time']:.1%} of the ticks")
    print(f"watchdog: {report.barks or 'never barked'}")


if __name__ == "__main__":
    main(sys.argv[1])
