"""Every maker's robot has a policy, trained in today's scene, that holds it level."""

import pytest

from mjx_balance.evaluation.controllers import make_controller
from mjx_balance.evaluation.rollout import evaluate, observing, policy_scene, run_suite
from mjx_balance.evaluation.suites import HEADLINE, SEEDS
from mjx_balance.policy.file import load_policy, shipped_policies
from mjx_balance.robots.catalogue import makers

MAKERS = tuple(makers())


def test_each_robot_has_one() -> None:
    assert set(MAKERS) == set(shipped_policies()) - {"best"}
    result = evaluate(load_policy("go2"), "corner", 2, 5.0, SEEDS.held_out)
    assert result["falls"] == 0
    assert result["tilt_deg"]["mean"] < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("name", MAKERS)
def test_it_holds_its_robot_as_level_as_who_knows_the_boards_rate(name: str) -> None:
    """No falls, and at most 1.15 times the mean tilt, over 8 held-out scenarios of 20 s."""
    policy = load_policy(name)
    assert policy.robot.name == name
    scene = policy_scene(policy)
    for suite in HEADLINE:
        ours = run_suite(scene, observing(policy), suite, 8, 20.0, SEEDS.held_out)
        oracle = make_controller("rate-oracle", scene)
        bound = run_suite(scene, oracle, suite, 8, 20.0, SEEDS.held_out)
        assert not ours.fell.any()
        assert ours.tilt.mean() <= 1.15 * bound.tilt.mean()
