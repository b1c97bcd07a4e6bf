"""The Python interface: what the package offers, and `train` and `evaluate` around a run."""

import dataclasses
import importlib.metadata
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import mjx_balance
from mjx_balance import Callback, Suite, api
from mjx_balance.config import Config, ConfigError, preset, to_dict
from mjx_balance.errors import InputError
from mjx_balance.evaluation.rollout import evaluate
from mjx_balance.files.run_folder import RunFolder, create_run_folder
from mjx_balance.policy.file import PolicyError, load_policy
from mjx_balance.policy.network import Policy
from mjx_balance.robots.catalogue import RobotError, find_robot, robot_file
from mjx_balance.robots.limits import for_robot
from mjx_balance.training import run
from mjx_balance.training.checkpoints import SaveError
from mjx_balance.training.finish import Finished
from mjx_balance.training.processes import Interrupted

RESULTS = {"paper": {"tilt_deg": {"mean": 0.05}, "falls": 1, "scenarios": 4}}


def test_one_version_stands_everywhere() -> None:
    repo = Path(__file__).parents[1]
    version = tomllib.loads((repo / "pyproject.toml").read_text())["project"]["version"]
    newest = re.search(r"^## (.*)$", (repo / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest
    assert newest[1] == version
    assert yaml.safe_load((repo / "CITATION.cff").read_text())["version"] == version


def test_everything_is_listed_and_there() -> None:
    assert set(mjx_balance.__all__) <= set(dir(mjx_balance))
    for name in mjx_balance.__all__:
        assert getattr(mjx_balance, name) is not None
    assert mjx_balance.__version__ == importlib.metadata.version("mjx_balance")
    with pytest.raises(AttributeError, match="module 'mjx_balance' has no attribute 'trian'"):
        _ = mjx_balance.trian


LIGHT = """
import sys, mjx_balance
dir(mjx_balance)
assert not {"mujoco", "jax", "pydantic", "tyro"} & set(sys.modules), "import"
mjx_balance.preset("default").replace(gamma=0.2)
assert "mujoco" not in sys.modules, "preset"
mjx_balance.evaluate, mjx_balance.Suite, mjx_balance.load_policy
assert "jax" not in sys.modules, "evaluate"
"""


def test_the_package_is_light() -> None:
    path = os.pathsep.join(filter(None, sys.path))
    environment = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"} | {"PYTHONPATH": path}
    subprocess.run([sys.executable, "-c", LIGHT], check=True, env=environment)


def test_a_policy_says_what_it_is() -> None:
    policy = load_policy("best")
    assert repr(policy) == (
        "Policy(preset 'best' after 200,704 decisions, robot 'quadruped', 136 inputs, hidden "
        f"layers 64 x 64, head radial, action continuous, weights {policy.fingerprint})"
    )


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Any]:
    """What `api.train` asks of a run, which then writes two lines and ends as `error` says."""
    asked: list[Any] = []

    def train(config: Config, run_dir: Any, resume: Any, display: Any, **more: Any) -> Finished:
        asked.append({"config": config, "run_dir": run_dir, "resume": resume, "display": display})
        asked[-1] |= more
        folder = RunFolder(run_dir or resume)
        folder.path.mkdir(exist_ok=True)
        folder.metrics.write_text('{"env_steps": 1}\n{"env_steps": 2}\n')
        for callback in more["callbacks"]:
            callback({})
        return Finished(load_policy("best"), RESULTS, folder)

    monkeypatch.setattr(run, "train", train)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return asked


def test_nothing_is_written_unless_it_is_asked_for(asked: list[Any], tmp_path: Path) -> None:
    result = mjx_balance.train("quick")
    assert asked[0]["config"] == preset("quick")
    assert not asked[0]["keep"]
    assert asked[0]["display"].console.quiet is False
    assert asked[0]["run_dir"].is_relative_to(tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert result.run_dir is None
    assert result.metrics == [{"env_steps": 1}, {"env_steps": 2}]
    assert result.evaluation == RESULTS
    assert isinstance(result.policy, Policy)
    assert repr(result).startswith("TrainingResult(Policy(preset 'best'")
    assert repr(result).endswith("; mean tilt in paper: 0.050 deg, 1 of 4 fall)")


def test_a_run_folder_stays(asked: list[Any], tmp_path: Path) -> None:
    result = mjx_balance.train(preset("smoke"), tmp_path / "mine", progress=False)
    assert result.run_dir == asked[0]["run_dir"] == tmp_path / "mine"
    assert asked[0]["keep"]
    assert asked[0]["display"].console.quiet
    assert [x.name for x in tmp_path.iterdir()] == ["mine"]


def test_a_run_is_resumed_with_its_own_config(asked: list[Any], tmp_path: Path) -> None:
    saved = preset("best").replace(seed=9)
    create_run_folder(tmp_path / "run", to_dict(saved), {})
    result = mjx_balance.train(resume=str(tmp_path / "run"))
    assert (asked[0]["config"], asked[0]["run_dir"]) == (saved, None)
    assert asked[0]["resume"] == result.run_dir == tmp_path / "run"
    with pytest.raises(InputError, match="resume continues a folder in place; leave run_dir out"):
        mjx_balance.train(resume="a", run_dir="b")


@pytest.mark.parametrize(
    ("error", "stays"),
    [
        (Interrupted("stopped"), True),
        (SaveError("no room"), True),
        (ConfigError("no"), False),
        (ZeroDivisionError("the callback's own"), False),
    ],
    ids=lambda value: type(value).__name__,
)
def test_only_what_can_be_continued_stays(
    error: Exception, stays: bool, asked: list[Any], tmp_path: Path
) -> None:
    def fail(metrics: Any) -> None:
        raise error

    with pytest.raises(type(error)):
        mjx_balance.train("smoke", callbacks=[fail])
    assert bool(list(tmp_path.iterdir())) is stays


def test_a_misspelt_preset_leaves_nothing(asked: list[Any], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="unknown preset 'quik'; did you mean quick"):
        mjx_balance.train("quik")
    assert (asked, list(tmp_path.iterdir())) == ([], [])


ICE = Suite(mjx_balance.RandomizationConfig(friction_min=0.1, friction_max=0.3), name="ice")


def test_evaluations_are_those_of_the_command() -> None:
    policy = load_policy("best")
    found = [
        api.evaluate(policy, "corner", 2, 0.4, 5),
        api.evaluate("best", "corner", 2, 0.4, 5, progress=True),
        evaluate(policy, "corner", 2, 0.4, 5),
    ]
    for result in found:
        del result["physics_steps_per_second"]
    assert found[0] == found[1] == found[2]
    ice = api.evaluate(policy, ICE, 2, 0.4, 5)
    assert (ice["suite"], ice["scenarios"]) == ("ice", 2)
    assert json.loads(json.dumps(ice)) == ice
    with pytest.raises(InputError, match="unknown suite 'cornr'; did you mean corner"):
        api.evaluate("nobody", "cornr")
    with pytest.raises(PolicyError, match="no policy file at bset"):
        api.evaluate("bset")


def test_a_robot_made_in_python_is_known_by_its_name() -> None:
    soft = dataclasses.replace(robot_file("go2"), name="soft_go2", servo_stiffness=200.0)
    config = for_robot(preset("default"), soft)
    assert config.robot == "soft_go2"
    assert config.task.body_height == find_robot("soft_go2").body_height
    assert find_robot("soft_go2").servo_stiffness == 200
    for name, sentence in (("go2", "name is 'go2', which is a shipped robot's"), ("", "name is")):
        with pytest.raises(RobotError, match=sentence):
            for_robot(preset("default"), dataclasses.replace(soft, name=name or "x.toml"))
    with pytest.raises(RobotError, match="servo_stiffness is -1"):
        for_robot(preset("default"), dataclasses.replace(soft, servo_stiffness=-1.0))


IN_A_NOTEBOOK = """
import asyncio, json, sys
import jax, jax.numpy as jnp
import flax.linen as nn

jax.config.update("jax_enable_x64", True)
assert float(jnp.ones(3).sum()) == 3 and len(jax.devices()) == 1  # JAX is in use

import mjx_balance
from mjx_balance.dqn import td_error

class Dueling(nn.Module):
    @nn.compact
    def __call__(self, obs):
        x = nn.relu(nn.Dense(16)(obs))
        advantage = nn.Dense(441)(x)
        return nn.Dense(1)(x) + advantage - advantage.mean(-1, keepdims=True)

class Listen(mjx_balance.Callback):
    heard = []
    def on_start(self, config, folder): self.heard.append(("start", config.num_devices))
    def on_log(self, metrics): self.heard.append(("log", metrics["env_steps"]))
    def on_validation(self, metrics):
        assert metrics["eval/corner/tilt_mean"] > 0
        self.heard.append(("validation", metrics["env_steps"]))
        return metrics["env_steps"] == 2048
    def on_end(self, evaluation): self.heard.append(("end", list(evaluation)))
    def close(self): self.heard.append("close")

config = mjx_balance.preset("smoke").replace(
    engine="mujoco", eval_every=2048, eval_scenarios=3, eval_duration=2.0, validation_duration=1.0
)
own = {}
if "own" in sys.argv:
    own = dict(network=Dueling(), loss=lambda *terms: abs(td_error(*terms)))

async def cell():  # a notebook's code runs in an event loop
    return mjx_balance.train(config, callbacks=[Listen()], progress=False, **own)

result = asyncio.run(cell())
assert Listen.heard == [
    ("start", 1), ("log", 1024), ("validation", 2048), ("log", 2048),
    ("end", ["paper", "corner"]), "close",
], Listen.heard
assert [x["env_steps"] for x in result.metrics] == [1024, 2048]
assert jnp.arange(2.0).dtype == "float64", "x64 stays as it was"
again = mjx_balance.evaluate(result.policy, "corner", 3, 2.0, 1_000_000)
assert again["tilt_deg"] == result.evaluation["corner"]["tilt_deg"]
assert type(result.policy).__name__ == ("OwnPolicy" if own else "Policy")
print(result)
"""


@pytest.mark.slow
@pytest.mark.parametrize("whose", ["ours", "own"])
def test_it_trains_in_a_notebook_that_uses_jax(whose: str) -> None:
    """On the one device that there is; our network, and one of the user's own with its loss."""
    path = os.pathsep.join(filter(None, sys.path))
    environment = os.environ | {"PYTHONPATH": path, "JAX_PLATFORMS": "cpu"}
    environment.pop("XLA_FLAGS", None)
    command = [sys.executable, "-c", IN_A_NOTEBOOK, whose]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "after 2,048 decisions" in done.stdout
    assert not isinstance(Callback().on_log({}), bool)
