"""The page's simulation, MuJoCo in WebAssembly under node, is that of Python's evaluation."""

import json
from pathlib import Path
from typing import Any

import pytest
from fixtures.javascript import evaluate_script, install

from mjx_balance.cli.browser import page_xml, robot_data, write_data
from mjx_balance.evaluation.controllers import make_controller
from mjx_balance.evaluation.rollout import observing, policy_scene, run_suite
from mjx_balance.evaluation.suites import SUITES
from mjx_balance.policy.file import load_policy, shipped_policies
from mjx_balance.sim.scene import Scene

DRAWN = ("noise", "bias", "delay", "dropout")
"""Suites whose sensors draw numbers at every sample: the page's are others."""
EXACT = [name for name in SUITES if name not in DRAWN]
SCRIPT = """
import load from "@mujoco/mujoco/mujoco.js";
import { readFileSync } from "node:fs";
import { ImuPd, Stand } from "./baselines.js";
import { Physics } from "./physics.js";
import { readPolicy } from "./policy.js";
import { Controller } from "./runtime.js";
import { evaluate, Simulation } from "./simulation.js";

const mujoco = await load();
const data = JSON.parse(readFileSync(value.data));
const result = {};
for (const suite of value.suites) {
  const { scene, scenarios } = data.suites[suite];
  const bytes = new Uint8Array(value.policy ? readFileSync(value.policy) : 0);
  const make = { "pd-imu": () => new ImuPd(data), none: () => new Stand(data) }[value.who];
  const balancer = make ? make() : new Controller(readPolicy(bytes.buffer));
  const physics = new Physics(mujoco, data, scene);
  const simulation = new Simulation(physics, data, balancer);
  result[suite] = await evaluate(simulation, scenarios.slice(1, 2), value.duration, async () => {});
  physics.delete();
}
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data of a policy and its robot, as the page gets them."""
    install()
    folder = tmp_path_factory.mktemp("data")
    path = shipped_policies()["best"]
    write_data(folder, [(path, policy_scene(load_policy(path)))])
    return folder / "data"


def compare(files: Path, who: str, suites: list[str], duration: float, agree: float) -> Any:
    """Checks the second scenario of suites; returns what Python and the page find."""
    index = json.loads((files / "index.json").read_text())
    (data,) = index["robots"]
    policy = index["policies"][0]
    value: dict[str, Any] = {"data": str(files / data), "suites": suites, "duration": duration}
    value |= {"who": who, "policy": str(files / policy["file"])}
    found, scene = evaluate_script(SCRIPT, value), policy_scene(load_policy(policy["name"]))
    own = load_policy(policy["name"])
    for suite in suites:
        controller = observing(own) if who == "policy" else make_controller(who, scene)
        rollout = run_suite(scene, controller, suite, 2, duration, 0)
        tilt = rollout.tilt[1]
        assert found[suite]["falls"] == int((tilt >= scene.task.fail_tilt).any()), suite
        for name, expected in (("mean", tilt.mean()), ("max", tilt.max())):
            assert found[suite]["tilt_deg"][name] == pytest.approx(expected, abs=agree), suite
    return found


@pytest.mark.parametrize(("suite", "seconds"), [("corner", 6.0), ("push", 12.0)])
def test_it_balances_as_in_pythons_evaluation(files: Path, suite: str, seconds: float) -> None:
    """The second push, at 10 s, comes as the board begins to move."""
    compare(files, "policy", [suite], seconds, 1e-4)


@pytest.mark.slow
def test_every_suite_is_pythons(files: Path) -> None:
    """60 s of all whose random numbers are Python's; events included."""
    compare(files, "policy", EXACT, 60.0, 1e-3)


@pytest.mark.slow
def test_sensors_with_noise_are_pythons_in_size(files: Path) -> None:
    """The noise is drawn anew: a fifth more or less tilt."""
    found = compare(files, "policy", list(DRAWN), 60.0, 0.1)
    assert len({x["tilt_deg"]["mean"] for x in found.values()}) == len(DRAWN)


@pytest.mark.slow
@pytest.mark.parametrize("who", ["pd-imu", "none"])
def test_baselines_are_pythons(files: Path, who: str) -> None:
    found = compare(files, who, ["corner", "recover"], 30.0, 1e-3)
    assert found["corner"]["falls"] == (who == "none")


def test_the_scenes_text_has_all_numbers(scene: Scene) -> None:
    """What the text rounds comes beside it; a robot that fell touches board and floor."""
    data = robot_data(scene, suites=["soft", "corner"])
    assert set(data["scenes"]) == {"", "soft"}
    assert data["suites"]["soft"]["scene"] == "soft"
    assert "input=" not in data["scenes"][""]["xml"]
    places, numbers = data["scenes"]["soft"]["fields"]["actuator_gainprm"]
    assert len(places) == 12
    assert set(numbers) == {60.0}
    text = page_xml(scene.task, "quadruped")
    feet = [line for line in text.splitlines() if 'name="robot/LF_foot"' in line]
    assert 'contype="2"' in feet[0]


def test_a_suite_that_does_not_fit_is_left_out(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mjx_balance.cli import browser
    from mjx_balance.evaluation.suites import SuiteError

    def draw(own: Scene, suite: str, seed: int) -> list[dict[str, Any]]:
        if suite == "steep":
            raise SuiteError("too steep")
        return []

    monkeypatch.setattr(browser, "suite_scenarios", draw)
    assert list(robot_data(scene, suites=["steep", "paper"])["suites"]) == ["paper"]
