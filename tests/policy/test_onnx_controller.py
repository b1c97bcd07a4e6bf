"""The stateful ONNX model: sample by sample what the runtime does while it balances."""

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from fixtures.policies import LAYOUTS, random_policy, rewrite, with_head
from fixtures.streams import evaluation_samples
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import numpy_helper

from mjx_balance.cli import main
from mjx_balance.config import Config
from mjx_balance.policy import onnx_controller
from mjx_balance.policy.file import load_policy, shipped_policies
from mjx_balance.policy.onnx import Graph, Tensors
from mjx_balance.policy.onnx_controller import controller_model, export_controller
from mjx_balance.runtime import Controller, Model, State

SHIPPED = shipped_policies()
AGREE = 1e-9
"""rad. Both compute in float64; the promise is 1e-6."""


def session(model: onnx.ModelProto) -> onnxruntime.InferenceSession:
    """A model on one thread of this machine."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    content = model.SerializeToString()
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])


class Pair:
    """The runtime, and its model under onnxruntime."""

    def __init__(self, path: Path):
        self.now = 0.0
        self.python = Controller(path, lambda: self.now)
        self._session = session(controller_model(self.python.model))
        self.size = self._session.get_inputs()[-1].shape[0]
        self.reset()

    def reset(self) -> None:
        self.python.reset()
        self.state, self.count = np.zeros(self.size), 0

    def run(self, joints: Any, gyro: Any, accelerometer: Any) -> Any:
        """Targets, command and whether it decided, of the model alone."""
        values = [np.asarray(x, float) for x in (joints, gyro, accelerometer)]
        names = ("joint_positions", "gyro", "accelerometer")
        inputs = dict(zip(names, values, strict=True)) | {"state": self.state}
        *outputs, self.state = self._session.run(None, inputs)
        return outputs

    def step(self, joints: Any, gyro: Any, accelerometer: Any) -> bool:
        """A sample for both; False once the runtime no longer balances."""
        self.now += self.python.sample_dt
        expected = self.python.step(joints, gyro, accelerometer)
        if self.python.state is not State.BALANCING:
            return False
        targets, command, decided = self.run(joints, gyro, accelerometer)
        np.testing.assert_allclose(targets, expected, rtol=0, atol=AGREE)
        assert self.python.command is not None
        np.testing.assert_allclose(command, self.python.command, rtol=0, atol=1e-12)
        assert decided == (self.count % self.python.decision_samples == 0)
        self.count += 1
        return True


def stand(pair: Pair, decisions: int, seed: int = 0) -> int:
    """Noisy samples of a standing robot; returns how many different commands there were."""
    rng, commands = np.random.default_rng(seed), set()
    for _ in range(decisions * pair.python.decision_samples + 1):
        imu = rng.normal((0, 0, 0, 0, 0, 9.81), (0.02, 0.02, 0.02, 0.2, 0.2, 0.2))
        assert pair.step(pair.python.targets + rng.normal(0, 0.03, (4, 3)), imu[:3], imu[3:])
        assert pair.python.command is not None
        commands.add(tuple(pair.python.command))
    return len(commands)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_policy_does_what_the_runtime_does(name: str) -> None:
    """A state of zeros begins again."""
    pair = Pair(SHIPPED[name])
    assert stand(pair, 4) >= 4
    pair.reset()
    stand(pair, 1, seed=1)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_any_layout_does_what_the_runtime_does(layout: str, tmp_path: Path, config: Config) -> None:
    """Random weights, joints and samples: every head, window, memory, rate and ramp."""
    head, changes = LAYOUTS[layout]
    random_policy(tmp_path / "p", with_head(config, head, body_height=0.33, **changes))
    assert stand(Pair(tmp_path / "p"), 12) > 4


def test_legs_stay_within_their_reach(tmp_path: Path, config: Config) -> None:
    """A policy that always raises the left front and lowers the right hind, a decision a sample."""
    head, changes = LAYOUTS["every sample"]
    path = tmp_path / "p"
    random_policy(path, with_head(config, head, body_height=0.33, **changes))
    rewrite(path, lambda w, m: w["head/bias"].fill(50))
    pair = Pair(path)
    stand(pair, 60)
    heights = pair.python.model.legs.foot_heights(pair.python.targets)
    most = pair.python.model.legs.height_range[1]
    assert heights.max() == pytest.approx(most, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_policy_does_what_the_runtime_does_in_evaluations(name: str) -> None:
    pair, decisions = Pair(SHIPPED[name]), 0
    for suite in ("corner", "push", "noise"):
        for samples in evaluation_samples(SHIPPED[name], suite, 1, 20.0):
            pair.reset()
            assert all(pair.step(*sample) for sample in samples)
            decisions += len(samples) // pair.python.decision_samples
    assert decisions >= 297


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> list[Pair]:
    """A policy with the longest memory, and one on the grid."""
    grid = tmp_path_factory.mktemp("grid") / "grid.safetensors"
    assert main(["export", "best", "--action", "grid", "--out", str(grid)]) == 0
    return [Pair(SHIPPED["real"]), Pair(grid)]


@settings(max_examples=15, deadline=None)
@given(
    which=st.integers(0, 1),
    seed=st.integers(0, 2**32 - 1),
    segments=st.lists(
        st.tuples(
            st.integers(1, 120),
            st.floats(0, 0.4),
            st.floats(-3, 3),
            st.floats(-3, 3),
            st.floats(0, 0.2),
        ),
        min_size=1,
        max_size=4,
    ),
)
def test_random_streams_are_the_runtimes(
    pairs: list[Pair], which: int, seed: int, segments: list[tuple[int, float, float, float, float]]
) -> None:
    """Turns, leans and joints of any size, as long as the runtime balances."""
    pair, rng = pairs[which], np.random.default_rng(seed)
    pair.reset()
    for count, rate, ahead, aside, play in segments:
        for _ in range(count):
            mean = (rate, -rate, rate, ahead, aside, 9.81)
            imu = rng.normal(mean, (0.1, 0.1, 0.1, 1.0, 1.0, 1.0))
            joints = pair.python.targets + rng.uniform(-play, play, (4, 3))
            if not pair.step(joints, imu[:3], imu[3:]):
                return


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", ["joints", "gyro", "accelerometer"])
def test_a_reading_that_is_not_finite_spoils_all_targets_until_it_begins_again(
    pairs: list[Pair], place: str, value: float
) -> None:
    for pair in pairs:
        pair.reset()
        stand(pair, 1)
        good = {"joints": np.zeros((4, 3)), "gyro": np.zeros(3), "accelerometer": np.ones(3)}
        bad = {name: x.copy() for name, x in good.items()}
        bad[place].flat[-1] = value
        for sample in (bad, *[good] * 120):
            targets, command, _ = pair.run(*sample.values())
            assert np.isnan(targets).all()
            assert np.isnan(command).all()
        pair.reset()
        stand(pair, 1)


def test_the_angle_is_atan2_in_float64() -> None:
    """In all quadrants, on the axes, and near them."""
    graph = Graph()
    graph.add("Identity", onnx_controller._angle(graph, "y", "x"), output="angle")
    ends: Tensors = {"y": (np.float64, ("N",)), "x": (np.float64, ("N",))}
    run = session(graph.model("angle", "", ends, {"angle": (np.float64, ("N",))}, {})).run
    turns = np.linspace(-math.pi, math.pi, 20_001)
    y, x = 3e-3 * np.sin(turns), 3e-3 * np.cos(turns)
    near = [s * 10.0**-k for k in range(20) for s in (-1, 1)]
    sides = [(a, b) for a in near for b in (-1.0, 1.0)]
    sides += [(b, a) for a, b in sides] + [(0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0)]
    y, x = np.append(y, [a for a, _ in sides]), np.append(x, [b for _, b in sides])
    angle: Any = run(None, {"y": y, "x": x})[0]
    np.testing.assert_allclose(angle, np.arctan2(y, x), rtol=0, atol=1e-15)


def test_the_command_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "policy.onnx"
    assert main(["export", "real", "--out", str(file), "--stateful"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{file}: {file.stat().st_size / 1000:.1f} kB, opset 17",
        "joint_positions (4, 3), gyro (3,), accelerometer (3,), state (939,) float64 -> "
        "targets (4, 3), command (2,) float64, decided () bool, next_state (939,) float64",
    ]
    assert file.stat().st_size < 135_000
    assert os.listdir(tmp_path) == ["policy.onnx"]
    runtime = session(onnx.load(file))
    ends = [(x.name, x.shape, x.type) for x in (*runtime.get_inputs(), *runtime.get_outputs())]
    assert ends == [
        ("joint_positions", [4, 3], "tensor(double)"),
        ("gyro", [3], "tensor(double)"),
        ("accelerometer", [3], "tensor(double)"),
        ("state", [939], "tensor(double)"),
        ("targets", [4, 3], "tensor(double)"),
        ("command", [2], "tensor(double)"),
        ("decided", [], "tensor(bool)"),
        ("next_state", [939], "tensor(double)"),
    ]
    manifest = json.loads(runtime.get_modelmeta().custom_metadata_map["manifest"])
    assert manifest == load_policy("real").manifest


@pytest.mark.parametrize("out", ["policy.h", "policy.safetensors"])
def test_only_onnx_is_stateful(
    out: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", "best", "--out", out, "--stateful"]) == 2
    expected = f"stateful is set, but out is {out}; only a model in .onnx can be stateful\n"
    assert capsys.readouterr().err == f"mjx-balance: {expected}"
    assert not os.listdir(tmp_path)


def test_a_model_that_is_not_the_runtime_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of its numbers is off by a thousandth."""

    def damaged(policy: Model) -> onnx.ModelProto:
        model = controller_model(policy)
        for k, constant in enumerate(model.graph.initializer):
            array = numpy_helper.to_array(constant)
            if array.dtype == float and array.shape == policy.legs.thigh.shape:
                model.graph.initializer[k].CopyFrom(
                    numpy_helper.from_array(array * 1.001, constant.name)
                )
                return model
        raise AssertionError

    monkeypatch.setattr(onnx_controller, "controller_model", damaged)
    with pytest.raises(RuntimeError, match="targets differ from the runtime's by"):
        export_controller(SHIPPED["best"], tmp_path / "p.onnx")
    assert not os.listdir(tmp_path)
