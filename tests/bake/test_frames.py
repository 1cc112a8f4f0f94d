"""Numbered names follow the pattern, and all slices of a stack have the same width."""

from pathlib import Path

import pytest

from solidgrain.bake.frames import frame_paths, in_hashes
from solidgrain.runtime import UsageError


@pytest.mark.parametrize(
    ("pattern", "count", "first", "names"),
    [
        ("a.####.exr", 2, 1, ["a.0001.exr", "a.0002.exr"]),
        ("a.%04d.exr", 2, 1001, ["a.1001.exr", "a.1002.exr"]),
        ("a_#.exr", 2, 9, ["a_09.exr", "a_10.exr"]),
        ("a.exr", 1, 1, ["a.exr"]),
    ],
)
def test_patterns(pattern, count, first, names):
    assert [path.name for path in frame_paths(Path("x") / pattern, count, first)] == names


@pytest.mark.parametrize(
    ("pattern", "name"), [("a.%04d.exr", "a.####.exr"), ("a_%02d", "a_##"), ("a.###.exr", "a.###.exr"), ("a%d.vti", "a%d.vti")]
)
def test_one_stack_has_one_name(pattern, name):
    assert in_hashes(Path("x") / pattern) == Path("x") / name


@pytest.mark.parametrize("pattern", ["a.exr", "a.##.%02d.exr"])
def test_a_stack_needs_exactly_one_pattern(pattern):
    with pytest.raises(UsageError, match=r"a\.####\.exr|one frame pattern"):
        frame_paths(Path(pattern), 2, 1)
