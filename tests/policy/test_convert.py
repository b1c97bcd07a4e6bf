"""Policies of format 4 become format 5; their weights stay bit for bit."""

import hashlib
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.policies import Manifest, Weights, rewrite

from mjx_balance import load_policy
from mjx_balance.cli import main
from mjx_balance.policy.manifest import PolicyError

BEST = Path(__file__).parents[2] / "policies" / "best.safetensors"


def weights_digest(path: Path) -> str:
    """SHA-256 of what follows a safetensors file's header."""
    content = path.read_bytes()
    return hashlib.sha256(content[8 + int.from_bytes(content[:8], "little") :]).hexdigest()


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """The shipped policy as release 0.3 wrote it: names and scales instead of rows."""

    def edit(weights: Weights, manifest: Manifest) -> None:
        rows = manifest.pop("inputs")
        for part in ("action", "timing", "body_height_m", "fail_tilt_deg"):
            del manifest[part]
        manifest["version"] = 4
        manifest["observation"] = {
            "names": [row["name"] for row in rows],
            "scale": [row["scale"] for row in rows],
            "height_offset_m": 0.35,
            "imu_lag_s": 0.004,
            "imu_mean_samples": 5,
        }
        manifest["actions"]["ramp_s"] = 0.02
        manifest["rates_hz"] = {"decision": 5.0, "imu": 250.0}

    path = tmp_path / "old.safetensors"
    shutil.copy(BEST, path)
    rewrite(path, edit)
    return path


def test_an_old_policy_is_refused_with_the_command_that_converts_it(
    old: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = (
        f"{old} cannot be used: version is 4; this release reads 5; "
        "`mjx-balance export OLD.safetensors --out NEW.safetensors` converts a file of version 4"
    )
    with pytest.raises(PolicyError) as caught:
        load_policy(old)
    assert str(caught.value) == message
    assert main(["evaluate", str(old)]) == 2
    assert capsys.readouterr().err == f"mjx-balance: {message}\n"


@pytest.mark.parametrize("name", ["new.safetensors", "old.safetensors"])
def test_converting_leaves_the_weights_alone(
    old: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Into another file, and in place; what comes out is what is shipped, byte for byte."""
    out = old.parent / name
    assert main(["export", str(old), "--out", str(out)]) == 0
    policy, shipped = load_policy(out), load_policy(BEST)
    size = f"{out.stat().st_size / 1000:.1f} kB"
    said = capsys.readouterr().out
    assert said == f"{out}: {size}, format 5, weights {shipped.fingerprint}\n"
    assert weights_digest(out) == weights_digest(BEST)
    assert (policy.config, policy.robot) == (shipped.config, shipped.robot)
    # The new file has all fields of config and robot, also those that are younger than the old one.
    parts = policy.manifest.keys() - {"config", "robot"}
    assert all(policy.manifest[part] == shipped.manifest[part] for part in parts)
    assert policy.manifest.keys() == shipped.manifest.keys() - {"leg_trim_rad"}  # only measured
    obs = np.random.default_rng(0).normal(size=(100, 136))
    np.testing.assert_array_equal(policy.q_values(obs), shipped.q_values(obs))


def test_a_policy_of_todays_format_is_copied(tmp_path: Path) -> None:
    out = tmp_path / "copy.safetensors"
    assert main(["export", "best", "--out", str(out)]) == 0
    assert out.read_bytes() == BEST.read_bytes()


OUTS = [("p.safetensors",), ("p.h",), ("p.onnx",), ("p.onnx", "--stateful")]


@pytest.mark.parametrize("out", OUTS, ids=" ".join)
def test_an_old_policy_becomes_what_its_copy_of_today_becomes(
    old: Path, out: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(old.parent)
    assert main(["export", "old.safetensors", "--out", "new.safetensors"]) == 0
    contents = []
    for policy in ("old.safetensors", "new.safetensors"):
        assert main(["export", policy, "--out", *out]) == 0
        contents.append(Path(out[0]).read_bytes())
    assert contents[0] == contents[1]


@pytest.mark.parametrize("out", OUTS, ids=" ".join)
@pytest.mark.parametrize("version", [3, 6])
def test_a_policy_of_another_format_is_refused_for_every_kind_of_file(
    old: Path,
    version: int,
    out: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    rewrite(old, lambda w, m: m.update(version=version))
    monkeypatch.chdir(old.parent)
    assert main(["export", "old.safetensors", "--out", *out]) == 2
    message = f"old.safetensors cannot be used: version is {version}; this release reads 5\n"
    assert capsys.readouterr().err == f"mjx-balance: {message}"
    assert not Path(out[0]).exists()


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [
        ("version", 3, "version is 3; this release reads 5"),
        ("config", {"wings": 2}, "its config cannot be used: unknown field 'wings'"),
        ("robot", {}, "its robot cannot be used"),
        ("scene_hash", None, "scene_hash is None; it must be a text"),
        ("training", [], r"training is \[\]; it must map names to values"),
    ],
)
def test_what_is_no_policy_is_not_converted(
    old: Path, part: str, value: Any, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    rewrite(old, lambda w, m: m.update({part: value}))
    out = old.parent / "new.safetensors"
    assert main(["export", str(old), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"mjx-balance: {old} cannot be used: ")
    assert re.search(message, error)
    assert not out.exists()
