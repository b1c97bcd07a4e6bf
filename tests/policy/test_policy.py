"""The exported policy: the same values as the network, no JAX, no bad file accepted."""

import json
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from fixtures.policies import HEADS, random_params, random_policy, read_manifest, with_head

import mjx_balance
from mjx_balance.config import Config, preset
from mjx_balance.dqn.networks import QNetwork
from mjx_balance.policy.file import find_policy, load_policy, save_policy
from mjx_balance.policy.manifest import PolicyError, make_manifest
from mjx_balance.policy.network import Policy


@pytest.fixture
def path(tmp_path: Path, config: Config) -> Path:
    """A sound policy file, there to be damaged."""
    random_policy(tmp_path / "policy.safetensors", with_head(config, "factored"))
    return tmp_path / "policy.safetensors"


@pytest.mark.parametrize("head", HEADS)
def test_a_loaded_policy_has_the_networks_values(tmp_path: Path, config: Config, head: str) -> None:
    config = with_head(config, head)
    saved, loaded = random_policy(tmp_path / "p", config), load_policy(tmp_path / "p")
    assert [p.name for p in tmp_path.iterdir()] == ["p"], "nothing else is left behind"
    assert loaded.manifest == json.loads(json.dumps(saved.manifest))
    obs = np.random.default_rng(0).normal(size=(32, 34)).astype(np.float32)
    network = QNetwork((24, 16), HEADS[head], head == "radial")
    expected = np.asarray(network.apply(random_params(config), jnp.asarray(obs)))
    np.testing.assert_array_equal(loaded.q_values(obs), saved.q_values(obs))
    np.testing.assert_allclose(loaded.q_values(obs), expected, atol=1e-5)
    np.testing.assert_allclose(loaded.q_values(obs[3]), expected[3], atol=1e-5)
    np.testing.assert_array_equal(loaded(obs), expected.argmax(axis=-1))
    assert loaded(obs[3]).shape == ()
    assert loaded(obs[3]) == expected[3].argmax()


@pytest.mark.parametrize("head", HEADS)
def test_the_fingerprint_covers_every_number(tmp_path: Path, config: Config, head: str) -> None:
    """The last entry of each kernel and bias, and of the radial head's profile and scales."""
    policy = random_policy(tmp_path / "p", with_head(config, head))
    weights = safetensors.numpy.load_file(tmp_path / "p")
    fingerprints = {policy.fingerprint, Policy(policy.manifest, weights).fingerprint}
    assert len(fingerprints) == 1
    for name, value in weights.items():
        changed = value.copy()
        changed.flat[-1] += 0.01
        fingerprints.add(Policy(policy.manifest, weights | {name: changed}).fingerprint)
    assert len(fingerprints) == 1 + len(weights)


def test_the_manifest_says_what_it_needs_to_run(path: Path, config: Config) -> None:
    policy = load_policy(path)
    assert policy.config == with_head(config, "factored")
    assert policy.observation_size == 34
    np.testing.assert_allclose(1000 * policy.actions[21 * 20 + 10], (3.0, 0.0), atol=1e-6)
    manifest = policy.manifest
    assert manifest["inputs"][4] == {
        "name": "V_x,t-0",
        "sensor": "gyro",
        "index": 0,
        "lag": 0,
        "window": 1,
        "offset": 0.0,
        "scale": pytest.approx(0.0174533),
        "mirror": {"row": "V_x,t-0", "sign": -1},
    }
    assert (manifest["scene_hash"], manifest["training"]) == ("0" * 16, {"seed": 5})
    assert manifest["versions"]["mujoco"]


def test_the_manifest_of_the_preset_best_by_hand() -> None:
    """Means over 5 samples of 4 ms, legs that move for the first 10% of 0.2 s."""
    manifest = make_manifest(preset("best"), "0" * 16, {})
    rows = manifest["inputs"]
    assert len(rows) == 136
    assert [rows[k]["window"] for k in (0, 5, 16, 135)] == [1, 1, 5, 5]
    assert [rows[k]["offset"] for k in (0, 5, 16, 135)] == [0.35, 0.35, 0, 0]
    assert rows[1]["mirror"] == {"row": "H_LF", "sign": 1}
    assert (rows[135]["name"], rows[135]["lag"]) == ("Acc_y,t-145", 145)
    timing = {"sample_s": 0.004, "decision_samples": 50, "ramp_samples": 5}
    assert manifest["timing"] == timing
    assert (manifest["body_height_m"], manifest["fail_tilt_deg"]) == (0.35, 6.0)
    assert manifest["action"] == "continuous"
    assert manifest["network"] == {"hidden_sizes": [64, 64], "factors": [21, 21], "radial": True}
    assert [leg["name"] for leg in manifest["robot"]["legs"]] == ["LF", "RF", "LH", "RH"]


@pytest.mark.parametrize("shape", [(33,), (2, 35), (1, 2, 34), ()])
def test_observation_of_another_size_is_refused(path: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"obs has shape .* \(34,\) or \(batch, 34\)"):
        load_policy(path).q_values(np.zeros(shape))


def test_a_run_folder_stands_for_its_policy(path: Path) -> None:
    folder = path.parent / "runs" / "first"
    folder.mkdir(parents=True)
    with pytest.raises(PolicyError, match=f"no policy file at {folder}; "):
        load_policy(folder)
    path.rename(folder / "policy.safetensors")
    assert find_policy(folder) == folder / "policy.safetensors"
    assert load_policy(folder).manifest["training"] == {"seed": 5}


def test_a_name_of_no_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=r"no policy file at .*nowhere; .* best, .* are shipped"):
        load_policy(tmp_path / "nowhere")
    with pytest.raises(PolicyError) as error:
        load_policy("a" * 300)
    # Newer Pythons take such a name for one that is not there.
    assert str(error.value).startswith(("policy is 'aaaa", "no policy file at aaaa"))


def test_weights_of_half_the_precision_are_refused(path: Path) -> None:
    """A policy made in memory, as training does, is no less checked than a file."""
    weights = safetensors.numpy.load_file(path)
    weights["head/bias"] = weights["head/bias"].astype(np.float16)
    with pytest.raises(PolicyError, match=r"head/bias is float16 of shape .* must be float32"):
        Policy(load_policy(path).manifest, weights)


def test_a_policy_is_written_whole_or_not_at_all(
    path: Path, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As safetensors itself writes it; a neighbour that is called policy.part stays."""
    neighbour, whole = path.with_suffix(".part"), path.read_bytes()
    neighbour.write_text("not ours")
    again = path.with_name("again")
    metadata = {"manifest": json.dumps(read_manifest(path))}
    safetensors.numpy.save_file(safetensors.numpy.load_file(path), again, metadata=metadata)
    assert again.read_bytes() == whole

    def full(number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left") as error:
        random_policy(path, with_head(config, "joint"))
    assert error.value.filename == str(path)
    assert path.read_bytes() == whole
    assert {x.name for x in path.parent.iterdir()} == {path.name, neighbour.name, "again"}


def test_unfit_weights_are_never_written(tmp_path: Path, config: Config) -> None:
    config = with_head(config, "joint")
    params = random_params(config)
    params["params"]["head"]["bias"][5] = np.nan
    with pytest.raises(PolicyError, match="not finite"):
        save_policy(tmp_path / "policy.safetensors", params, make_manifest(config, "0" * 16, {}))
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
    expected = load_policy(path)(np.linspace(-2, 2, 68).reshape(2, 34))
    assert run.stdout.split() == [str(index) for index in expected]
