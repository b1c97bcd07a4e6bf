"""The replay ring, proved with rows that carry their own id."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_balance.dqn import replay
from mjx_balance.dqn.replay import ReplayState, Transition

BATCH = 4


def rows(first: int, count: int = BATCH) -> Transition:
    """Transitions `first`, `first` + 1, ...: every field says which one it belongs to."""
    ids = np.arange(first, first + count, dtype=np.int32)
    real = ids.astype(np.float32)
    obs = np.stack((real, -real), axis=-1)
    fields = (obs, ids, real + 0.25, (ids % 3 == 0).astype(np.float32), obs + 0.5)
    return Transition(*map(jnp.asarray, fields))


def filled(batches: int, capacity: int = 12) -> ReplayState:
    state = replay.init(jax.tree.map(lambda x: x[0], rows(0)), capacity, BATCH)
    for k in range(batches):
        state = replay.add(state, rows(1 + BATCH * k))
    return state


def assert_aligned(data: Transition) -> None:
    """Every row holds one transition, not pieces of several."""
    for k, number in enumerate(data.action.tolist()):
        for field, expected in zip(data, rows(number, 1), strict=True):
            np.testing.assert_array_equal(field[k], expected[0])


@pytest.mark.parametrize("batches", [0, 1, 2, 3, 4, 5, 6, 7, 20])
def test_ring_holds_exactly_the_newest_rows(batches: int) -> None:
    state = filled(batches)
    stored = min(BATCH * batches, 12)
    assert int(state.size) == stored
    data = jax.tree.map(lambda ring: ring[:stored], state.data)
    newest = range(1 + BATCH * batches - stored, 1 + BATCH * batches)
    assert sorted(data.action.tolist()) == list(newest)
    assert_aligned(data)


@pytest.mark.parametrize(("wanted", "kept"), [(4, 4), (7, 4), (8, 8), (15, 12)])
def test_capacity_is_rounded_down_to_whole_batches(wanted: int, kept: int) -> None:
    state = filled(10, capacity=wanted)
    assert {len(field) for field in state.data} == {kept}
    assert sorted(state.data.action.tolist()) == list(range(41 - kept, 41))


def test_a_ring_too_small_for_one_batch_is_refused() -> None:
    with pytest.raises(ValueError, match="capacity 3 does not hold one batch of 4"):
        filled(0, capacity=3)


def test_a_batch_that_would_wrap_in_its_middle_is_refused() -> None:
    with pytest.raises(ValueError, match="5 rows does not divide the capacity, 12"):
        replay.add(filled(1), rows(5, count=5))


def test_no_empty_row_is_sampled_before_the_ring_is_full() -> None:
    drawn = replay.sample(filled(2), jax.random.PRNGKey(0), 500)
    assert set(drawn.action.tolist()) == set(range(1, 9))


def test_sampling_is_uniform_over_all_rows_and_keeps_them_whole() -> None:
    """12 rows share 12000 draws: 1000 each, give or take 5 standard deviations."""
    state = filled(5)
    drawn = replay.sample(state, jax.random.PRNGKey(1), 12_000)
    counts = np.bincount(drawn.action)[9:]
    assert len(counts) == 12
    assert np.abs(counts - 1000).max() < 150
    assert_aligned(jax.tree.map(lambda x: x[:20], drawn))


def test_add_in_place_under_jit_equals_add() -> None:
    add = jax.jit(replay.add, donate_argnums=0)
    state = filled(0)
    for k in range(5):
        before, state = state, add(state, rows(1 + BATCH * k))
        assert before.data.obs.is_deleted(), "the old ring's memory is reused"
    jax.tree.map(np.testing.assert_array_equal, state, filled(5))


def test_example_gives_shapes_and_types() -> None:
    data = filled(0).data
    assert data.obs.shape == (12, 2)
    assert data.action.dtype == jnp.int32
    assert data.terminated.dtype == jnp.float32


def test_position_is_where_the_next_batch_goes() -> None:
    for batches in range(8):
        before, after = filled(batches), filled(batches + 1)
        start = int(before.position)
        assert start == BATCH * batches % 12
        written = after.data.action[start : start + BATCH].tolist()
        assert written == list(range(1 + BATCH * batches, 1 + BATCH * (batches + 1)))
