"""What a profile makes of a trace: whose an operation is, and how long it took by itself."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import pytest

from mjx_balance.training import profiling
from mjx_balance.training.profiling import (
    MEANING,
    SCOPES,
    SKIPPED,
    Event,
    Profiled,
    scopes,
    shares,
)
from mjx_balance.training.program_cache import compile_program

PROGRAM = """
  %while.3 = (s32[]) while(%tuple.1), metadata={op_name="jit(program)/updates/while/body/replay/add"}
  ROOT %fusion.12 = f32[8]{0} fusion(%a), kind=kLoop, metadata={stack_frame_id=4 op_name="jit(p)/vmap(env)/vmap(physics)/dot"}
  %all-reduce.1 = f32[3] all-reduce(%b), metadata={op_name="jit(program)/updates/while/psum"}
  %copy.4 = f32[3] copy(%b), metadata={op_name="jit(environment)/mul"}
  %bare.1 = f32[3] copy(%b)
"""  # noqa: E501


def test_an_operation_belongs_to_the_innermost_of_our_names() -> None:
    assert scopes(PROGRAM) == {
        "while.3": "replay",
        "fusion.12": "physics",
        "all-reduce.1": "exchange",
        "copy.4": "other",
    }
    assert set(MEANING) == {*SCOPES, "exchange", "other", "host"}


def test_what_runs_within_an_operation_is_not_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two threads of one device: 0 to 100 ns, in which two run that hold one another."""
    outer, inner = Event("while.3", 0, 60), Event("fusion.12", 0, 30)
    innermost, after = Event("copy.4", 15, 5), Event("fusion.12", 60, 10)
    other_thread = Event("all-reduce.1", 80, 20)
    timelines = [[after, inner, outer, innermost], [other_thread]]
    monkeypatch.setattr(profiling, "_timelines", lambda folder: iter(timelines))
    found = shares(Path(), scopes(PROGRAM))
    wanted = {"physics": 0.35, "replay": 0.3, "exchange": 0.2, "host": 0.1, "other": 0.05}
    assert found == pytest.approx(wanted)
    assert list(found) == list(wanted), "the largest first"
    monkeypatch.setattr(profiling, "_timelines", lambda folder: iter([]))
    assert shares(Path(), scopes(PROGRAM)) == {}


def test_one_call_is_traced_and_gives_what_the_others_give(tmp_path: Path) -> None:
    """Products of large matrices are the physics here, those of small ones the updates."""

    def step(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        with jax.named_scope("physics"):
            x = jax.lax.fori_loop(0, 30, lambda _, x: jnp.tanh(x @ x), x)
        with jax.named_scope("updates"):
            small = jax.lax.fori_loop(0, 30, lambda _, y: jnp.tanh(y @ y), x[:30, :30])
        return x, small.sum()

    start = jnp.eye(300) / 2
    program = compile_program(jax.jit(step), start, None, pytest.fail)
    lines: list[str] = []
    profiled = Profiled(program, tmp_path, lines.append)
    sums = []
    for call in range(6):
        sums.append(float(profiled(start + 0)[1]))
        assert bool(lines) == profiled.begun == (call >= 3)
        assert any(tmp_path.rglob("*.xplane.pb")) == (call >= 3)
    assert len(set(sums)) == 1
    shares = json.loads((tmp_path / "shares.json").read_text())
    assert sum(shares.values()) == pytest.approx(1)
    assert shares["physics"] > 0.5 > 5 * shares["updates"] > 0
    assert lines[0] == f"a call of the training program, traced in {tmp_path}:"
    assert lines[1] == f"  physics  {shares['physics']:6.1%}  the engine's steps"


def test_a_trace_on_a_full_disk_ends_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program that fails while it is traced fails all the same."""

    @contextlib.contextmanager
    def trace(folder: str) -> Iterator[None]:
        yield
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(jax.profiler, "trace", trace)
    lines: list[str] = []
    program = compile_program(jax.jit(lambda x: (x + 1, x)), jnp.zeros(()), None, pytest.fail)
    assert float(Profiled(program, tmp_path, lines.append, SKIPPED)(jnp.float32(3))[0]) == 4
    reason = "[Errno 28] No space left on device"
    assert lines == [f"the trace in {tmp_path} cannot be summarised: {reason}"]
    failing: Any = mock.Mock(side_effect=ValueError("of the program"))
    with pytest.raises(ValueError, match="of the program"):
        Profiled(failing, tmp_path, lines.append, SKIPPED)(jnp.float32(3))
