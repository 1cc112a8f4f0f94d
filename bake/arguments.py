"""Types of command-line arguments. Each says what it expected and what it found."""

from __future__ import annotations

import argparse
import math

MOST_STEPS = 10_000  # of a sequence


def parse_size(text: str) -> tuple[int, int, int]:
    """ "128" or "256x128x64" (x, y, z)."""
    parts = text.replace(",", "x").split("x")
    numbers = [int(part) if part.isdecimal() else 0 for part in (parts * 3 if len(parts) == 1 else parts)]
    if len(numbers) != 3 or min(numbers) < 1:
        raise argparse.ArgumentTypeError(f"expected N or XxYxZ, whole numbers above 0, found {text!r}")
    return (numbers[0], numbers[1], numbers[2])


def parse_vector(text: str) -> tuple[float, float, float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise argparse.ArgumentTypeError(f"expected X,Y,Z, three numbers, found {text!r}")
    return (numbers[0], numbers[1], numbers[2])


def parse_spacing(text: str) -> tuple[float, float, float]:
    """One number for all axes, or X,Y,Z."""
    spacing = parse_vector(text if "," in text else ",".join([text] * 3))
    if min(spacing) <= 0:
        raise argparse.ArgumentTypeError(f"expected exemplar pixels per voxel, above 0, found {text!r}")
    return spacing


def parse_text(text: str) -> str:
    """What goes into files and model cards."""
    if not text.isprintable():
        raise argparse.ArgumentTypeError(f"expected printable characters in UTF-8, found {text!a}")
    return text


def parse_tile(text: str) -> str:
    if not set(text) <= set("xyz") or len(set(text)) != len(text):
        raise argparse.ArgumentTypeError(f"expected each of x, y, z at most once, found {text!r}")
    return "".join(sorted(text))


def parse_count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a whole number, 0 or more, found {text!r}")
    return int(text)


def parse_seed(text: str) -> int:
    if not text.isdecimal() or int(text) >= 2**64:
        raise argparse.ArgumentTypeError(f"expected a whole number from 0 to 2^64 - 1, found {text!r}")
    return int(text)


def parse_positive(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, found {text!r}")
    return int(text)


def parse_axis(text: str) -> str:
    """Of an image, along which a grain runs. A flag whose value may be missing takes whatever follows it."""
    if text not in ("auto", "x", "y"):
        raise argparse.ArgumentTypeError(f"expected auto, x or y, found {text!r}; put what is no axis before the flag")
    return text


def parse_minutes(text: str) -> float:
    return _duration(text, "minutes")


def parse_seconds(text: str) -> float:
    return _duration(text, "seconds")


def _duration(text: str, unit: str) -> float:
    try:
        duration = float(text)
    except ValueError:
        duration = 0.0
    if not 0 < duration < math.inf:
        raise argparse.ArgumentTypeError(f"expected {unit} above 0, found {text!r}")
    return duration


def _numbers(text: str, count: int) -> list[float]:
    """So many finite numbers, separated by commas or spaces; none if they are not."""
    try:
        numbers = [float(part) for part in text.replace(",", " ").split()]
    except ValueError:
        return []
    return numbers if len(numbers) == count and all(map(math.isfinite, numbers)) else []


def parse_box(text: str) -> tuple[float, ...]:
    """Both corners, the lower one first."""
    numbers = _numbers(text, 6)
    if not numbers or not all(low < high for low, high in zip(numbers[:3], numbers[3:], strict=True)):
        raise argparse.ArgumentTypeError(f"expected X,Y,Z,X,Y,Z, the lower corner and the upper one, found {text!r}")
    return tuple(numbers)


def parse_matrix(text: str) -> tuple[tuple[float, ...], ...]:
    """A placement, 4x4."""
    numbers = _numbers(text, 16)
    if not numbers or numbers[12:] != [0, 0, 0, 1]:
        raise argparse.ArgumentTypeError(f"expected 16 numbers, row by row, the last four 0,0,0,1, found {text!r}")
    return tuple(tuple(numbers[4 * row : 4 * row + 4]) for row in range(4))


def parse_pixel_size(text: str) -> float:
    numbers = _numbers(text, 1)
    if not numbers or numbers[0] <= 0:
        raise argparse.ArgumentTypeError(f"expected metres, above 0, found {text!r}")
    return numbers[0]


def parse_shard(text: str) -> tuple[int, int]:
    """ "3/8": the third of eight."""
    number, slash, count = text.partition("/")
    if not (slash and number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise argparse.ArgumentTypeError(f"expected I/N with I from 1 to N, such as 3/8, found {text!r}")
    return int(number), int(count)


FINEST_SCALE, COARSEST_SCALE = 0.01, 1000.0  # one pixel becomes a patch of 128; no photograph that is read has more


def parse_scale(text: str) -> float:
    numbers = _numbers(text, 1)
    if not numbers or not FINEST_SCALE <= numbers[0] <= COARSEST_SCALE:
        between = f"from {FINEST_SCALE:g} to {COARSEST_SCALE:g}"
        raise argparse.ArgumentTypeError(f"expected pixels of the photograph per texture pixel, {between}, found {text!r}")
    return numbers[0]


def parse_corner(text: str) -> tuple[int, int]:
    x, comma, y = text.partition(",")
    if not (comma and x.isdecimal() and y.isdecimal()):
        raise argparse.ArgumentTypeError(f"expected X,Y, two whole numbers, found {text!r}")
    return int(x), int(y)


def parse_steps(text: str) -> tuple[float, ...]:
    """One number, or FIRST:LAST:STEP, both ends included where the steps meet them."""
    try:
        numbers = [float(part) for part in text.split(":")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 3) or not all(map(math.isfinite, numbers)):
        raise argparse.ArgumentTypeError(f"expected a number or FIRST:LAST:STEP, such as 0:1:0.1, found {text!r}")
    if len(numbers) == 1:
        return (numbers[0],)
    first, last, step = numbers
    steps = (last - first) / step if step else -1.0
    if not 0 <= steps < MOST_STEPS:
        raise argparse.ArgumentTypeError(f"expected steps that lead from {first:g} to {last:g}, found {step:g}")
    count = math.floor(steps + 1e-9) + 1
    return tuple(round(first + k * step, 12) for k in range(count))  # 0.3, not 0.30000000000000004


def parse_length(text: str) -> float:
    numbers = _numbers(text, 1)
    if not numbers:
        raise argparse.ArgumentTypeError(f"expected exemplar pixels, found {text!r}")
    return numbers[0]
