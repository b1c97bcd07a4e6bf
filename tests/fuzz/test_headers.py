"""Sensors that lie to the controller in C: no leg leaves its reach or outruns its ramp."""

import math
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.headers import STATES, CController, sample_row

from mjx_balance.policy.file import shipped_policies
from mjx_balance.runtime import STAND_SPEED, Controller, State

pytestmark = pytest.mark.slow

COUNT = 1_000
WILD = (0.0, -0.0, 1e-40, 1e30, -1e30, 5.0, -35.0, math.inf, -math.inf, math.nan)


def stream(rng: random.Random, standing: np.ndarray) -> np.ndarray:
    """(COUNT, values) samples of a robot that stands, sways and is pushed; some are broken."""
    noise = np.random.default_rng(rng.randrange(2**32))
    imu = noise.normal((0, 0, 0, 0, 0, 9.81), rng.choice((1e-3, 0.05, 0.3)), (COUNT, 6))
    sway = np.sin(np.arange(COUNT) * rng.uniform(0.001, 0.3))[:, None]
    imu[:, :2] += sway * rng.uniform(0, 1.5)
    imu[:, 3:5] += sway * rng.uniform(0, 8)
    joints = standing.ravel() + noise.normal(0, rng.choice((1e-4, 0.05)), (COUNT, 12))
    times = 0.004 * np.cumsum(1 + noise.uniform(-0.05, 0.05, COUNT))
    turn = [math.cos(0.05), math.sin(0.05), 0.0, 0.0] if rng.random() < 0.3 else None
    load = np.full(12, rng.uniform(0, 30)) if rng.random() < 0.3 else None
    rows = np.stack(
        [
            sample_row(joints[k], imu[k, :3], imu[k, 3:], times[k], turn, load, load)
            for k in range(COUNT)
        ]
    )
    for _ in range(rng.choice((0, 0, 1, 3, 100))):
        rows[rng.randrange(COUNT), rng.randrange(rows.shape[1])] = rng.choice(WILD)
    return rows


def assert_safe(outputs: np.ndarray, model: Controller) -> None:
    """Whatever was given."""
    assert np.isfinite(outputs[:, 7:]).all()
    low, high = model.model.legs.limits()
    targets = outputs[:, 7:19]
    assert (targets >= low - 1e-9).all()
    assert (targets <= high + 1e-9).all()
    rising = outputs[:, 0] == STATES.index(State.STANDING_UP)
    passive = outputs[:, 0] == STATES.index(State.PASSIVE)
    moved = np.abs(np.diff(targets, axis=0)).max(axis=1)
    assert (moved[rising[1:] & ~passive[:-1]] <= STAND_SPEED * model.sample_dt + 1e-9).all()
    heights = np.stack([model.model.legs.foot_heights(x) for x in targets.reshape(-1, 4, 3)])
    climbed = np.abs(np.diff(heights, axis=0)).max(axis=1)
    most = np.abs(model.model.table).max(axis=0).sum() / len(model.model.share)
    assert (climbed[~rising[1:] & ~passive[1:]] <= most + 1e-9).all()
    assert (outputs[:, 19:31] >= 0).all()


def test_samples_of_any_kind(rounds: Iterator[random.Random], build_shipped: Any) -> None:
    policies = {x: shipped_policies()[x] for x in ("best", "real", "spot")}
    models = {name: Controller(path) for name, path in policies.items()}
    ended = set()
    for rng in rounds:
        name = rng.choice(list(policies))
        path: Path = policies[name]
        model = models[name]
        gains = rng.random() < 0.5
        c = CController(build_shipped(path), 4, gains, rng.choice((1, 1, 4)), 0.0, 80.0)
        rows = stream(rng, model.targets)
        outputs = stand_up(c, rng, rows, model) if gains else c.run(rows)
        assert_safe(outputs, model)
        ended |= set(outputs[:, 0].astype(int).tolist())
    assert len(ended) >= 3 or not ended


def stand_up(c: CController, rng: random.Random, rows: np.ndarray, model: Controller) -> np.ndarray:
    """Outputs of a robot that gets up from any pose, its joints at their targets; then the rows."""
    low, high = model.model.legs.limits()
    beyond = np.tile((0.0, 0.0, 0.19), len(low) // 3)
    low, high = low - beyond, high + beyond
    outputs, joints = [], low + np.asarray([rng.random() for _ in low]) * (high - low)
    now = -1.0 * COUNT
    for k in range(rng.randrange(COUNT)):
        row = rows[k].copy()
        row[0], row[1:4], row[14:26] = now, 0.0, joints
        now += 0.004
        outputs.append(c.run(row[None])[0])
        joints = outputs[-1][7:19]
        if k == 1:
            c.stand()
    rows[:, 0] += now - rows[0, 0]
    if rng.random() < 0.5:
        c.damp() if rng.random() < 0.5 else c.hold()
    return np.concatenate((np.reshape(outputs, (-1, 55)), c.run(rows)))
