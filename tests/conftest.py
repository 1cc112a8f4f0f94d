"""Fixtures for all tests: a toy bundle and a toy space made by code, and the command line run in this process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from solidgrain.bake.cli import main
from solidgrain.export.bundle import Details, write_bundle
from solidgrain.runtime import Texture, load
from tests.toy import toy_weights
from tests.toy_space import write_toy_space

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data" / "exemplars"


@pytest.fixture(scope="session")
def toy_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bundle(tmp_path_factory.mktemp("bundles") / "toy", toy_weights(), Details(name="toy", patch=64))


@pytest.fixture(scope="session")
def toy(toy_folder: Path) -> Texture:
    return load(toy_folder)


@pytest.fixture(scope="session")
def toy_space_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy_space(tmp_path_factory.mktemp("bundles") / "toyspace")


@dataclass(frozen=True)
class Outcome:
    """What a command line did."""

    code: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """The one line that an error is."""
        lines = self.err.strip().splitlines()
        assert len(lines) == 1, self.err
        return lines[0]


@pytest.fixture
def solidgrain(capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """The command line, called as a user calls it."""

    def call(*arguments: object) -> Outcome:
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as stop:
            code = int(stop.code or 0)
        captured = capsys.readouterr()
        return Outcome(code, captured.out, captured.err)

    return call


@pytest.fixture(scope="session")
def exemplars() -> Path:
    """The photographs that lie beside a development checkout."""
    if not SHARED.is_dir():
        pytest.skip(f"{SHARED} is absent: exemplar photographs do not come with the project")
    return SHARED
