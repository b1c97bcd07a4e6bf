"""How an env's metrics are logged: a row per metric, so that a training loop knows no task."""

from typing import Literal, NamedTuple


class Metric(NamedTuple):
    """A row of an env's table `metrics`: how a metric's mean is logged, if not as it is."""

    name: str | None = None  #: logged name; None: its own
    per: Literal["decision", "minute", "call"] = "decision"
    """A mean over decisions, a rate per minute of one env, or a sum over a call's decisions."""
    per_seed: bool = False  #: whether it is also logged for every seed, if there are several
