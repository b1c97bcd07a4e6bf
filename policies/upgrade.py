"""Rewrites policy files of version 0.1 (format 2) as today's format; the weights stay.

Format 3 names the robot and its record, the training's solver settings and today's config
fields, and its scene fingerprint covers the solver. Only policies of the scene that 0.1
shipped are taken, which is today's.

    python policies/upgrade.py policies/*.safetensors policies/seeds/*.safetensors
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from mjx_balance.config import Config, check, from_dict
from mjx_balance.policy import FORMAT_VERSION, Policy, load_policy, make_manifest
from mjx_balance.scene import load_scene

SCENE_OF_0_1 = "736718339cc4c03b"
IDLE = ("rate_max", "incline_max")
"""Fields of 0.1 that are gone; nothing but their default can be carried over."""


def upgraded_config(old: dict[str, Any]) -> Config:
    """Translates the config of a format-2 manifest."""
    values = {name: value for name, value in old.items() if name not in ("robot", "random")}
    del values["checkpoint_every"]
    values["eval_every"] = 0  # 0.1 did not validate during training
    values["randomization"] = {k: v for k, v in old["random"].items() if k not in IDLE}
    if any(old["random"][name] is not None for name in IDLE):
        raise ValueError(f"{' or '.join(IDLE)} is set; this release has no such field")
    dqn = dict(old["dqn"])
    dqn["exploration_noise"] = dqn.pop("dither")
    updates = dqn.pop("updates_per_step")
    dqn["replay_ratio"] = updates * dqn["batch_size"] / old["num_envs"]
    dqn["learning_rate_end_share"] = dqn.pop("learning_rate_end") / dqn["learning_rate"]
    return check(from_dict(Config, values | {"dqn": dqn}))


def upgrade(path: Path) -> None:
    """Rewrites one file, and checks that its weights are bit for bit what they were."""
    with safetensors.safe_open(path, framework="numpy") as file:
        manifest = json.loads(file.metadata()["manifest"])
        weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    if manifest["version"] == FORMAT_VERSION:
        print(f"{path}: is of today's format")
        return
    if manifest["version"] != 2 or manifest["scene_hash"] != SCENE_OF_0_1:
        raise SystemExit(f"{path}: not a format-2 policy of the scene of version 0.1")
    config = upgraded_config(manifest["config"])
    for part in ("network", "actions", "rates_hz"):
        assert make_manifest(config, "", {})[part] == manifest[part], part
    versions = {"versions": manifest["versions"]}
    manifest = make_manifest(config, load_scene(config).hash, manifest["training"]) | versions
    before = Policy(manifest, weights).fingerprint
    part = path.with_suffix(".part")
    safetensors.numpy.save_file(weights, part, metadata={"manifest": json.dumps(manifest)})
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
