"""Every maker's robot has a policy, trained in today's scene, that holds it level."""

import pytest

from mjx_balance.evaluation.controllers import Controller, make_controller
from mjx_balance.evaluation.rollout import evaluate, observing, policy_scene, run_suite
from mjx_balance.evaluation.suites import HEADLINE, SEEDS
from mjx_balance.policy.file import load_policy, shipped_policies
from mjx_balance.robots.catalogue import makers

MAKERS = tuple(makers())


def test_each_robot_has_one() -> None:
    assert set(MAKERS) == set(shipped_policies()) - {"best", "real"}
    result = evaluate(load_policy("go2"), "corner", 2, 5.0, SEEDS.held_out)
    assert result["falls"] == 0
    assert result["tilt_deg"]["mean"] < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("name", MAKERS)
def test_it_holds_its_robot_level_and_bears_pushes(name: str) -> None:
    """8 scenarios of 20 s: no falls, and in `push` at most six tenths of the tilt of `pd-imu`."""
    policy = load_policy(name)
    assert policy.robot.name == name
    scene = policy_scene(policy)

    def tilts(controller: Controller, suite: str) -> float:
        rollout = run_suite(scene, controller, suite, 8, 20.0, SEEDS.held_out)
        assert controller is peer or not rollout.fell.any()
        return float(rollout.tilt.mean())

    peer = make_controller("pd-imu", scene)
    for suite in (*HEADLINE, "sea"):
        assert tilts(observing(policy), suite) < 0.25
    assert tilts(observing(policy), "push") < 0.6 * tilts(peer, "push")
