"""What the benchmarks share: arguments, fresh processes, rounds of timing, tables, pages."""

import argparse
import concurrent.futures
import multiprocessing
import platform
import random
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

REPO = Path(__file__).resolve().parent.parent
POLICY = REPO / "policies" / "best.safetensors"
DURATION = 60.0  # of an evaluated scenario, s
TILTS = "mean / p95 / max tilt in deg over every physics step"

Row = dict[str, Any]
"""One row of a table: title of a column -> value."""


def arguments(description: str | None, tables: Iterable[str] = ()) -> argparse.ArgumentParser:
    """A parser with the flags that every script has; `tables` names its tables, if several."""
    parser = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    if tables:
        parser.add_argument("--table", choices=tables, default=next(iter(tables)))
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--write", type=Path, help="Markdown page that has the table's markers")
    return parser


def log(line: str) -> None:
    """Shows progress on standard error."""
    print(line, file=sys.stderr, flush=True)


def fresh(function: Callable[..., Any], *args: Any) -> Any:
    """The result of a module's function in a new process, which shares nothing with this one."""
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, spawn) as pool:
        return pool.submit(function, *args).result()


def interleaved(
    calls: Mapping[str, Callable[[], Any]],
    rounds: int,
    before: Callable[[], Any] = lambda: None,
) -> dict[str, list[float]]:
    """Seconds of every call in every round, so that a busy moment of the machine hits them all.

    A round makes each call once, in an order that changes; `before` each, untimed.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for number in range(rounds):
        for name in random.Random(number).sample(list(calls), len(calls)):
            before()
            began = time.perf_counter()
            calls[name]()
            seconds[name].append(time.perf_counter() - began)
    return seconds


def ratio(slower: Sequence[float], faster: Sequence[float]) -> float:
    """How many times faster: the median over the rounds of the ratio of the seconds."""
    return statistics.median(a / b for a, b in zip(slower, faster, strict=True))


def hardware() -> Row:
    """What this machine is."""
    from mjx_balance.machine import cores

    model, cpuinfo = platform.processor(), Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [x for x in cpuinfo.read_text().splitlines() if x.startswith("model name")]
        model = names[0].split(":", 1)[1].strip() if names else model
    return {"cpu": model, "cores": cores(), "system": platform.platform()}


def machine() -> str:
    """The machine in a few words."""
    found = hardware()
    return f"{found['cpu']}, {found['cores']} cores"


def evaluated(
    scene: Any, controller: Any, suite: str, scenarios: int, duration: float = DURATION
) -> Row:
    """A controller's `summarize`d evaluation on held-out scenarios, plain MuJoCo."""
    from mjx_balance.evaluation.rollout import run_suite, summarize
    from mjx_balance.evaluation.suites import SEEDS

    seed = SEEDS.held_out
    rollout = run_suite(scene, controller, suite, scenarios, duration, seed)
    return summarize(rollout, suite, duration, seed)


def evaluated_policies(policies: Sequence[Any], scenarios: int) -> dict[str, Row]:
    """Suite -> `pooled` evaluations of some policies, headline suites."""
    from mjx_balance.evaluation.rollout import observing, policy_scene
    from mjx_balance.evaluation.suites import HEADLINE

    acting = [(policy_scene(policy), observing(policy)) for policy in policies]
    return {x: pooled([evaluated(*pair, x, scenarios) for pair in acting]) for x in HEADLINE}


def pooled(results: Sequence[Row]) -> Row:
    """`summarize`d evaluations as one: mean `mean` and `p95`, greatest `max`, `falls`, `of`."""
    tilts = [result["tilt_deg"] for result in results]
    return {
        **{name: statistics.fmean(tilt[name] for tilt in tilts) for name in ("mean", "p95")},
        "max": max(tilt["max"] for tilt in tilts),
        "falls": sum(result["falls"] for result in results),
        "of": sum(result["scenarios"] for result in results),
    }


def tilts(result: Row) -> str:
    """A cell: those of `mean`, `p95` and `max` that it has, in deg, and falls if there are any."""
    of = f" of {result['of']}" if "of" in result else ""
    fell = f" ({result['falls']}{of} fall)" if result["falls"] else ""
    return " / ".join(f"{result[x]:.3f}" for x in ("mean", "p95", "max") if x in result) + fell


def cell(value: Any, form: str = "{}") -> str:
    """One cell: a dash for none, `tilts` for an evaluation."""
    if value is None:
        return "-"
    return tilts(value) if isinstance(value, dict) else form.format(value)


def table(rows: Sequence[Row], forms: Mapping[str, str] | None = None) -> list[str]:
    """The lines of a Markdown table; `forms` maps titles to format strings of their values."""
    forms = forms or {}
    cells = [[cell(value, forms.get(x, "{}")) for x, value in row.items()] for row in rows]
    return [f"| {' | '.join(line)} |" for line in (rows[0], ["---"] * len(rows[0]), *cells)]


def save(file: Path | None, rows: Sequence[Row], **more: Any) -> None:
    """Writes the figures as JSON, with the machine, if a file is given."""
    from mjx_balance.files.run_folder import write_json

    if file is not None:
        write_json(file, {"hardware": hardware(), **more, "rows": rows})


def publish(name: str, lines: Iterable[str], page: Path | None) -> None:
    """Prints lines, and puts them between the markers of a Markdown page, if one is given.

    `name` is the script's, followed by the table's if the script has several.

    Raises:
      ValueError: if the page has no such markers.
    """
    script = name.split()[0]
    begin, end = f"<!-- {name}: written by benchmarks/{script}.py -->", f"<!-- end of {name} -->"
    text = "\n".join([begin, *lines, end])
    print(text)
    if page is not None:
        old = page.read_text()
        if begin not in old or end not in old:
            raise ValueError(f"{page} has no markers {begin} and {end}")
        page.write_text(old.split(begin)[0] + text + old.split(end)[1])


def report(
    args: argparse.Namespace,
    name: str,
    rows: list[Row],
    note: str,
    forms: Mapping[str, str] | None = None,
) -> None:
    """Rows to `--json`; table and note to the terminal and to the page of `--write`."""
    save(args.json, rows)
    publish(name, [*table(rows, forms), "", note], args.write)
