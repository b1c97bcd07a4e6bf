"""The DQN on environments with known values, on two devices."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from brax.envs.base import Env
from jax.experimental.key_reuse import _core as key_reuse

from mjx_balance.config import SWEEPABLE
from mjx_balance.dqn import replay
from mjx_balance.dqn.devices import AXIS
from mjx_balance.dqn.learner import Learner, TrainState
from mjx_balance.dqn.networks import QNetwork

CONFIG = probes.CONFIG
ENVS, ITERATIONS = 8, 400


def make(
    env: Env,
    num_seeds: int = 1,
    devices: Any = None,
    num_envs: int = ENVS,
    sweep: Any = None,
    **changes: Any,
) -> Learner:
    config = dataclasses.replace(CONFIG, **changes)
    network = QNetwork(config.hidden_sizes, (2,), config.head == "radial")
    symmetries = probes.PositiveState.symmetries if config.mirror else None
    total = num_envs * ITERATIONS
    return Learner(
        env, network, config, num_envs, total, devices, num_seeds, symmetries, sweep=sweep
    )


def trained(learner: Learner, seed: int = 0) -> TrainState:
    state, _ = learner.train_program(ITERATIONS)(learner.init(seed))
    return state


def values(learner: Learner, state: TrainState, obs: float) -> np.ndarray:
    return np.asarray(learner.network.apply(learner.exported(state), jnp.full(1, obs)))


@pytest.fixture(scope="module")
def noisy() -> tuple[Learner, Any, Any]:
    """A learner of NoisyState, a program of 10 iterations, and what it makes of seed 0."""
    learner = make(probes.NoisyState())
    program = learner.train_program(10)
    return learner, program, program(learner.init(0))[0]


@pytest.mark.parametrize(
    ("env", "expected", "changes"),
    [
        (probes.TwoSteps(), {1.0: (0.5, 0.5), 2.0: (1.0, 1.0)}, {}),
        (probes.ChooseRight(), {1.0: (-1.0, 1.0)}, {"double": True}),
        (probes.TimeOut(), {1.0: (2.0, 2.0)}, {}),
        (probes.NoTimeLimit(), {0.5: (-0.5, 0.5)}, {"double": True}),
        (probes.NoisyState(), {-0.6: (0.6, -0.6), 0.5: (-0.5, 0.5)}, {"whiten_steps": 800}),
    ],
    ids=lambda x: type(x).__name__ if isinstance(x, probes.Probe) else "",
)
def test_learns_known_values(
    env: probes.Probe, expected: dict[float, tuple[float, float]], changes: dict[str, Any]
) -> None:
    learner = make(env, **changes)
    state = trained(learner)
    for obs, wanted in expected.items():
        np.testing.assert_allclose(values(learner, state, obs), wanted, atol=0.1)
    assert float(state.inputs.batches) == (100 if changes.get("whiten_steps") else 0)


@pytest.mark.parametrize("double", [False, True])
def test_bootstraps_from_the_target_network_alone(double: bool) -> None:
    """It is never synchronised here: the first step is worth what its first draw says.

    Of the second step that first draw prefers action 0, while action 1 is what pays: Double
    DQN lets the online network choose action 1, whose first-drawn value counts.
    """
    changes: dict[str, Any] = {"target_update_period": 10**6, "gamma": 1.0, "epsilon_end": 1.0}
    changes |= {"learning_rate": 0.02}
    learner = make(probes.Fork(), double=double, **changes)
    start = learner.init(2)
    drawn = np.array(learner.network.apply(start.params, jnp.full(1, 2.0)))
    assert drawn[0] - drawn[1] > 0.5
    state = trained(learner, seed=2)
    np.testing.assert_allclose(values(learner, state, 2.0), (-1, 1), atol=0.1)
    wanted = drawn[1] if double else drawn[0]
    np.testing.assert_allclose(values(learner, state, 1.0), (wanted, wanted), atol=0.1)


def test_each_device_draws_its_own_share_of_every_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    """32 rows per update are 16 of each device, and no device or update repeats another's."""
    drawn = []
    sample = replay.sample

    def spy(state: Any, key: jax.Array, batch_size: int) -> Any:
        jax.debug.callback(lambda rows: drawn.append(tuple(rows.tolist())), key)
        batch = sample(state, key, batch_size)
        assert len(batch.action) == 16
        return batch

    monkeypatch.setattr(replay, "sample", spy)
    learner = make(probes.OneStep())
    state, _ = learner.train_program(4)(learner.init(0))
    jax.block_until_ready(state)
    jax.effects_barrier()
    updates = int(state.gradient_steps)
    assert updates > 0
    assert len(drawn) == len(set(drawn)) == 2 * updates


def test_every_env_device_and_update_draws_by_itself() -> None:
    """Random actions of 64 envs on two devices: no two envs act alike, no device copies one."""
    learner = make(probes.Walk(), num_envs=64, epsilon_start=1.0, epsilon_end=1.0)
    state, _ = learner.train_program(8)(learner.init(0))
    actions = np.asarray(state.replay.data.action).reshape(2, -1, 32)
    assert actions.shape[1] == 8
    by_env = actions.transpose(0, 2, 1).reshape(64, 8)
    assert len(np.unique(by_env, axis=0)) > 50
    assert 0.4 < actions.mean() < 0.6


def test_no_key_is_used_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """JAX's own check, on everything that draws in a run."""
    changes = {"exploration_noise": 1, "whiten_steps": 100, "mirror": True}
    learner = make(probes.PositiveState(), devices=jax.devices()[:1], **changes)

    def check(function: Any, argument: Any) -> Any:
        trace = jax.make_jaxpr(function, axis_env=[(AXIS, 1)], return_shape=True)
        program, shapes = trace(argument)
        key_reuse.check_key_reuse_jaxpr(program.jaxpr)
        return shapes

    state = check(lambda key: learner.initial(key, {}), jax.random.key(0))
    # JAX lets a key be folded again and again; fold_in(k, 1) is split(k)[1] all the same.
    once = key_reuse.KeyReuseSignature(key_reuse.Sink(0), key_reuse.Source(0))
    signatures = key_reuse.key_reuse_signatures
    fold_in = next(primitive for primitive in signatures if primitive.name == "random_fold_in")
    monkeypatch.setitem(signatures, fold_in, once)
    check(lambda state: learner.iteration(state, jnp.bool(True)), state)


def test_traced_once_for_many_calls(noisy: tuple[Learner, Any, Any]) -> None:
    learner, program, state = noisy
    before = learner.trace_count
    again, _ = program(jax.tree.map(jnp.copy, state))
    assert learner.trace_count == before == 1
    assert int(again.env_steps) == 2 * 10 * ENVS


def test_equal_seeds_equal_parameters_other_seeds_others(noisy: tuple[Learner, Any, Any]) -> None:
    learner, program, first = noisy
    again, other = (program(learner.init(seed))[0] for seed in (0, 1))
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(first), jax.device_get(again))
    kernels = [np.asarray(x.params["params"]["head"]["kernel"]) for x in (first, other)]
    assert np.abs(kernels[0] - kernels[1]).max() > 1e-3


def test_several_seeds_are_as_many_runs(noisy: tuple[Learner, Any, Any]) -> None:
    """One program of three seeds learns what three programs learn."""
    single, program, _ = noisy
    learner = make(probes.NoisyState(), num_seeds=3)
    state, metrics = learner.train_program(10)(learner.init(5))
    together = jax.device_get(state)
    assert metrics["loss"].shape == (3,)
    for k in range(3):
        alone, alone_metrics = program(single.init(5 + k))
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a[k], b, atol=1e-4),  # noqa: B023
            (together.params, together.replay, together.env_state.obs),
            jax.device_get((alone.params, alone.replay, alone.env_state.obs)),
        )
        np.testing.assert_array_equal(together.gradient_steps[k], alone.gradient_steps)
        assert metrics["loss"][k] == pytest.approx(float(alone_metrics["loss"]), rel=1e-3)


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


def test_a_sweep_is_as_many_runs_with_values_of_their_own() -> None:
    """Runs of one seed: the last has all values, each other one lacks one of them.

    The last is the run of a config that has these values. All others differ from it.
    """
    assert set(SWEPT) == set(SWEEPABLE)
    usual = dataclasses.asdict(CONFIG) | {"huber_delta": 1e9}
    columns = {
        name: [usual[name] if name == other else value for other in (*SWEPT, None)]
        for name, value in SWEPT.items()
    }
    learner, alone = (
        Learner(
            probes.TwoSteps(),
            QNetwork((16,), (2,)),
            dataclasses.replace(CONFIG, **own),
            ENVS,
            10 * ENVS,  # to the end of the schedules
            jax.devices()[:1],
            num_seeds,
            sweep=sweep,
        )
        for own, num_seeds, sweep in (({}, len(SWEPT) + 1, columns), (SWEPT, 1, None))
    )
    start, swept = alone.init(3), learner.init(0).swept
    same = jax.tree.map(lambda x: jnp.stack([x] * learner.num_seeds), start)
    state, metrics = learner.train_program(10)(same._replace(swept=swept))
    expected, expected_metrics = alone.train_program(10)(start)
    found, wanted = jax.device_get((state.params, expected.params))
    pairs = list(zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True))
    off = np.max([np.abs(a - b).reshape(len(a), -1).max(axis=1) for a, b in pairs], axis=0)
    assert off[-1] < 2e-6
    assert (off[:-1] > 2e-5).all(), dict(zip(SWEPT, off, strict=False))
    np.testing.assert_allclose(metrics["epsilon"][-1], expected_metrics["epsilon"], rtol=1e-5)


def test_a_sweep_has_a_value_for_every_run() -> None:
    with pytest.raises(ValueError, match="gamma has 2 values for 3 runs"):
        make(probes.NoisyState(), num_seeds=3, sweep={"gamma": (0.1, 0.2)})


def test_mirror_teaches_what_was_never_seen() -> None:
    """Only positive observations are shown; the values of negative ones are learnt too."""
    learner = make(probes.PositiveState(), mirror=True)
    state = trained(learner)
    np.testing.assert_allclose(values(learner, state, -0.7), (0.7, -0.7), atol=0.1)
    assert np.asarray(state.replay.data.obs).min() >= 0


def test_no_update_before_the_replay_is_warm() -> None:
    """5 decisions of 8 envs are wanted: the fifth iteration is the first that learns.

    The loss is a mean over updates that were made, not over those that were not.
    """
    learner = make(probes.OneStep(), min_replay_size=5 * ENVS)
    program = learner.train_program(1)
    state = learner.init(0)
    losses = []
    for k in range(1, 8):
        state, metrics = program(state)
        losses.append(float(metrics["loss"]))
        assert int(state.gradient_steps) == max(k - 4, 0) * CONFIG.updates_per_step(ENVS)
        assert np.isnan(losses[-1]) == (k < 5)
    _, metrics = learner.train_program(7)(learner.init(0))
    assert metrics["loss"] == pytest.approx(np.mean(losses[4:]), rel=1e-4)
    assert metrics["reward"] == 1


def test_learning_begins_even_if_the_replay_is_rounded_below_its_minimum() -> None:
    learner = make(probes.OneStep(), replay_capacity=2 * ENVS + 5, min_replay_size=2 * ENVS + 5)
    state, _ = learner.train_program(4)(learner.init(0))
    assert int(state.gradient_steps) > 0


def test_the_state_is_everything(noisy: tuple[Learner, Any, Any]) -> None:
    """Copied to the host and back, with another learner, a run goes on as if nothing was."""
    _, program, state = noisy
    host = jax.device_get(state)
    uninterrupted, _ = program(jax.tree.map(jnp.copy, state))
    learner = make(probes.NoisyState())
    placed = jax.tree.map(lambda x, like: jax.device_put(x, like.sharding), host, learner.init(7))
    resumed, _ = learner.train_program(10)(placed)
    jax.tree.map(np.testing.assert_array_equal, *jax.device_get((resumed, uninterrupted)))


@pytest.mark.parametrize(
    ("name", "changes"), [("batch_size", {"batch_size": 33}), ("num_envs", {"num_envs": 33})]
)
def test_what_two_devices_cannot_share_is_refused(name: str, changes: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=f"{name} is 33; it must be a multiple of the 2 devices"):
        make(probes.OneStep(), **changes)


class Several(probes.OneStep):
    """Observes a dictionary."""

    def reset(self, rng: jax.Array) -> Any:
        return super().reset(rng).replace(obs={"state": jnp.ones(1)})


def test_an_env_that_observes_a_dictionary_is_refused() -> None:
    with pytest.raises(TypeError, match="the env observes dict; this learner takes arrays"):
        make(Several()).init(0)


@pytest.mark.parametrize("num_seeds", [1, 3])
def test_the_whitening_matrix_is_computed_only_while_it_changes(num_seeds: int) -> None:
    """Its eigenvalues stand in a branch that a finished gathering does not take."""
    learner = make(probes.NoisyState(), num_seeds=num_seeds, whiten_steps=800)
    state = jax.eval_shape(lambda: learner.init(0))
    program = jax.make_jaxpr(learner.train_program(2))(state)
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


def test_a_mirror_needs_symmetries() -> None:
    config = dataclasses.replace(CONFIG, mirror=True)
    with pytest.raises(ValueError, match="mirror is True, but no symmetries are given"):
        Learner(probes.PositiveState(), QNetwork((4,), (2,)), config, ENVS, ENVS)


def test_symmetries_are_used_only_where_the_config_says_so() -> None:
    symmetries = probes.PositiveState.symmetries
    learner = Learner(
        probes.PositiveState(), QNetwork((4,), (2,)), CONFIG, ENVS, ENVS, symmetries=symmetries
    )
    assert learner.symmetries is None


class Wide(probes.Walk):
    """35 actions."""

    @property
    def action_size(self) -> int:
        return 35


def test_first_reset_begins_a_run_and_noise_follows_the_action_factors() -> None:
    """Greedy actions are equal for equal observations; noise turns them to neighbours in (7, 5)."""

    def late(key: jax.Array) -> Any:
        state = probes.Walk().reset(key)
        return state.replace(obs=jnp.asarray((5.0, 1.0)))

    config = dataclasses.replace(CONFIG, exploration_noise=1, epsilon_start=0.0, epsilon_end=0.0)
    network = QNetwork((4,), (35,))
    learner = Learner(Wide(), network, config, 256, 2_560, action_factors=(7, 5), first_reset=late)
    start = learner.init(0)
    np.testing.assert_array_equal(start.env_state.obs, np.tile((5.0, 1.0), (256, 1)))
    best = int(np.argmax(np.asarray(network.apply(start.params, jnp.asarray((5.0, 1.0))))))
    program = learner.train_program(1)
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
