"""The DQN on environments with known values, on two devices."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fixtures import probes
from jax.experimental.key_reuse import _core as key_reuse

from mjx_balance.config import SWEEPABLE
from mjx_balance.dqn import DQN, TrainState, replay
from mjx_balance.dqn.mesh import AXIS, Mean

CONFIG = probes.CONFIG
ENVS, ITERATIONS = 8, 400
Make = Callable[..., DQN]


def trained(dqn: DQN, seed: int = 0) -> TrainState:
    return dqn.train_program(ITERATIONS)(dqn.init(seed))[0]


def values(dqn: DQN, state: TrainState, obs: float) -> np.ndarray:
    return np.asarray(dqn.network.apply(dqn.export_params(state), jnp.full(1, obs)))


class Counting(probes.NoisyState):
    """Counts how often its step is traced."""

    traces = 0

    def step(self, state: Any, action: jax.Array) -> Any:
        Counting.traces += 1
        return super().step(state, action)


@pytest.fixture(scope="module")
def noisy(make_dqn: Make) -> tuple[DQN, Any, Any]:
    """A DQN of NoisyState, a program of 10 iterations, and its result from seed 0."""
    dqn = make_dqn(Counting())
    program = dqn.train_program(10)
    return dqn, program, program(dqn.init(0))[0]


@pytest.mark.slow  # test_reference.py has the same targets, number by number
@pytest.mark.parametrize(
    ("env", "expected", "changes"),
    [
        (probes.TwoSteps(), {1.0: (0.5, 0.5), 2.0: (1.0, 1.0)}, {"double": True}),
        (probes.NoTimeLimit(), {-0.6: (0.6, -0.6), 0.5: (-0.5, 0.5)}, {"whiten_steps": 800}),
    ],
    ids=("TwoSteps", "NoTimeLimit"),
)
def test_learns_known_values(
    env: probes.Probe,
    expected: dict[float, tuple[float, float]],
    changes: dict[str, Any],
    make_dqn: Make,
) -> None:
    dqn = make_dqn(env, **changes)
    state = trained(dqn)
    for obs, value in expected.items():
        np.testing.assert_allclose(values(dqn, state, obs), value, atol=0.1)
    assert float(state.statistics.batches) == (100 if changes.get("whiten_steps") else 0)


@pytest.mark.slow
def test_mirror_teaches_unseen_states(make_dqn: Make) -> None:
    """Only positive observations are shown; the values of negative ones are learnt too."""
    dqn = make_dqn(probes.PositiveState(), mirror=True, symmetries=probes.PositiveState.symmetries)
    state = trained(dqn)
    np.testing.assert_allclose(values(dqn, state, -0.7), (0.7, -0.7), atol=0.1)
    assert np.asarray(state.replay.data.obs).min() >= 0


@pytest.mark.parametrize("mirror", [False, True])
def test_symmetries_are_used_only_with_mirror(
    mirror: bool, monkeypatch: pytest.MonkeyPatch, make_dqn: Make
) -> None:
    used: list[Any] = []
    monkeypatch.setattr(replay, "reflect", lambda batch, group, key: used.append(group) or batch)
    group = probes.PositiveState.symmetries
    dqn = make_dqn(probes.PositiveState(), mirror=mirror, symmetries=group)
    jax.eval_shape(dqn.train_program(2), jax.eval_shape(lambda: dqn.init(0)))
    assert bool(used) == mirror
    assert all(x is group for x in used)


def test_each_device_samples_its_own_share_of_every_batch(
    monkeypatch: pytest.MonkeyPatch, make_dqn: Make
) -> None:
    """32 rows per update are 16 of each device, and no device or update repeats another's.

    Learning begins even if the replay is rounded below its minimum.
    """
    drawn = []
    sample = replay.sample

    def spy(state: Any, key: jax.Array, batch_size: int) -> Any:
        jax.debug.callback(lambda rows: drawn.append(tuple(rows.tolist())), key)
        batch = sample(state, key, batch_size)
        assert len(batch.action) == 16
        return batch

    monkeypatch.setattr(replay, "sample", spy)
    size = 2 * ENVS + 5

    def count_alone(self: DQN, state: Any, *_: Any) -> Any:
        done = state._replace(gradient_steps=state.gradient_steps + 1)
        return done, Mean(jnp.float32(0.0), jnp.float32(1.0))

    monkeypatch.setattr(DQN, "update", count_alone)
    dqn = make_dqn(probes.OneStep(), replay_capacity=size, min_replay_size=size)
    state, _ = dqn.train_program(4)(dqn.init(0))
    jax.block_until_ready(state)
    jax.effects_barrier()
    updates = int(state.gradient_steps)
    assert updates > 0
    assert len(drawn) == len(set(drawn)) == 2 * updates


def test_no_key_is_used_twice(monkeypatch: pytest.MonkeyPatch, make_dqn: Make) -> None:
    """JAX's own check, on everything that draws in a run."""
    changes = {"exploration_noise": 1, "whiten_steps": 100, "mirror": True}
    changes["symmetries"] = probes.PositiveState.symmetries  # pyright: ignore
    dqn = make_dqn(probes.PositiveState(), devices=jax.devices()[:1], **changes)

    def check(function: Any, argument: Any) -> Any:
        trace = jax.make_jaxpr(function, axis_env=[(AXIS, 1)], return_shape=True)
        program, shapes = trace(argument)
        key_reuse.check_key_reuse_jaxpr(program.jaxpr)
        return shapes

    state = check(lambda key: dqn.initial_state(key, {}), jax.random.key(0))
    # JAX lets a key be folded again and again; fold_in(k, 1) is split(k)[1] all the same.
    once = key_reuse.KeyReuseSignature(key_reuse.Sink(0), key_reuse.Source(0))
    signatures = key_reuse.key_reuse_signatures
    fold_in = next(primitive for primitive in signatures if primitive.name == "random_fold_in")
    monkeypatch.setitem(signatures, fold_in, once)
    check(lambda state: dqn.iteration(state, jnp.bool(True)), state)


def test_equal_seeds_equal_states_other_seeds_others(noisy: tuple[DQN, Any, Any]) -> None:
    dqn, program, first = noisy
    again, other = (program(dqn.init(seed))[0] for seed in (0, 1))
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(first), jax.device_get(again))
    kernels = [np.asarray(x.params["params"]["head"]["kernel"]) for x in (first, other)]
    assert np.abs(kernels[0] - kernels[1]).max() > 1e-3


def test_the_state_is_everything(noisy: tuple[DQN, Any, Any], make_dqn: Make) -> None:
    """A run goes on from a copy on the host, with another DQN; a program is traced once."""
    _, program, state = noisy
    host, traces = jax.device_get(state), Counting.traces
    uninterrupted, _ = program(jax.tree.map(jnp.copy, state))
    assert Counting.traces == traces > 0
    assert int(uninterrupted.env_steps) == 2 * 10 * ENVS
    dqn = make_dqn(probes.NoisyState())
    placed = jax.tree.map(lambda x, like: jax.device_put(x, like.sharding), host, uninterrupted)
    resumed, _ = dqn.train_program(10)(placed)
    jax.tree.map(np.testing.assert_array_equal, *jax.device_get((resumed, uninterrupted)))


def test_several_seeds_are_as_many_runs(noisy: tuple[DQN, Any, Any], make_dqn: Make) -> None:
    """One program of three seeds learns what three programs learn; the last has another rate."""
    single, program, _ = noisy
    rates = (CONFIG.learning_rate, CONFIG.learning_rate, 10 * CONFIG.learning_rate)
    dqn = make_dqn(probes.NoisyState(), num_seeds=3, sweep={"learning_rate": rates})
    three_runs = dqn.train_program(10)
    state, metrics = jax.device_get(three_runs(dqn.init(5)))
    slower = jax.device_get(program(single.init(7))[0].params)
    pairs = zip(jax.tree.leaves(state.params), jax.tree.leaves(slower), strict=True)
    assert max(np.abs(a[2] - b).max() for a, b in pairs) > 1e-3
    for k in range(2):
        alone, alone_metrics = jax.device_get(program(single.init(5 + k)))
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a[k], b, atol=1e-4),  # noqa: B023
            (state.params, state.replay, state.env_state.obs),
            (alone.params, alone.replay, alone.env_state.obs),
        )
        np.testing.assert_array_equal(state.gradient_steps[k], alone.gradient_steps)
        assert metrics["loss"][k] == pytest.approx(float(alone_metrics["loss"]), rel=1e-3)

    start = dqn.init(5)  # parameters of the second that are not finite: the others do not know
    second = np.arange(3) == 1
    spoilt = jax.tree.map(
        lambda x: jax.device_put(
            np.where(second.reshape(-1, *[1] * (x.ndim - 1)), np.float32(np.nan), x), x.sharding
        ),
        start.params,
    )
    after, metrics = jax.device_get(three_runs(start._replace(params=spoilt)))
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(a[::2], b[::2]),
        (after.params, after.target_params, after.opt_state, after.replay),
        (state.params, state.target_params, state.opt_state, state.replay),
    )
    np.testing.assert_array_equal(np.isnan(metrics["loss"]), (False, True, False))
    np.testing.assert_array_equal(after.gradient_steps, (18, 0, 18))
    np.testing.assert_allclose(metrics["skipped_updates"], (0, 0.9, 0), rtol=1e-6)
    assert all((leaf[1] == 0).all() for leaf in jax.tree.leaves(after.opt_state))


SWEPT = {
    "learning_rate": 1e-3,
    "learning_rate_end_share": 0.5,
    "gamma": 0.3,
    "epsilon_start": 0.2,
    "epsilon_end": 0.1,
    "epsilon_decay_steps": 60,
    "huber_delta": 0.1,
    "max_grad_norm": 0.01,
}
"""None of them is what the probes' config has; without a delta, errors are squared: 1e9."""


@pytest.mark.slow
def test_a_sweep_is_as_many_runs_with_values_of_their_own(make_dqn: Make) -> None:
    """Runs of one seed: the last has all values, each other one lacks one of them.

    The last is the run of a config that has these values. All others differ from it.
    """
    assert set(SWEPT) == set(SWEEPABLE)
    usual = dataclasses.asdict(CONFIG) | {"huber_delta": 1e9}
    columns = {
        name: [usual[name] if name == other else value for other in (*SWEPT, None)]
        for name, value in SWEPT.items()
    }
    one: Any = {"iterations": 10, "devices": jax.devices()[:1]}  # to the end of the schedules
    dqn = make_dqn(probes.TwoSteps(), num_seeds=len(SWEPT) + 1, sweep=columns, **one)
    alone = make_dqn(probes.TwoSteps(), **one, **SWEPT)
    start, sweep = alone.init(3), dqn.init(0).sweep
    same = jax.tree.map(lambda x: jnp.stack([x] * dqn.spec.num_seeds), start)
    state, metrics = dqn.train_program(10)(same._replace(sweep=sweep))
    expected, expected_metrics = alone.train_program(10)(start)
    leaves = (jax.tree.leaves(jax.device_get(x.params)) for x in (state, expected))
    pairs = list(zip(*leaves, strict=True))
    off = np.max([np.abs(a - b).reshape(len(a), -1).max(axis=1) for a, b in pairs], axis=0)
    assert off[-1] < 2e-6
    assert (off[:-1] > 2e-5).all(), dict(zip(SWEPT, off, strict=False))
    np.testing.assert_allclose(metrics["epsilon"][-1], expected_metrics["epsilon"], rtol=1e-5)


def test_no_update_before_the_replay_is_warm(make_dqn: Make) -> None:
    """6 decisions of 8 envs are asked for: of three calls of two iterations, the last one learns.

    The loss is a mean over updates that were made, not over those that were not. There is one
    action and the parameters hardly move: each update's loss is (q - 1)^2.
    """

    class OneAction(probes.OneStep):
        action_size = 1  # pyright: ignore

    dqn = make_dqn(OneAction(), min_replay_size=6 * ENVS, learning_rate=1e-9)
    program, state = dqn.train_program(2), dqn.init(0)
    expected = (values(dqn, state, 1.0).item() - 1) ** 2
    for k, learnt in enumerate((0, 0, 1, 3, 5)):
        state, metrics = program(state)
        assert int(state.gradient_steps) == learnt * CONFIG.updates_per_step(ENVS)
        assert metrics["loss"] == pytest.approx(expected if learnt else math.nan, 1e-4, nan_ok=True)
        assert metrics["reward"] == 1, k


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"batch_size": 33}, "batch_size is 33; it must be a multiple of the 2 devices"),
        ({"num_envs": 33}, "num_envs is 33; it must be a multiple of the 2 devices"),
        ({"mirror": True}, "mirror is True, but no symmetries are given"),
        ({"num_seeds": 3, "sweep": {"gamma": (0.1, 0.2)}}, "gamma has 2 values for 3 runs"),
        ({"sweep": {"gamma": (0.1,)}}, "gamma has 1 values for 1 runs"),
    ],
)
def test_numbers_that_do_not_fit_are_refused(
    values: dict[str, Any], message: str, make_dqn: Make
) -> None:
    with pytest.raises(ValueError, match=message):
        make_dqn(probes.OneStep(), **values)


def test_an_env_that_observes_a_dictionary_is_refused(make_dqn: Make) -> None:
    class Several(probes.OneStep):
        def reset(self, rng: jax.Array) -> Any:
            return super().reset(rng).replace(obs={"state": jnp.ones(1)})

    with pytest.raises(TypeError, match="the env observes dict; this DQN takes arrays"):
        make_dqn(Several()).init(0)


@pytest.mark.parametrize("num_seeds", [1, 3])
def test_the_whitening_matrix_is_computed_only_while_it_changes(
    num_seeds: int, make_dqn: Make
) -> None:
    """Its eigenvalues stand in a branch that is not taken once the statistics are complete."""
    dqn = make_dqn(probes.NoisyState(), num_seeds=num_seeds, whiten_steps=800)
    state = jax.eval_shape(lambda: dqn.init(0))
    program = jax.make_jaxpr(dqn.train_program(2))(state)
    assert "eigh" in str(program)
    assert not outside_of_conditions(program.jaxpr, "eigh")


def outside_of_conditions(program: Any, primitive: str) -> bool:
    """Whether a primitive occurs where it runs every time."""
    for equation in program.eqns:
        if equation.primitive.name == primitive:
            return True
        if equation.primitive.name != "cond":
            inner = [getattr(x, "jaxpr", x) for x in equation.params.values()]
            if any(outside_of_conditions(x, primitive) for x in inner if hasattr(x, "eqns")):
                return True
    return False


def test_first_reset_begins_a_run_and_noise_follows_the_action_factors(
    monkeypatch: pytest.MonkeyPatch, make_dqn: Make
) -> None:
    """Greedy actions are equal for equal observations; noise turns them to neighbours in (7, 5)."""

    class Wide(probes.Walk):
        action_size = 35  # pyright: ignore

    def last_step(key: jax.Array) -> Any:
        state = probes.Walk().reset(key)
        return state.replace(obs=jnp.asarray((5.0, 1.0)))

    dqn = make_dqn(
        Wide(),
        num_envs=256,
        action_factors=(7, 5),
        first_reset=last_step,
        exploration_noise=1,
        epsilon_start=0.0,
        epsilon_end=0.0,
    )
    monkeypatch.setattr(DQN, "learn", lambda self, state, *_: (state, {}))
    start = dqn.init(0)
    np.testing.assert_array_equal(start.env_state.obs, np.tile((5.0, 1.0), (256, 1)))
    best = int(np.argmax(np.asarray(dqn.network.apply(start.params, jnp.asarray((5.0, 1.0))))))
    program = dqn.train_program(1)
    state, _ = program(start)
    actions = np.asarray(state.replay.data.action)[:128]
    x, y = np.divmod(best, 5)
    expected = {
        5 * i + j
        for i in range(max(x - 1, 0), min(x + 2, 7))
        for j in range(max(y - 1, 0), min(y + 2, 5))
    }
    assert set(actions.tolist()) == expected
    state, _ = program(state)  # the third step of a walk: a usual reset follows
    obs = np.asarray(state.env_state.obs)
    assert (obs[:, 0] < 1).all()
    np.testing.assert_array_equal(obs[:, 1], 0)
