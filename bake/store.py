"""Where the bytes of a bake gather until its files are whole: a folder with streams and files, and a record of each slab.

A stream takes the bytes of one slab after the other; a file is whole as soon as it is written. `Store` remembers in memory
which bytes belong to which slices; `Staging` (staging.py) also on disk.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from solidgrain.runtime.errors import BakeError

Bytes = bytes | bytearray | memoryview  # of an array: its `data`
COPY = 2**24  # bytes at a time


@dataclass(frozen=True)
class Encoded:
    """A slab as bytes: parts to append to streams, and whole files, by their names."""

    streams: Mapping[str, Sequence[Bytes]] = field(default_factory=dict)
    files: Mapping[str, Bytes] = field(default_factory=dict)


class Span(NamedTuple):
    """Bytes of a file in the store's folder."""

    file: str
    offset: int
    size: int
    sha256: str


@dataclass(frozen=True)
class Record:
    """Where the bytes of slices z .. z + slices - 1 are."""

    z: int
    slices: int
    streams: Mapping[str, Span]
    files: Mapping[str, Span]


class Finished(NamedTuple):
    """A complete file in the store's folder, and where it belongs."""

    staged: Path
    final: Path


class Store:
    """A folder that takes slabs as bytes and gives them back. `depth` is in slices; `reserved` see `Writer.reserved`."""

    def __init__(self, folder: Path, depth: int, reserved: int = 0, first: int = 0) -> None:
        self.folder, self.depth, self.reserved, self.first = folder, depth, reserved, first
        self.records: list[Record] = []

    def append(self, z: int, slices: int, encoded: Encoded) -> Record:
        """Keep what a writer made of a slab. The streams of one store are written in the order of their slabs."""
        streams = {name: self._append(name, parts) for name, parts in encoded.streams.items()}
        files = {name: self._write(name, content) for name, content in encoded.files.items()}
        record = Record(z, slices, streams, files)
        self.records.append(record)
        return record

    def _append(self, stream: str, parts: Sequence[Bytes]) -> Span:
        name, digest, size = f"{stream}.{self.first:09d}", hashlib.sha256(), 0
        path = self.folder / name
        with open(path, "r+b" if path.exists() else "w+b") as file:
            offset = max(file.seek(0, os.SEEK_END), self.reserved if self.first == 0 else 0)
            file.seek(offset)
            for part in parts:
                content = memoryview(part).cast("B") if memoryview(part).nbytes else memoryview(b"")
                digest.update(content)
                file.write(content)
                size += content.nbytes
        return Span(name, offset, size, digest.hexdigest())

    def _write(self, name: str, content: Bytes) -> Span:
        with open(self.folder / name, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        return Span(name, 0, memoryview(content).nbytes, hashlib.sha256(content).hexdigest())

    def ordered(self) -> list[Record]:
        """One record for each slab, in the order of their slices."""
        return sorted({record.z: record for record in reversed(self.records)}.values(), key=lambda record: record.z)

    def missing(self) -> list[tuple[int, int]]:
        """Runs of slices (first, stop) that no record covers."""
        gaps, reached = [], 0
        for record in self.ordered():
            if record.z > reached:
                gaps.append((reached, record.z))
            reached = max(reached, record.z + record.slices)
        return [*gaps, (reached, self.depth)] if reached < self.depth else gaps

    def joined(self, stream: str) -> Path:
        """A stream as one file: where its bytes begin in order, that file with the others' appended; else a copy in order."""
        spans = [record.streams[stream] for record in self.ordered()]
        base, end, kept = spans[0].file, self.reserved, 0
        while kept < len(spans) and (spans[kept].file, spans[kept].offset) == (base, end):
            end, kept = end + spans[kept].size, kept + 1
        path = self.folder / base
        if any(span.file == base for span in spans[kept:]):
            path, end, kept = self.folder / f"{stream}.joined", self.reserved, 0
        with open(path, "r+b" if kept else "w+b") as file:
            file.truncate(end)
            file.seek(end)
            for span in spans[kept:]:
                for content in self._pieces(span):
                    file.write(content)
        return path

    def read_part(self, stream: str, z: int, slice_bytes: int, offset: int, size: int) -> bytes:
        """Some bytes of slice z of a stream in which each slice has `slice_bytes` bytes."""
        record = next(record for record in self.records if record.z <= z < record.z + record.slices)
        return self.read_span(record.streams[stream], (z - record.z) * slice_bytes + offset, size)

    def read(self, stream: str, z: int, count: int, slice_bytes: int) -> bytearray:
        """Slices z .. z + count - 1 of a stream in which each has `slice_bytes` bytes."""
        content, filled = bytearray(count * slice_bytes), 0
        for record in self.ordered():
            first, stop = max(z, record.z), min(z + count, record.z + record.slices)
            if first < stop:
                span = record.streams[stream]
                with open(self.folder / span.file, "rb") as file:
                    file.seek(span.offset + (first - record.z) * slice_bytes)
                    filled += file.readinto(memoryview(content)[(first - z) * slice_bytes : (stop - z) * slice_bytes])
        if filled != len(content):
            raise BakeError(f"{self.folder}: what was baked has changed on the disk; bake again")
        return content

    def read_span(self, span: Span, offset: int, size: int) -> bytes:
        """Some bytes of a span."""
        with open(self.folder / span.file, "rb") as file:
            file.seek(span.offset + offset)
            content = file.read(size)
        if len(content) != size:
            raise BakeError(f"{self.folder}: what was baked has changed on the disk; bake again")
        return content

    def intact(self, span: Span, alone: bool = False) -> bool:
        """Whether the bytes of a span are what was written, and, if it is `alone`, all that its file holds."""
        digest = hashlib.sha256()
        try:
            if alone and (self.folder / span.file).stat().st_size != span.size:
                return False
            for content in self._pieces(span):
                digest.update(content)
        except OSError:
            return False
        return digest.hexdigest() == span.sha256

    def _pieces(self, span: Span) -> Iterator[bytes]:
        with open(self.folder / span.file, "rb") as file:
            file.seek(span.offset)
            left = span.size
            while left > 0 and (content := file.read(min(left, COPY))):
                left -= len(content)
                yield content

    def clear(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)


def sha256_of(path: Path) -> str:
    """The checksum of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
