"""Tables in Markdown, and files that keep them between markers."""

from collections.abc import Iterable, Sequence
from pathlib import Path


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a table."""
    lines = [columns, ["---"] * len(columns), *rows]
    return [f"| {' | '.join(cells)} |" for cells in lines]


def publish(name: str, lines: Iterable[str], page: Path | None) -> None:
    """Prints lines, and puts them between the markers called `name` of a Markdown file.

    Raises:
      ValueError: if the page has no such markers.
    """
    begin, end = f"<!-- {name}: written by benchmarks/{name}.py -->", f"<!-- end of {name} -->"
    text = "\n".join([begin, "", *lines, "", end])
    print(text)
    if page:
        old = page.read_text()
        if begin not in old or end not in old:
            raise ValueError(f"{page} has no markers {begin} and {end}")
        page.write_text(old.split(begin)[0] + text + old.split(end)[1])
