"""Policy files of strangers: refused in a sentence, or a policy that moves legs within reach."""

import copy
import json
import random
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.hostile import change
from fixtures.policies import HEADS, random_policy, with_head

from mjx_balance.config import Config
from mjx_balance.policy.file import load_policy
from mjx_balance.policy.manifest import PolicyError
from mjx_balance.runtime import Controller, PolicyFileError

pytestmark = pytest.mark.slow

SECONDS = 5.0  #: of computing; a sentence comes within one, and the machine may be busy
Parts = tuple[dict[str, Any], dict[str, Any], bytes]  #: header, manifest, numbers


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, config: Config) -> list[Parts]:
    """Sound policies with every head, taken apart."""
    parts = []
    for head in HEADS:
        file = tmp_path_factory.mktemp("whole") / "p"
        random_policy(file, with_head(config, head, command_lags=(0, 2), imu_mean=3))
        content = file.read_bytes()
        size = int.from_bytes(content[:8], "little")
        header = json.loads(content[8 : 8 + size])
        manifest = json.loads(header.pop("__metadata__")["manifest"])
        parts.append((header, manifest, content[8 + size :]))
    return parts


def pack(parts: Parts, rng: random.Random) -> bytes:
    """A file of changed parts: of the manifest, mostly, of the weights' entries, of all bytes."""
    header, manifest, numbers = copy.deepcopy(parts)
    kind = rng.random()
    for _ in range(rng.randint(1, 3)):
        if kind < 0.6:
            part = rng.choice(("config", "config", "robot", *manifest))
            manifest[part] = change(manifest[part], rng)
        elif kind < 0.8:
            name = rng.choice(sorted(header))
            header[rng.choice((name, name, "spare"))] = change(header[name], rng)
        elif kind < 0.9:
            array = np.frombuffer(numbers, "<f4").copy()
            array[rng.randrange(len(array)) :: rng.choice((1, 7, 10**9))] = rng.choice(
                (0, 3e38, -3e38, 1e-40, float("nan"), float("inf"))
            )
            numbers = array.tobytes()
    text = json.dumps(manifest)
    if rng.random() < 0.05:
        text = rng.choice((text[:-1], "[" * 90_000, "9" * 5_000, "NaN", text * 100, "[" + text))
    metadata: Any = {"manifest": text}
    if rng.random() < 0.02:
        metadata = change(metadata, rng)
    head = json.dumps({"__metadata__": metadata, **header}).encode()
    size = len(head) if rng.random() < 0.98 else rng.choice((0, 2**40, 2**64 - 1, len(head) // 2))
    content = size.to_bytes(8, "little") + head + numbers
    if kind >= 0.9:
        at = rng.randrange(len(content))
        rest = (b"", content[at + 1 :], content[at:] + bytes(4), rng.randbytes(40))
        content = content[:at] + bytes([rng.randrange(256)]) + rng.choice(rest)
    return content


def assert_moves_within_reach(controller: Controller, rng: random.Random) -> None:
    """Whatever the network says, no target is further than a turn of the leg from the zeros."""
    noise = np.random.default_rng(rng.randrange(2**32))
    low, high = controller.model.legs.limits()
    for _ in range(2 * controller.decision_samples + 2 if controller.decision_samples < 99 else 2):
        samples = noise.normal((0, 0, 0, 0, 0, 9.81), 0.02)
        targets = controller.step(controller.targets, samples[:3], samples[3:]).ravel()
        assert np.isfinite(targets).all()
        assert (targets >= low - 1e-9).all()
        assert (targets <= high + 1e-9).all()
    assert controller.reason.isprintable()


def test_a_policy_of_a_stranger(
    rounds: Iterator[random.Random], whole: list[Parts], tmp_path: Path
) -> None:
    file = tmp_path / "p.safetensors"
    loaded = count = 0
    for count, rng in enumerate(rounds):  # noqa: B007
        file.write_bytes(pack(rng.choice(whole), rng))
        for load, refusal in ((load_policy, PolicyError), (Controller, PolicyFileError)):
            began, sentence = time.process_time(), ""
            try:
                policy: Any = load(file)
            except refusal as error:
                policy, sentence = None, str(error)
            assert time.process_time() - began < SECONDS
            assert sentence.isprintable()
            assert len(sentence) <= 300
            loaded += policy is not None
            if isinstance(policy, Controller):
                now = iter(np.arange(100_000) * policy.sample_dt)
                policy._clock = lambda now=now: next(now)
                assert_moves_within_reach(policy, rng)
            elif policy is not None:
                with np.errstate(over="ignore", invalid="ignore"):
                    action = policy(np.ones((2, policy.observation_size)))
                assert ((action >= 0) & (action < len(policy.actions))).all()
    assert loaded or count < 100, "changes as small as these leave some policies whole"
