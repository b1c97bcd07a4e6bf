"""Hostile inputs at random: 60 s for each kind, or FUZZ_SECONDS, from FUZZ_SEED."""

import os
import random
import time
from collections.abc import Iterator

import pytest


@pytest.fixture
def rounds(request: pytest.FixtureRequest) -> Iterator[random.Random]:
    """A generator for every round, until the time is over; a failure prints which one it was.

    Round k depends on the seed and on k alone: `FUZZ_FIRST=k` begins with it. `--junitxml` has
    their number.
    """
    seed, first = os.environ.get("FUZZ_SEED", "0"), int(os.environ.get("FUZZ_FIRST", "0"))
    seconds = float(os.environ.get("FUZZ_SECONDS", "60"))

    def each() -> Iterator[random.Random]:
        until, k = time.monotonic() + seconds, first
        while time.monotonic() < until:
            print(f"FUZZ_SEED={seed} FUZZ_FIRST={k}")  # pytest shows it after a failure
            yield random.Random(f"{seed} {k}")
            k += 1
        request.node.user_properties.append(("rounds", k - first))

    return each()
