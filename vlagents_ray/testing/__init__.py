"""Test suites for policies and environments, which all those of this package pass and yours can also use.

    from vlagents_ray.testing import check_agent, check_env

    def test_my_env_keeps_its_contract():
        check_env(MyEnv())

    def test_my_policy_keeps_its_contract():
        check_agent(MyPolicy())

Each raises `ContractViolation` with the first violation that it finds, and closes the agent or environment.
"""

from vlagents_ray.testing.agents import check_agent
from vlagents_ray.testing.comparing import ContractViolation
from vlagents_ray.testing.environments import check_env

__all__ = ["ContractViolation", "check_agent", "check_env"]
