"""The exported policy: the same values as the network, no JAX, no bad file accepted."""

import contextlib
import dataclasses
import json
import math
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
from hypothesis import given, settings
from hypothesis import strategies as st

import mjx_balance
from mjx_balance.config import Config, preset
from mjx_balance.dqn.networks import QNetwork
from mjx_balance.policy.file import find_policy, load_policy, save_policy
from mjx_balance.policy.manifest import PolicyError, make_manifest
from mjx_balance.policy.network import Policy

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
    manifest = make_manifest(small_config(head), "0123456789abcdef", {"seed": 5})
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


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A sound policy file's content."""
    return written(tmp_path_factory.mktemp("sound") / "p", "radial").read_bytes()


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file to spoil again and again."""
    return tmp_path_factory.mktemp("scratch") / "p.safetensors"


def test_the_fingerprint_is_of_every_array_of_the_weights(tmp_path: Path) -> None:
    """A change anywhere, a bias or the head's profile included, gives another; a note does not."""
    path = written(tmp_path / "p", "radial")
    names, prints = safetensors.numpy.load_file(path), [load_policy(path).fingerprint]
    for name in names:
        written(path, "radial")
        rewrite(path, lambda weights, _: weights.update({name: weights[name] + 0.125}))  # noqa: B023
        prints.append(load_policy(path).fingerprint)
    assert len(set(prints)) == len(names) + 1
    written(path, "radial")
    rewrite(path, lambda _, manifest: manifest.update(training={"note": "another"}))
    assert load_policy(path).fingerprint == prints[0]


def test_radial_values_by_hand(tmp_path: Path) -> None:
    """Q = V + alpha exp(-beta z) - kappa z, z = sqrt(delta^2 + |k (x - mu)|^2), in plain Python."""
    path = written(tmp_path / "p", "radial")
    weights = {k: v.astype(float) for k, v in safetensors.numpy.load_file(path).items()}
    obs = np.random.default_rng(1).normal(size=34)
    layer = obs
    for name in ("hidden_0", "hidden_1"):
        layer = np.maximum(weights[f"{name}/kernel"].T @ layer + weights[f"{name}/bias"], 0)
    features = [*layer, *obs]
    value, mu_x, mu_y = (
        sum(f * w for f, w in zip(features, weights["head/kernel"][:, k], strict=True))
        + weights["head/bias"][k]
        for k in range(3)
    )
    alpha, beta, kappa, delta = (math.log1p(math.exp(p)) for p in weights["profile"])
    stretch_x, stretch_y = (math.exp(s) for s in weights["stretch"])
    got = load_policy(path).q_values(obs)
    for i in (0, 7, 20):
        for j in (0, 10, 19):
            x, y = -1 + i / 10, -1 + j / 10
            away = (stretch_x * (x - mu_x)) ** 2 + (stretch_y * (y - mu_y)) ** 2
            z = math.sqrt(delta**2 + away)
            expected = value + alpha * math.exp(-beta * z) - kappa * z
            assert got[21 * i + j] == pytest.approx(expected, abs=1e-4)


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
    assert manifest["scene_hash"] == "0123456789abcdef"
    assert manifest["training"] == {"seed": 5}
    assert manifest["versions"]["mujoco"]


def test_manifest_gives_times_and_offsets_of_the_preset_best() -> None:
    """Means over 5 samples of 4 ms, legs that move for the first 10% of 0.2 s."""
    manifest = make_manifest(preset("best"), "0" * 16, {})
    assert len(manifest["inputs"]) == 136
    assert [manifest["inputs"][k]["window"] for k in (0, 5, 16, 135)] == [1, 1, 5, 5]
    assert [manifest["inputs"][k]["offset"] for k in (0, 5, 16, 135)] == [0.35, 0.35, 0, 0]
    timing = {"sample_s": 0.004, "decision_samples": 50, "ramp_samples": 5}
    assert manifest["timing"] == timing
    assert (manifest["body_height_m"], manifest["fail_tilt_deg"]) == (0.35, 6.0)
    assert manifest["action"] == "grid"
    assert manifest["network"] == {"hidden_sizes": [64, 64], "factors": [21, 21], "radial": True}
    assert [leg["name"] for leg in manifest["robot"]["legs"]] == ["LF", "RF", "LH", "RH"]


def test_loaded_policy_equals_the_saved_one(tmp_path: Path) -> None:
    manifest = make_manifest(small_config("joint"), "0" * 16, {})
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


def test_a_run_folder_stands_for_its_policy(path: Path) -> None:
    folder = path.parent / "runs" / "first"
    folder.mkdir(parents=True)
    with pytest.raises(PolicyError, match=f"no policy file at {folder}; "):
        load_policy(folder)
    path.rename(folder / "policy.safetensors")
    assert find_policy(folder) == folder / "policy.safetensors"
    assert load_policy(folder).manifest["training"] == {"seed": 5}


def test_a_name_beyond_every_files_is_refused() -> None:
    with pytest.raises(PolicyError) as error:
        load_policy("a" * 300)
    # Newer Pythons take such a name for one that is not there.
    said = ("policy is 'aaaa", "no policy file at aaaa")
    assert str(error.value).startswith(said)


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
            r"weight head/bias is float32 of shape \(7,\); it must be float32 of shape \(42,\)",
        ),
        (
            lambda w, m: w.update({"hidden_0/kernel": np.zeros((33, 24), np.float32)}),
            r"weight hidden_0/kernel is .* \(33, 24\); it must be float32 of shape \(34, 24\)",
        ),
        (lambda w, m: w["hidden_1/kernel"].fill(np.nan), "weight hidden_1/kernel .* not finite"),
        (lambda w, m: w["head/bias"].fill(np.inf), "weight head/bias .* not finite"),
        (
            lambda w, m: w["head/kernel"].reshape(-1)[7:8].fill(np.nan),
            "weight head/kernel .* not finite",
        ),
        (lambda w, m: w.pop("head/kernel"), "weight head/kernel is missing"),
        (lambda w, m: m.update(version=99), "version is 99; this release reads 5$"),
        (
            lambda w, m: m.update(version=4),
            "version is 4; this release reads 5; `mjx-balance export OLD.safetensors --out NEW",
        ),
        (lambda w, m: m.update(format="onnx"), "format is 'onnx'"),
        (lambda w, m: m.pop("scene_hash"), "scene_hash is None; it must be a string"),
        (lambda w, m: m.pop("versions"), "versions is None; it must be a JSON object"),
        (lambda w, m: w.update(spare=np.zeros(3, np.float32)), "'spare' is none of this network's"),
        (
            lambda w, m: w.update({"head/bias": np.full(42, 1e300)}),
            "head/bias.* is F64; it must",
        ),
        (lambda w, m: w.update({"head/bias": np.zeros(42, np.int32)}), "head/bias.* is I32"),
        (lambda w, m: m["config"]["task"].update(action_levels=100_001), "action_levels is 100001"),
        (lambda w, m: m["robot"].update(wings=2), "its robot cannot be used: a robot must have"),
        (lambda w, m: m["robot"]["legs"].pop(), "its robot cannot be used: .* four legs"),
        (lambda w, m: m["robot"]["legs"][1].update(thigh="long"), "thigh must be a sane number"),
        (
            lambda w, m: m["robot"]["legs"][1].update(calf=float("nan")),
            "calf must be a sane number",
        ),
        (lambda w, m: m["robot"]["legs"][1]["signs"].pop(), "signs must have 3 entries"),
        (lambda w, m: m["robot"]["legs"][1].update(left=1), "left must be bool"),
        (lambda w, m: m["robot"]["legs"][1].update(name="RM"), "its inputs is not what"),
        (lambda w, m: m["inputs"].reverse(), "its inputs is not what"),
        (lambda w, m: m["network"].update(radial=True), "its network is not what"),
        (lambda w, m: m["timing"].update(ramp_samples=50), "its timing is not what"),
        (lambda w, m: m["config"].update(wings=2), "unknown field 'wings'"),
        (lambda w, m: m["config"]["task"].update(ctrl_dt=0.0), r"ctrl_dt is 0\.0"),
        (lambda w, m: m["actions"]["table_m"].pop(), "its actions is not what its own config"),
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


def test_weights_of_half_the_precision_are_refused(path: Path) -> None:
    """A policy made in memory, as training does, is no less checked than a file."""
    weights = safetensors.numpy.load_file(path)
    weights["head/bias"] = weights["head/bias"].astype(np.float16)
    with pytest.raises(PolicyError, match=r"head/bias is float16 of shape .* must be float32"):
        Policy(load_policy(path).manifest, weights)


def test_a_type_that_numpy_does_not_know_is_refused(path: Path) -> None:
    """BF16 and F8 exist in safetensors alone; written here by hand."""
    weights = safetensors.numpy.load_file(path)
    with safetensors.safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
    header, body = {"__metadata__": metadata}, b""
    for name, value in weights.items():
        kind, size = ("BF16", 2) if name == "head/bias" else ("F32", 4)
        end = len(body) + size * value.size
        header[name] = {"dtype": kind, "shape": value.shape, "data_offsets": (len(body), end)}
        body += value.tobytes()[: size * value.size]
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + body)
    with pytest.raises(PolicyError, match=r"weight 'head/bias' is BF16; it must be F32"):
        load_policy(path)


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, '{"a":' * 50_000, "9" * 5_000, "NaN", '{"config": ' + "[" * 9_000, "\ud800"],
    ids=("lists", "objects", "digits", "nan", "cut", "surrogate"),
)
def test_a_manifest_that_breaks_the_parser_is_refused(path: Path, text: str) -> None:
    weights = safetensors.numpy.load_file(path)
    text = text.encode("utf-8", "replace").decode()
    safetensors.numpy.save_file(weights, path, metadata={"manifest": text})
    with pytest.raises(PolicyError, match="manifest is"):
        load_policy(path)


def test_a_file_beyond_every_policy_is_not_even_read(path: Path) -> None:
    with path.open("r+b") as file:
        file.truncate(2**33)  # 8 GiB on paper, next to nothing on the disk
    with pytest.raises(PolicyError, match="8589934592 bytes; no policy has more"):
        load_policy(path)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=12,
)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_value_in_any_place_of_a_manifest_is_refused_or_loads(
    sound: bytes, scratch: Path, data: st.DataObject
) -> None:
    scratch.write_bytes(sound)

    def edit(weights: Weights, manifest: Manifest) -> None:
        place: Any = manifest
        for _ in range(data.draw(st.integers(0, 3))):
            inside = [v for v in place.values() if isinstance(v, dict)]
            place = data.draw(st.sampled_from(inside)) if inside else place
        place[data.draw(st.sampled_from(sorted(place)))] = data.draw(JSON)

    rewrite(scratch, edit)
    with contextlib.suppress(PolicyError):
        assert load_policy(scratch).q_values(np.zeros(34)).shape == (441,)


@settings(max_examples=150, deadline=None)
@given(position=st.floats(0, 1, exclude_max=True), bits=st.integers(1, 255), cut=st.booleans())
def test_a_flipped_byte_is_refused_or_loads(
    sound: bytes, scratch: Path, position: float, bits: int, cut: bool
) -> None:
    where = int(position * len(sound))
    flipped = sound[where] ^ bits
    scratch.write_bytes(sound[:where] + bytes([flipped]) + (b"" if cut else sound[where + 1 :]))
    with contextlib.suppress(PolicyError), np.errstate(over="ignore", invalid="ignore"):
        assert load_policy(scratch).q_values(np.zeros(34)).shape == (441,)


def test_a_policy_is_written_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As safetensors itself writes it; a neighbour that is called policy.part stays."""
    path, neighbour = tmp_path / "policy.safetensors", tmp_path / "policy.part"
    neighbour.write_text("not ours")
    written(path)
    whole = path.read_bytes()
    with safetensors.safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
    again = tmp_path / "again"
    safetensors.numpy.save_file(safetensors.numpy.load_file(path), again, metadata=metadata)
    assert again.read_bytes() == whole

    def full(number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left") as error:
        written(path, "joint")
    assert error.value.filename == str(path)
    assert path.read_bytes() == whole
    assert {x.name for x in tmp_path.iterdir()} == {path.name, neighbour.name, "again"}


def test_unfit_weights_are_never_written(tmp_path: Path) -> None:
    params = jax.tree.map(lambda x: np.full(x.shape, np.nan), random_params("joint"))
    manifest = make_manifest(small_config("joint"), "0" * 16, {})
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
