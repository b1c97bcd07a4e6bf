"""The ONNX model: what NumPy computes, under onnxruntime; written whole or not at all."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from fixtures.policies import HEADS, random_params, with_head

from mjx_balance import load_policy
from mjx_balance.cli import main
from mjx_balance.config import preset
from mjx_balance.evaluation.controllers import View
from mjx_balance.evaluation.rollout import policy_scene, run_suite
from mjx_balance.policy.file import flat_weights
from mjx_balance.policy.manifest import make_manifest
from mjx_balance.policy.network import Policy
from mjx_balance.policy.onnx import IR_VERSION, OPSET, onnx_model

SHIPPED = Path(__file__).parents[2] / "policies" / "best.safetensors"
NAMES = ["shipped", *HEADS, "off the grid"]


@pytest.fixture(scope="module")
def observations() -> np.ndarray:
    """(1,000, 136) of the shipped policy in 2 s of 100 scenarios, a quarter of them with pushes."""
    policy = load_policy(SHIPPED)
    seen = []

    def watched(view: View) -> np.ndarray:
        seen.append(view.obs)
        return policy(view.obs)

    for suite in ("corner", "noise", "latency", "push"):
        run_suite(policy_scene(policy), watched, suite, 25, 2.0, 3)
    return np.concatenate(seen).astype(np.float32)


def make_policy(name: str) -> Policy:
    """The shipped policy, or one of the same inputs and a head whose weights are all random."""
    if name == "shipped":
        return load_policy(SHIPPED)
    config = with_head(preset("best"), name if name in HEADS else "radial")
    if name not in HEADS:
        config = with_head(preset("best"), "radial", action="continuous", action_max=0.004)
    manifest = make_manifest(config, "0" * 16, {"seed": 5})
    return Policy(manifest, flat_weights(random_params(config)))


def session(model: bytes) -> onnxruntime.InferenceSession:
    """A model on one thread of this machine."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def running(policy: Policy) -> Callable[[np.ndarray], Any]:
    """A policy's model under onnxruntime: observations to action values and actions."""
    runtime = session(onnx_model(policy).SerializeToString())
    return lambda obs: runtime.run(["q_values", "action", "command"], {"observation": obs})


@pytest.fixture(params=NAMES)
def policy(request: pytest.FixtureRequest) -> Policy:
    """A policy of every head."""
    return make_policy(request.param)


def test_values_and_actions_equal_numpys(policy: Policy, observations: np.ndarray) -> None:
    assert observations.shape == (1_000, 136)
    expected, chosen = policy.q_values(observations), policy(observations)
    assert len(np.unique(chosen)) > 20, "the policy does choose"
    values, actions, commands = running(policy)(observations)
    assert (values.dtype, actions.dtype) == (np.float32, np.int64)
    assert (values.shape, actions.shape) == ((1_000, 441), (1_000,))
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(actions, chosen)
    assert (commands.dtype, commands.shape) == (np.float32, (1_000, 2))
    np.testing.assert_allclose(commands, policy.command(observations), rtol=0, atol=1e-8)
    alone, action, _ = running(policy)(observations[:1])
    np.testing.assert_allclose(alone, expected[:1], rtol=0, atol=1e-5)
    assert action.tolist() == chosen[:1].tolist()


def test_no_observation_gives_no_action(policy: Policy) -> None:
    values, action, command = running(policy)(np.zeros((0, 136), np.float32))
    assert (values.shape, action.shape, command.shape) == ((0, 441), (0,), (0, 2))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30, -1e30])
def test_a_broken_sensor_gets_an_action_of_the_table(
    policy: Policy, value: float, observations: np.ndarray
) -> None:
    """Of one input, and of all."""
    spoilt = observations[:137].copy()
    np.fill_diagonal(spoilt[1:], value)
    spoilt[0] = value
    _, action, command = running(policy)(spoilt)
    assert action.min() >= 0
    assert action.max() < 441
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(command[1:], policy.command(spoilt[1:]), rtol=0, atol=3e-4)
    step = policy.actions[1, 1] - policy.actions[0, 1]
    np.testing.assert_allclose(command, policy.actions[action], rtol=0, atol=0.501 * step)


def test_equal_values_give_numpys_choice() -> None:
    """All weights zero: of equal digits the first, half way between two points the even one."""
    for name in HEADS:
        policy = make_policy(name)
        for kernel, bias in policy.layers:
            kernel.fill(0)
            bias.fill(0)
        if name == "radial":
            policy.layers[-1][1][1:] = (0.05, 0.15)
        obs = np.ones((1, 136), np.float32)
        _, action, _ = running(policy)(obs)
        expected = {"joint": 0, "factored": 0, "radial": 21 * 10 + 12}[name]
        assert action[0] == policy(obs)[0] == expected


def test_file_says_what_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "policy.onnx"
    assert main(["export", str(SHIPPED), "--out", str(file)]) == 0
    output = capsys.readouterr().out.splitlines()
    assert output == [
        f"{file}: {file.stat().st_size / 1000:.1f} kB, opset 17",
        "observation (N, 136) float32 -> q_values (N, 441) float32, action (N,) int64, "
        "command (N, 2) float32",
    ]
    assert file.stat().st_size < 115_000
    assert os.listdir(tmp_path) == ["policy.onnx"]
    policy = load_policy(SHIPPED)
    runtime = session(file.read_bytes())
    meta = runtime.get_modelmeta()
    assert set(meta.custom_metadata_map) == {"manifest"}
    manifest = json.loads(meta.custom_metadata_map["manifest"])
    assert manifest == policy.manifest
    assert (manifest["inputs"][-1]["name"], manifest["inputs"][-1]["lag"]) == ("Acc_y,t-145", 145)
    assert meta.producer_name == "mjx_balance"
    shapes = [(x.name, x.shape, x.type) for x in (*runtime.get_inputs(), *runtime.get_outputs())]
    assert shapes == [
        ("observation", ["N", 136], "tensor(float)"),
        ("q_values", ["N", 441], "tensor(float)"),
        ("action", ["N"], "tensor(int64)"),
        ("command", ["N", 2], "tensor(float)"),
    ]
    model = onnx.load(file)
    onnx.checker.check_model(model, full_check=True)
    assert [(x.domain, x.version) for x in model.opset_import] == [("", OPSET)]
    assert model.ir_version == IR_VERSION == onnx.helper.find_min_ir_version_for(model.opset_import)
    assert model.producer_version == make_manifest(policy.config, "", {})["versions"]["mjx_balance"]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("none.safetensors", "--out", "p.onnx"), "no policy file at none.safetensors"),
        (("text", "--out", "p.onnx"), "text is damaged or no safetensors file"),
        (
            (str(SHIPPED), "--out", "p.h5"),
            "out is p.h5; its name must end in .onnx, .h or .safetensors",
        ),
        ((str(SHIPPED), "--out", "no/p.safetensors"), "cannot write no/p.safetensors: No such"),
        ((str(SHIPPED), "--out", "no/p.onnx"), "cannot write no/p.onnx: No such file or directory"),
        ((str(SHIPPED), "--out", "folder.onnx"), "cannot write folder.onnx: Is a directory"),
        ((str(SHIPPED),), "--out"),
    ],
)
def test_impossible_exports_are_refused(
    arguments: tuple[str, ...],
    named: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text").write_text("this is no policy")
    (tmp_path / "folder.onnx").mkdir()
    try:
        code = main(("export", *arguments))
    except SystemExit as stopped:  # tyro's own refusals
        code = stopped.code
    assert code == 2
    output = capsys.readouterr()
    assert named in output.err + output.out
    assert sorted(os.listdir(tmp_path)) == ["folder.onnx", "text"]
    assert not os.listdir(tmp_path / "folder.onnx")
    assert (tmp_path / "text").read_text() == "this is no policy"


def test_without_the_package_onnx_it_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    monkeypatch.delitem(sys.modules, "mjx_balance.policy.onnx")
    assert main(["export", str(SHIPPED), "--out", str(tmp_path / "p.onnx")]) == 2
    output = capsys.readouterr().err
    assert output.startswith("mjx-balance: export needs the package onnx (")
    assert "; the extra onnx brings it: `pip install -e '.[onnx]'` in a checkout, or" in output
    assert output.count("\n") == 1
    assert not os.listdir(tmp_path)
