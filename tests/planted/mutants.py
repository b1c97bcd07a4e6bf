"""Plants mutants drawn at random, and measures how many of them the tests notice.

The mutations are those of mutmut (operators, numbers, names, strings, arguments, assignments),
drawn evenly from all that it makes of the package; sentences, docstrings and annotations stay.
For each, the tests that import the changed module run, the nearest first, until one fails.

    make mutants [ARGS="--count 200 --seed 0 --jobs 2 --write docs/testing.md"]
"""

import argparse
import difflib
import functools
import os
import random
import re
import sys
import time
from pathlib import Path
from typing import NamedTuple

import libcst
from mutmut.mutation.file_mutation import Mutation, create_mutations
from planted import forks
from planted.selection import REPO, name_of, sources, tests_of

MARKERS = ("<!-- mutants: written by make mutants -->", "<!-- end of mutants -->")
GROUPS = 3
"""How many groups of tests run, one import further away each."""


class Mutant(NamedTuple):
    """One module with one mutation."""

    file: Path
    content: str
    seconds: float

    @property
    def difference(self) -> str:
        """File, line, and what is new there."""
        old, new = (REPO / self.file).read_text().splitlines(), self.content.splitlines()
        lines = difflib.unified_diff(old, new, n=0, lineterm="")
        head, *changes = [line for line in lines if line[:3] not in ("---", "+++")]
        number = head.split()[1].lstrip("-").split(",")[0]
        now = " ".join(line[1:].strip() for line in changes if line.startswith("+"))
        return f"{self.file}:{number} {now}"


def mutable(mutation: Mutation) -> bool:
    """Whether the mutation may change what the package does.

    Neither a sentence, whose details are not measured here, nor `strict=True`, which changes
    nothing but an error.
    """
    node = mutation.original_node
    if isinstance(node, libcst.SimpleString) and " " in node.value.strip("\"' "):
        return False
    old, new = (libcst.Module([]).code_for_node(x) for x in (node, mutation.mutated_node))
    loose = [re.sub(r",?\s*strict\s*=\s*\w+|,?\s*$|,?\s*(?=\))", "", text) for text in (old, new)]
    return loose[0] != loose[1]


@functools.cache
def candidates() -> list[tuple[Path, libcst.Module, Mutation]]:
    """All mutations of the package; they take most of a minute."""
    result: list[tuple[Path, libcst.Module, Mutation]] = []
    for file in sources():
        module, mutations, *_ = create_mutations(str(file), (REPO / file).read_text())
        result += [(file, module, mutation) for mutation in mutations if mutable(mutation)]
    return result


def drawn(count: int, seed: int, seconds: float) -> list[Mutant]:
    """Mutants of the whole package, each mutation as likely as any other."""
    mutants = []
    for file, module, mutation in random.Random(seed).sample(candidates(), len(candidates())):
        tree = module.deep_replace(mutation.original_node, mutation.mutated_node)
        assert isinstance(tree, libcst.Module)
        try:
            compile(tree.code, str(file), "exec")
        except SyntaxError:
            continue
        mutants.append(Mutant(file, tree.code, seconds))
        if len(mutants) == count:
            break
    return mutants


def caught(mutant: Mutant) -> str | None:
    """Plants a mutant in this process' copy for a while; returns what noticed it."""
    with forks.changed(mutant.file, mutant.content):
        return forks.noticed(tests_of(name_of(mutant.file))[:GROUPS], mutant.seconds)


def wilson(successes: int, count: int, z: float = 1.96) -> tuple[float, float]:
    """95% interval of a share (Wilson 1927, https://doi.org/10.1080/01621459.1927.10502953)."""
    share = successes / count
    middle = share + z**2 / (2 * count)
    half = z * (share * (1 - share) / count + z**2 / (4 * count**2)) ** 0.5
    scale = 1 + z**2 / count
    return (middle - half) / scale, (middle + half) / scale


def write(page: Path, result: str, survivors: list[str]) -> None:
    """Puts a result between the markers of a Markdown file."""
    before, rest = page.read_text().split(MARKERS[0])
    lines = "\n".join(f"- `{line}`" for line in survivors) or "- none"
    after = MARKERS[1] + rest.split(MARKERS[1])[1]
    page.write_text("\n\n".join((before + MARKERS[0], result, "Survivors:", lines, after)))


def main() -> int:
    """Draws, plants, prints and writes."""
    parser = argparse.ArgumentParser(prog="make mutants")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="runs at once")
    parser.add_argument("--seconds", type=float, default=120.0, help="of tests for each mutant")
    parser.add_argument("--write", type=Path, help="Markdown file with markers")
    args = parser.parse_args()
    begin, survivors = time.perf_counter(), []
    for mutant, noticed in forks.run_all(
        caught, drawn(args.count, args.seed, args.seconds), args.jobs
    ):
        if noticed is None:
            survivors.append(mutant.difference)
        print(f"{mutant.difference} | {noticed or 'SURVIVED'}", flush=True)
    low, high = wilson(args.count - len(survivors), args.count)
    minutes = (time.perf_counter() - begin) / 60
    result = (
        f"{args.count - len(survivors)} of {args.count} mutants caught "
        f"({1 - len(survivors) / args.count:.0%}; 95% interval {low:.0%} to {high:.0%}), "
        f"seed {args.seed}, in {minutes:.0f} minutes."
    )
    print(result)
    if args.write:
        write(args.write, result, survivors)
    return 0


if __name__ == "__main__":
    sys.exit(main())
