"""Rewrites policy files of version 0.2 (format 3) as today's format; the weights stay.

Format 4 describes the robot leg by leg. Only policies of our own quadruped in the scene that 0.2
shipped are taken, which is today's.

    python policies/upgrade.py policies/*.safetensors policies/seeds/*.safetensors
"""

import argparse
import json
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy

from mjx_balance.config import Config, check, from_dict
from mjx_balance.policy.file import FORMAT_VERSION, UPGRADED, Policy, load_policy, make_manifest
from mjx_balance.sim.scene import load_scene


def upgrade(path: Path) -> None:
    """Rewrites one file, and checks that its weights are bit for bit what they were."""
    with safetensors.safe_open(path, framework="numpy") as file:
        manifest = json.loads(file.metadata()["manifest"])
        weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    if manifest["version"] == FORMAT_VERSION:
        print(f"{path}: is of today's format")
        return
    config = check(from_dict(Config, manifest["config"]))
    scene = load_scene(config)
    if manifest["version"] != UPGRADED or manifest["scene_hash"] != scene.hash:
        raise SystemExit(f"{path}: not a format-{UPGRADED} policy of today's scene")
    versions = {"versions": manifest["versions"]}
    new = make_manifest(config, scene.hash, manifest["training"]) | versions
    for part in ("network", "observation", "actions", "rates_hz"):
        assert new[part] == manifest[part], part
    before = Policy(new, weights).fingerprint
    part = path.with_suffix(".part")
    safetensors.numpy.save_file(weights, part, metadata={"manifest": json.dumps(new)})
    part.replace(path)
    with safetensors.safe_open(path, framework="numpy") as file:
        same = all(np.array_equal(file.get_tensor(name), x) for name, x in weights.items())
    assert same
    assert load_policy(path).fingerprint == before
    print(f"{path}: format {FORMAT_VERSION}, weights {before}")


def main() -> None:
    """Rewrites every file named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("policies", nargs="+", type=Path)
    for path in parser.parse_args().policies:
        upgrade(path)


if __name__ == "__main__":
    main()
