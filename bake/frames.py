"""Numbered file names: `granite.####.exr` and `granite.%04d.exr`."""

from __future__ import annotations

import re
from pathlib import Path

from solidgrain.runtime.errors import UsageError

PATTERN = re.compile(r"(?P<hashes>#+)|%0(?P<digits>\d\d?)d")


def in_hashes(pattern: Path) -> Path:
    """The same frames by one name: `a.%04d.exr` is `a.####.exr`."""
    return pattern.with_name(PATTERN.sub(lambda match: match["hashes"] or "#" * max(1, int(match["digits"])), pattern.name))


def frame_paths(pattern: Path, count: int, first: int) -> list[Path]:
    """The path of each of `count` frames, numbered from `first`.

    The padding is the pattern's, or wider for all of them when the last number needs it: players break on mixed widths.
    Raises UsageError if the name has no frame pattern, or several, and there is more than one frame.
    """
    matches = list(PATTERN.finditer(pattern.name))
    if not matches and count == 1:
        return [pattern]
    if len(matches) != 1:
        example = f"{re.sub('[#%]+0?[0-9]*d?', '', pattern.stem).rstrip('.')}.####{pattern.suffix}"
        raise UsageError(f"--out {pattern}: expected one frame pattern for its {count} slices, such as {example}")
    match = matches[0]
    asked = len(match["hashes"]) if match["hashes"] else int(match["digits"])
    width = max(asked, len(str(first + count - 1)))
    before, after = pattern.name[: match.start()], pattern.name[match.end() :]
    return [pattern.with_name(f"{before}{number:0{width}d}{after}") for number in range(first, first + count)]
