"""Sensors and clocks that break: the controller holds, and raises only for another shape."""

import random
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from mjx_balance.policy.file import shipped_policies
from mjx_balance.runtime import Controller, State

pytestmark = pytest.mark.slow

WINDOW, LEAST = 50, 17  #: samples of a decision of the shipped policy, a third of them
BROKEN: tuple[Any, ...] = (
    *(None, {}, "0", 10**400, object(), [], [0, 0], np.zeros((3, 1)), np.zeros(13), True, 1j),
    *([0, None, 0], [0, "x", 0], [0, 10**400, 0], [[0], [0, 0]], np.full(3, np.nan)),
    *(np.full(3, 1e308), np.full(3, np.inf), np.ma.masked, np.zeros(3, complex), b"\x1b[2J"),
)


class Rig:
    """A controller whose sensors and clock go from one fault to the next."""

    def __init__(self, rng: random.Random):
        self.now = 0.0
        self.controller = Controller(shipped_policies()["best"], lambda: self.now)
        self.rng, self.noise = rng, np.random.default_rng(rng.randrange(2**32))
        self.samples: list[tuple[float, ...]] = []  #: since the robot stood

    def fresh(self) -> list[Any]:
        imu = self.noise.normal((0, 0, 0, 0, 0, 9.81), (0.002,) * 3 + (0.02,) * 3)
        return [self.controller.targets, imu[:3], imu[3:]]

    def repeated(self) -> list[Any]:
        """One of the last few samples again."""
        joints, gyro, accelerometer = self.fresh()
        if self.samples:
            old = np.asarray(self.samples[-1 - self.rng.randrange(min(8, len(self.samples)))])
            gyro, accelerometer = old[:3], old[3:]
        return [joints, gyro, accelerometer]

    def falling(self) -> list[Any]:
        joints, gyro, accelerometer = self.fresh()
        return [joints, gyro + self.rng.uniform(-3, 3), accelerometer * self.rng.uniform(-1, 2)]

    def broken(self) -> list[Any]:
        readings = self.fresh()
        readings[self.rng.randrange(3)] = self.rng.choice(BROKEN)
        return readings

    def stuck(self) -> list[Any]:
        return [np.round(self.controller.targets, 1), *self.fresh()[1:]]

    def late(self) -> list[Any]:
        self.now += self.rng.choice((0.0, -0.01, 0.03, 1e9, float("nan"), float("inf")))
        return self.fresh()


FAULTS: tuple[Callable[[Rig], list[Any]], ...] = (
    *(Rig.fresh, Rig.fresh, Rig.repeated, Rig.repeated, Rig.falling, Rig.broken, Rig.stuck),
    Rig.late,
)


def take_sample(rig: Rig, fault: Callable[[Rig], list[Any]]) -> None:
    """A call of the controller, and what must hold after any."""
    controller, before = rig.controller, rig.controller.targets
    state, readings = controller.state, fault(rig)
    rig.now += controller.sample_dt
    refusal, targets = "", before
    try:
        targets = controller.step(*readings)
    except ValueError as error:
        refusal = str(error)
    if refusal:
        assert refusal.startswith("joint_positions, gyro and accelerometer have shapes")
        assert controller.state is state
        return
    assert targets.shape == (4, 3)
    assert np.isfinite(targets).all()
    if controller.state is State.HOLDING:
        np.testing.assert_array_equal(targets, before)
        assert controller.reason
        assert controller.reason.isprintable()
        assert len(controller.reason) <= 300
        return
    assert controller.state is State.BALANCING
    rig.samples.append(tuple(np.concatenate(readings[1:]).tolist()))
    if len(rig.samples) % WINDOW == 1 and len(rig.samples) > WINDOW:  # it has just decided
        assert len(set(rig.samples[-WINDOW:])) >= LEAST


def test_a_sensor_that_breaks(rounds: Iterator[random.Random]) -> None:
    """Of the last 50 samples before a decision that was made, 17 differ, whatever came before."""
    states = dict.fromkeys(State, 0)
    for rng in rounds:
        rig = Rig(rng)
        for _ in range(rng.randint(2, 8)):
            fault, share = rng.choice(FAULTS), rng.choice((0.02, 0.3, 0.6, 0.7, 1.0))
            for _ in range(rng.randint(1, 120)):
                take_sample(rig, fault if rng.random() < share else Rig.fresh)
            states[rig.controller.state] += 1
            if rig.controller.state is State.HOLDING and rng.random() < 0.7:
                rig.controller.reset()
                rig.samples.clear()
                rig.now += 1.0 if np.isfinite(rig.now) else -rig.now
                rig.now = rig.now if np.isfinite(rig.now) else 0.0
                assert rig.controller.state is State.STANDING
    assert min(states[State.BALANCING], states[State.HOLDING]) > 0
