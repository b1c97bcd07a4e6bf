"""Text from outside, made fit for one line of a message."""

MESSAGE = 300
"""Characters of another library's error that a message repeats."""


def shorten(text: object, limit: int = 80) -> str:
    """Returns text in one line of at most `limit` characters, without control characters.

    Args:
      text: a text, or an error or a path to be read as one.
      limit: greatest length; longer text ends in "...".
    """
    line = " ".join(str(text)[: 4 * limit].split())
    line = "".join(letter if letter.isprintable() else "?" for letter in line)
    cut = len(line) > limit or len(str(text)) > 4 * limit
    return f"{line[: limit - 3]}..." if cut else line


def quote(value: object, limit: int = 80) -> str:
    """Returns a value as Python writes it, shortened."""
    try:
        return shorten(repr(value), limit)
    except ValueError:  # an int of too many digits
        return "a number of thousands of digits"
