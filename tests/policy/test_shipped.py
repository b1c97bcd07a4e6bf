"""The policies in the repository: they load, belong to today's scene, and balance."""

from pathlib import Path

import pytest

from mjx_balance import load_policy
from mjx_balance.config import flatten, preset, to_dict
from mjx_balance.evaluation.controllers import make_controller
from mjx_balance.evaluation.rollout import evaluate, policy_scene, run_suite

FOLDER = Path(__file__).parents[2] / "policies"
POLICIES = sorted((*FOLDER.glob("*.safetensors"), *FOLDER.glob("seeds/*.safetensors")))
"""Of our own robot; test_shipped_robots.py has those of others."""
OF_A_RUN = {"seed", "num_envs", "num_devices", "engine", "eval_scenarios", "eval_duration"}
"""Fields that differ from one run of a preset to the next."""


def test_there_is_a_best_policy_and_its_seeds() -> None:
    names = [path.name for path in POLICIES]
    assert "best.safetensors" in names
    best = load_policy(POLICIES[names.index("best.safetensors")])
    seeds = [load_policy(path) for path in POLICIES if path.name.startswith("seed-")]
    assert best.fingerprint in {policy.fingerprint for policy in seeds}
    assert len({policy.fingerprint for policy in seeds}) == len(seeds) == 5
    scene = policy_scene(best)  # whoever stands still falls in the scenarios of the tests below
    assert run_suite(scene, make_controller("none", scene), "corner", 8, 20.0, 11).fell.all()


@pytest.mark.parametrize("path", POLICIES, ids=lambda path: path.name)
def test_policy_fits_in_the_repository_and_to_the_scene(path: Path) -> None:
    assert path.stat().st_size < 1_000_000
    policy = load_policy(path)
    policy_scene(policy)
    assert policy.config.preset == ("real" if path.stem == "real" else "best")
    ours, todays = (flatten(to_dict(x)) for x in (policy.config, preset(policy.config.preset)))
    assert {name for name in todays if ours[name] != todays[name]} <= OF_A_RUN


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=() if path.stem == "best" else pytest.mark.slow, id=path.name)
        for path in POLICIES
    ],
)
@pytest.mark.parametrize(
    ("suite", "mean", "most"),
    [
        ("corner", 0.12, 1.1),
        ("noise", 0.12, 1.1),
        ("payload", 0.12, 1.1),
        ("latency", 0.3, 2.5),
        ("push", 0.12, 2.5),
    ],
)
def test_policy_balances(path: Path, suite: str, mean: float, most: float) -> None:
    """8 scenarios of 20 s; the figures of the README have more of both."""
    result = evaluate(load_policy(path), suite, 8, 20.0, 11)
    assert result["falls"] == 0
    assert result["tilt_deg"]["mean"] < mean
    assert result["tilt_deg"]["max"] < most
    assert result["action_mm_settled"] < 0.15
