"""The replay ring, proved with rows that carry their own id, and reflections of its batches."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fixtures import probes

from mjx_balance.dqn import replay
from mjx_balance.dqn.replay import ReplayState, Transition, reflect
from mjx_balance.task.symmetry import Symmetries

BATCH, CAPACITY = 4, 12
add = jax.jit(replay.add)
sample = jax.jit(replay.sample, static_argnums=2)


def rows(first: int, count: int = BATCH) -> Transition:
    """Transitions `first`, `first` + 1, ...: every field says which one it belongs to."""
    ids = np.arange(first, first + count, dtype=np.int32)
    real = ids.astype(np.float32)
    obs = np.stack((real, -real), axis=-1)
    fields: Any = (obs, ids, real + 0.25, (ids % 3 == 0).astype(np.float32), obs + 0.5)
    return Transition(*fields)


def filled(batches: int, capacity: int = CAPACITY) -> ReplayState:
    state = replay.init(jax.tree.map(lambda x: x[0], rows(0)), capacity, BATCH)
    for k in range(batches):
        state = add(state, rows(1 + BATCH * k))
    return state


def assert_aligned(data: Transition) -> None:
    """Every row holds one transition, not pieces of several."""
    for k, number in enumerate(data.action.tolist()):
        for field, expected in zip(data, rows(number, 1), strict=True):
            np.testing.assert_array_equal(field[k], expected[0])
            assert field.dtype == expected.dtype


@pytest.mark.parametrize("batches", [0, 1, 2, 3, 4, 5, 6, 7, 20])
def test_ring_holds_exactly_the_newest_rows(batches: int) -> None:
    state = filled(batches)
    stored = min(BATCH * batches, CAPACITY)
    assert int(state.size) == stored
    data = jax.tree.map(lambda ring: ring[:stored], state.data)
    newest = range(1 + BATCH * batches - stored, 1 + BATCH * batches)
    assert sorted(data.action.tolist()) == list(newest)
    assert_aligned(data)
    start, after = int(state.position), filled(batches + 1)
    assert start == BATCH * batches % CAPACITY
    written = after.data.action[start : start + BATCH].tolist()
    assert written == list(range(1 + BATCH * batches, 1 + BATCH * (batches + 1)))


def test_an_invalid_batch_changes_nothing() -> None:
    for batches in range(5):
        state = filled(batches)
        after = add(state, rows(100), jnp.bool_(False))
        jax.tree.map(np.testing.assert_array_equal, state, after)


@pytest.mark.parametrize(("capacity", "rows_held"), [(4, 4), (7, 4), (8, 8), (15, 12)])
def test_capacity_is_rounded_down_to_whole_batches(capacity: int, rows_held: int) -> None:
    state = filled(10, capacity)
    assert {len(field) for field in state.data} == {rows_held}
    assert sorted(state.data.action.tolist()) == list(range(41 - rows_held, 41))


def test_batches_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="capacity 3 does not hold one batch of 4"):
        filled(0, capacity=3)
    with pytest.raises(ValueError, match="5 rows does not divide the capacity, 12"):
        replay.add(filled(1), rows(5, count=5))


def test_no_empty_row_is_sampled_before_the_ring_is_full() -> None:
    drawn = sample(filled(2), jax.random.PRNGKey(0), 500)
    assert set(drawn.action.tolist()) == set(range(1, 9))


def test_sampling_is_uniform_over_all_rows_and_keeps_them_whole() -> None:
    """12 rows share 12000 draws: 1000 each, give or take 5 standard deviations."""
    drawn = sample(filled(5), jax.random.PRNGKey(1), 12_000)
    counts = np.bincount(drawn.action)[9:]
    assert len(counts) == CAPACITY
    assert np.abs(counts - 1000).max() < 150
    assert_aligned(jax.tree.map(lambda x: x[:20], drawn))


def test_add_in_place_under_jit_equals_add() -> None:
    add = jax.jit(replay.add, donate_argnums=0)
    state = filled(0)
    for k in range(5):
        before, state = state, add(state, rows(1 + BATCH * k))
        assert before.data.obs.is_deleted(), "the old ring's memory is reused"
    jax.tree.map(np.testing.assert_array_equal, state, filled(5))


COUNT = 400


def turned(batch: Transition, group: Symmetries, seed: int) -> Transition:
    turn = jax.jit(lambda batch, key: reflect(batch, group, key))
    return jax.device_get(turn(batch, jax.random.PRNGKey(seed)))


def test_a_reflection_changes_observations_and_action_together() -> None:
    obs = np.linspace(0.1, 1, COUNT, dtype=np.float32)[:, None]
    ended = (np.arange(COUNT) % 3 == 0).astype(np.float32)
    fields: Any = (obs, np.zeros(COUNT, np.int32), obs[:, 0], ended, 2 * obs)
    batch = Transition(*fields)
    got = turned(batch, probes.PositiveState.symmetries, 0)
    flipped = np.asarray(got.action) == 1
    assert 0.4 < flipped.mean() < 0.6
    sign = np.where(flipped, -1.0, 1.0)[:, None]
    np.testing.assert_allclose(got.obs, sign * obs, rtol=1e-6)
    np.testing.assert_allclose(got.next_obs, 2 * sign * obs, rtol=1e-6)
    np.testing.assert_array_equal(got.reward, batch.reward)
    np.testing.assert_array_equal(got.terminated, batch.terminated)


def test_reflections_that_are_not_their_own_inverses() -> None:
    """Turning a triangle: entry `obs_index[i]` moves to place i, action a becomes a turn on."""
    turns = np.asarray([[0, 1, 2], [1, 2, 0], [2, 0, 1]], np.int32)
    sign = np.asarray([[1, 1, 1], [1, -1, 1], [1, 1, -1]], np.float32)
    group = Symmetries(turns, sign, turns)
    obs = np.asarray([[10.0, 20.0, 30.0]] * COUNT, np.float32)
    fields: Any = (obs, np.full(COUNT, 1, np.int32), obs[:, 0], obs[:, 0], obs + 1)
    batch = Transition(*fields)
    got = turned(batch, group, 1)
    expected = {1: (10, 20, 30), 2: (20, -30, 10), 0: (30, 10, -20)}
    after = {1: (11, 21, 31), 2: (21, -31, 11), 0: (31, 11, -21)}
    for row, action in enumerate(got.action.tolist()):
        assert tuple(got.obs[row]) == expected[action]
        assert tuple(got.next_obs[row]) == after[action]
    counts = np.bincount(got.action)
    assert np.abs(counts - COUNT / 3).max() < 50, "each reflection as often as another"
