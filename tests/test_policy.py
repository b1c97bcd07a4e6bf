"""The exported policy: the same values as the network, no JAX, no bad file accepted."""

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors
import safetensors.numpy

import mjx_balance
from mjx_balance.config import Config, preset
from mjx_balance.dqn.networks import QNetwork
from mjx_balance.policy import Policy, PolicyError, load_policy, make_manifest, save_policy

HEADS = {"joint": (441,), "factored": (21, 21), "radial": (21, 21)}
Weights = dict[str, np.ndarray]
Manifest = dict[str, Any]


def small_config(head: str) -> Config:
    dqn = dataclasses.replace(preset("default").dqn, hidden_sizes=(24, 16), head=head)
    return dataclasses.replace(preset("default"), dqn=dqn)


def random_params(head: str) -> dict[str, Any]:
    """Variables of a flax network, weights and biases all random."""
    rng = np.random.default_rng(0)
    network = QNetwork((24, 16), HEADS[head], head == "radial")
    shapes: Any = jax.eval_shape(network.init, jax.random.PRNGKey(0), jnp.zeros(34))
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(0, 0.2, x.shape), jnp.float32), shapes)


def written(path: Path, head: str = "factored") -> Path:
    manifest = make_manifest(small_config(head), "0123456789abcdef", HEADS[head], {"seed": 5})
    save_policy(path, random_params(head), manifest)
    return path


def rewrite(path: Path, edit: Callable[[Weights, Manifest], object]) -> None:
    """Changes weights and manifest in place, behind the package's back."""
    weights = safetensors.numpy.load_file(path)
    with safetensors.safe_open(path, framework="numpy") as file:
        manifest = json.loads(file.metadata()["manifest"])
    edit(weights, manifest)
    safetensors.numpy.save_file(weights, path, metadata={"manifest": json.dumps(manifest)})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A sound policy file, there to be damaged."""
    return written(tmp_path / "policy.safetensors")


@pytest.mark.parametrize("head", HEADS)
def test_numpy_values_equal_the_networks(tmp_path: Path, head: str) -> None:
    policy = load_policy(written(tmp_path / "policy.safetensors", head))
    obs = np.random.default_rng(0).normal(size=(32, 34)).astype(np.float32)
    network = QNetwork((24, 16), HEADS[head], head == "radial")
    expected = np.asarray(network.apply(random_params(head), obs))
    np.testing.assert_allclose(policy.q_values(obs), expected, atol=1e-5)
    np.testing.assert_allclose(policy.q_values(obs[3]), expected[3], atol=1e-5)
    np.testing.assert_array_equal(policy(obs), expected.argmax(axis=-1))
    assert policy(obs[3]).shape == ()
    assert policy(obs[3]) == expected[3].argmax()


def test_file_says_what_it_needs_to_run(path: Path) -> None:
    policy = load_policy(path)
    assert policy.config == small_config("factored")
    assert policy.observation_size == 34
    np.testing.assert_allclose(1000 * policy.actions[21 * 20 + 10], (3.0, 0.0), atol=1e-6)
    manifest = policy.manifest
    assert manifest["observation"]["names"][4] == "V_x,t-0"
    assert manifest["observation"]["scale"][4] == pytest.approx(0.0174533)
    assert manifest["rates_hz"] == {"decision": 5.0, "imu": 250.0}
    assert manifest["scene_hash"] == "0123456789abcdef"
    assert manifest["training"] == {"seed": 5}
    assert manifest["versions"]["mujoco"]


def test_loaded_policy_equals_the_saved_one(tmp_path: Path) -> None:
    manifest = make_manifest(small_config("joint"), "0" * 16, (441,), {})
    saved = save_policy(tmp_path / "p", random_params("joint"), manifest)
    loaded = load_policy(tmp_path / "p")
    obs = np.ones(34, np.float32)
    np.testing.assert_array_equal(loaded.q_values(obs), saved.q_values(obs))
    assert loaded.manifest == json.loads(json.dumps(saved.manifest))
    assert [p.name for p in tmp_path.iterdir()] == ["p"], "nothing else is left behind"


@pytest.mark.parametrize("shape", [(33,), (2, 35), (1, 2, 34), ()])
def test_observation_of_another_size_is_refused(path: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"obs has shape .* \(34,\) or \(batch, 34\)"):
        load_policy(path).q_values(np.zeros(shape))


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=r"no policy file at .*nowhere"):
        load_policy(tmp_path / "nowhere")


@pytest.mark.parametrize("kept", [0, 4, 100, -1])
def test_truncated_file_is_refused(path: Path, kept: int) -> None:
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(PolicyError, match="damaged"):
        load_policy(path)


def test_text_file_is_refused(path: Path) -> None:
    path.write_text("The quick brown fox jumps over the lazy dog.\n" * 20)
    with pytest.raises(PolicyError, match="no safetensors file"):
        load_policy(path)


def test_weights_without_a_manifest_are_refused(path: Path) -> None:
    safetensors.numpy.save_file({"x": np.zeros(3, np.float32)}, path)
    with pytest.raises(PolicyError, match="no manifest"):
        load_policy(path)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (
            lambda w, m: w.update({"head/bias": np.zeros(7, np.float32)}),
            r"weight head/bias has shape \(7,\); it must be \(42,\)",
        ),
        (
            lambda w, m: w.update({"hidden_0/kernel": np.zeros((33, 24), np.float32)}),
            r"weight hidden_0/kernel has shape \(33, 24\); it must be \(34, 24\)",
        ),
        (lambda w, m: w["hidden_1/kernel"].fill(np.nan), "weight hidden_1/kernel .* not finite"),
        (lambda w, m: w["head/bias"].fill(np.inf), "weight head/bias .* not finite"),
        (lambda w, m: w.pop("head/kernel"), "weight head/kernel is missing"),
        (lambda w, m: m.update(version=99), "format version is 99; this release reads version 2"),
        (lambda w, m: m.update(format="onnx"), "format is 'onnx'"),
        (lambda w, m: m.pop("scene_hash"), "manifest cannot be used: 'scene_hash'"),
        (lambda w, m: m["config"].update(wings=2), "unknown field 'wings'"),
        (lambda w, m: m["config"]["task"].update(ctrl_dt=0.0), r"ctrl_dt is 0\.0"),
        (lambda w, m: m["actions"]["table_m"].pop(), r"action table has shape \(440, 2\)"),
    ],
)
def test_unfit_content_is_refused(
    path: Path, edit: Callable[[Weights, Manifest], object], message: str
) -> None:
    rewrite(path, edit)
    with pytest.raises(PolicyError, match=message) as caught:
        load_policy(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda m: [],
        lambda m: m["network"].update(factors=["many", "more"]) or m,
        lambda m: m["actions"].update(table_m=[[0.0, 0.0], [0.0]]) or m,
    ],
    ids=("no object", "factors in words", "ragged action table"),
)
def test_senseless_manifest_is_refused(path: Path, spoil: Callable[[Manifest], object]) -> None:
    manifest = load_policy(path).manifest
    weights = safetensors.numpy.load_file(path)
    metadata = {"manifest": json.dumps(spoil(manifest))}
    safetensors.numpy.save_file(weights, path, metadata=metadata)
    with pytest.raises(PolicyError, match="cannot be used"):
        load_policy(path)


def test_unfit_weights_are_never_written(tmp_path: Path) -> None:
    params = jax.tree.map(lambda x: np.full(x.shape, np.nan), random_params("joint"))
    manifest = make_manifest(small_config("joint"), "0" * 16, (441,), {})
    with pytest.raises(PolicyError, match="not finite"):
        save_policy(tmp_path / "policy.safetensors", params, manifest)
    assert not list(tmp_path.iterdir())


WITHOUT_JAX = """
import importlib.abc, sys
import numpy as np

class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.split(".")[0] in ("jax", "jaxlib", "flax", "brax", "optax", "orbax"):
            raise ImportError(f"{name} is not installed")

sys.meta_path.insert(0, Absent())
sys.path.insert(0, sys.argv[1])
from mjx_balance import load_policy
policy = load_policy(sys.argv[2])
print(*policy(np.linspace(-2, 2, 68).reshape(2, 34)))
assert not {"jax", "flax", "brax"} & set(sys.modules)
"""


def test_policy_runs_where_jax_is_not_installed(path: Path) -> None:
    root = Path(mjx_balance.__file__).resolve().parents[1]
    command = [sys.executable, "-W", "error", "-c", WITHOUT_JAX, str(root), str(path)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert run.returncode == 0, run.stderr
    policy: Policy = load_policy(path)
    expected = policy(np.linspace(-2, 2, 68).reshape(2, 34))
    assert run.stdout.split() == [str(index) for index in expected]
