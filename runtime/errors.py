"""The errors that solidgrain raises for what a user can mend.

    SolidgrainError
      UsageError        flags that contradict each other or name what does not exist (exit code 2)
      BundleError       a bundle or texture file that is missing, damaged or of another version
      ExemplarError     a photograph that cannot be learned from
      TrainingError     a training run that cannot start, go on or be read
      ProviderError     an ONNX Runtime execution provider that was asked for and cannot be had
      EvaluationError   a sampler that returns NaN, or coordinates that it cannot take
      BakeError         a bake that cannot be done as asked
      ViewError         a volume that cannot be shown

Each message is one line: the flag or file, what was expected, what was found, what to do next.
"""

from __future__ import annotations

from collections.abc import Iterable


class SolidgrainError(Exception):
    """Base of all errors that solidgrain raises on purpose."""


class UsageError(SolidgrainError):
    """The command line asks for something that no file or machine could make possible."""


class BundleError(SolidgrainError):
    """A bundle or texture file is missing, damaged, incomplete or of another version."""


class ExemplarError(SolidgrainError):
    """A photograph is missing, unreadable, too small or too large."""


class TrainingError(SolidgrainError):
    """A training run cannot start, go on or be read."""


class ProviderError(SolidgrainError):
    """The execution provider that was asked for cannot be had. There is no silent fall-back."""


class EvaluationError(SolidgrainError):
    """The sampler returned NaN, or was asked for something that it cannot evaluate."""

    @classmethod
    def of_nan(cls, texture: str, point: Iterable[float]) -> EvaluationError:
        """That the sampler returned NaN at a finite point (x, y, z)."""
        x, y, z = point
        return cls(f"{texture}: the sampler returned NaN at ({x:g}, {y:g}, {z:g}); the texture is damaged")


class BakeError(SolidgrainError):
    """A bake cannot be done as asked."""


class ViewError(SolidgrainError):
    """A volume cannot be read or shown."""
