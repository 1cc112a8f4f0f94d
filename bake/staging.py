"""The store of a bake that may be killed: a hidden folder beside the output, with a lock, a journal and the plan it is for.

    .granite.vti.baking/
      lock               held while a process works here (flock: a dead owner does not hold it)
      work.json          what the bytes depend on
      plan.json          all of the plan that was baked here last, for `merge`
      journal.000000000  a line of JSON per slab: where its bytes are, and their SHA-256; one journal per shard
      data.000000000     the slabs' bytes, one stream per shard; or whole files, one per slice
      finished.json      the complete files, their checksums and destinations; written before the first is put in place

Nothing is believed that its checksum does not confirm. What a kill has cut short is cut off or written again.
"""

from __future__ import annotations

import json
import os
import re
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, BinaryIO

from solidgrain.bake.farm import seen_from
from solidgrain.bake.frames import in_hashes
from solidgrain.bake.plan import Plan, hash_of
from solidgrain.bake.store import Encoded, Finished, Record, Span, Store, sha256_of
from solidgrain.runtime.errors import BakeError
from solidgrain.runtime.files import locked, replacing

LOCK, WORK, PLAN, FINISHED, JOURNAL = "lock", "work.json", "plan.json", "finished.json", "journal"


class Staging(Store):
    """The store of one output. Opened with `open_staging`, closed with `close`; `clear` removes it."""

    def __init__(
        self, folder: Path, work: str, depth: int, reserved: int, shard: tuple[int, int] | None, locks: list[BinaryIO]
    ) -> None:
        super().__init__(folder, depth, reserved, shard[0] if shard else 0)
        self.work = work  # hash of what the bytes depend on
        self.shared = shard is not None
        self.in_place = False  # files have begun to get their names
        self._cleared = False
        self._locks = locks
        self._journal = folder / f"{JOURNAL}.{self.first:09d}"

    def keep_plan(self, plan: Plan) -> None:
        """Note where the texture and all outputs are, which the work does not say."""
        path = self.folder / PLAN
        content = json.dumps(seen_from(self.folder.parent, plan).to_json(), indent=1).encode()
        if not path.exists() or path.read_bytes() != content:
            with replacing(path) as file:
                file.write(content)

    def append(self, z: int, slices: int, encoded: Encoded) -> Record:
        record = super().append(z, slices, encoded)
        with open(self._journal, "ab") as file:
            file.write(self._line(record))
        return record

    def restore(self) -> None:
        """Take up what this shard's journal tells and its files confirm; forget the rest, on disk too.

        Who has all of the staging takes up what other shards have left.
        """
        (self.folder / FINISHED).unlink(missing_ok=True)
        self.records = self._confirmed(self._journal)
        ends: dict[str, int] = {}
        for record in self.records:
            ends.update({span.file: span.offset + span.size for span in record.streams.values()})
        for path in self.folder.glob(f"*.{self.first:09d}"):
            if path != self._journal and path.name.partition(".")[0] != LOCK:
                os.truncate(path, ends.get(path.name, 0))
        with replacing(self._journal) as file:
            file.writelines(map(self._line, self.records))
        if not self.shared:
            self.gather()

    def gather(self) -> None:
        """Take up what the other shards' journals tell and their files confirm, too."""
        for journal in sorted(self.folder.glob(f"{JOURNAL}.*")):
            if journal != self._journal:
                self.records += self._confirmed(journal)

    def _line(self, record: Record) -> bytes:
        values = {"work": self.work, "z": record.z, "slices": record.slices}
        return json.dumps({**values, "streams": dict(record.streams), "files": dict(record.files)}).encode() + b"\n"

    def _confirmed(self, journal: Path) -> list[Record]:
        """A stream's records up to the first bad one: later bytes lie behind it. Files stand for themselves."""
        found: list[Record] = []
        ends: dict[str, int] = {}
        for record in _records(journal, self.work):
            follows = all(span.offset == ends.get(span.file, self._start(span.file)) for span in record.streams.values())
            whole = all(self.intact(span, alone=True) for span in record.files.values())
            if not (follows and whole and all(map(self.intact, record.streams.values()))):
                if record.streams:
                    break
                continue
            ends.update({span.file: span.offset + span.size for span in record.streams.values()})
            found.append(record)
        return found

    def _start(self, stream_file: str) -> int:
        return self.reserved if stream_file.endswith(f".{0:09d}") else 0

    def finish(self, files: list[Finished]) -> list[dict[str, Any]]:
        """Note that the files are complete: from here on, a killed bake has only to put them in place. Returns the notes."""
        known = {span.file: span.sha256 for record in self.records for span in record.files.values()}
        lines = [
            {
                "staged": os.fspath(file.staged.relative_to(self.folder)),
                "final": file.final.name,
                "bytes": file.staged.stat().st_size,
                "sha256": known.get(os.fspath(file.staged.relative_to(self.folder))) or sha256_of(file.staged),
            }
            for file in files
        ]
        with replacing(self.folder / FINISHED) as file:
            file.write(json.dumps({"work": self.work, "files": lines}).encode())
        return lines

    def finished(self) -> list[dict[str, Any]] | None:
        """The complete files, if `finish` came to its end and nothing has been lost since."""
        try:
            notes = json.loads((self.folder / FINISHED).read_bytes())
        except (OSError, ValueError):
            return None
        lines: list[dict[str, Any]] = notes["files"]
        return lines if notes["work"] == self.work and all(map(self._found, lines)) else None

    def _found(self, line: dict[str, Any]) -> bool:
        """Whether a complete file lies here, or already where it belongs."""
        for path in (self.folder / line["staged"], self.folder.parent / line["final"]):
            if path.is_file():
                return sha256_of(path) == str(line["sha256"])
        return False

    def commit(self, lines: list[dict[str, Any]]) -> list[Path]:
        """Put the complete files in place."""
        finals = []
        for line in lines:
            final = self.folder.parent / line["final"]
            with suppress(FileNotFoundError):  # put in place before a kill
                os.replace(self.folder / line["staged"], final)
            finals.append(final)
        return finals

    def close(self) -> None:
        """Let others work here."""
        for lock in self._locks:
            lock.close()
        if self._cleared:  # on NFS an open file that is removed keeps its folder from being
            with suppress(OSError):
                self.folder.rmdir()

    def empty(self) -> None:
        """Remove everything but the locks: first what tells of bytes, last whose they are. A kill leaves nothing to believe."""
        for path in sorted(self.folder.glob("*"), key=_removal):
            if path.is_dir():
                Store(path, 0).clear()
            elif path.name.partition(".")[0] != LOCK:
                path.unlink(missing_ok=True)

    def clear(self) -> None:
        """Remove the folder, the lock last: whoever waits for it finds a folder that is gone, and begins a new one."""
        self._cleared = True
        with suppress(OSError):
            self.empty()
            for path in sorted(self.folder.glob("*"), key=lambda path: path.name == LOCK):
                path.unlink(missing_ok=True)
            self.folder.rmdir()


def _removal(path: Path) -> int:
    if path.name == FINISHED or path.name.startswith(f"{JOURNAL}."):
        return 0
    return 2 if path.name == WORK else 1


def staging_folder(output: Path) -> Path:
    return output.with_name(f".{in_hashes(output).name}.baking")


def is_begun(output: Path) -> bool:
    """Whether an earlier bake of an output was killed when its files were complete: some may be in place."""
    return (staging_folder(output) / FINISHED).exists()


def staged_bytes(output: Path) -> int:
    """The bytes that an earlier bake has left in the staging of an output, without those that must be copied once more:
    the streams of all shards but the first."""
    total = 0
    for path in staging_folder(output).glob("*"):
        if not re.search(r"\.(?!0{9}$)\d{9}$", path.name):
            with suppress(FileNotFoundError):  # another shard's temporary file
                total += path.stat().st_size
    return total


def discard_staging(output: Path) -> None:
    """Remove what a kill has left of an output, unless another process works there."""
    folder = staging_folder(output)
    if folder.is_dir():
        with suppress(BakeError), closing(Staging(folder, "", 0, 0, None, _lock(folder, output, None))) as staging:
            staging.clear()


def clear_leftovers(output: Path, work: dict[str, Any], overwrite: bool) -> None:
    """Remove an unfinished bake of another plan that is in the way of shards, or refuse to. Raises BakeError."""
    if overwrite and is_foreign(output, work):
        discard_staging(output)
    elif (staging_folder(output) / WORK).exists():
        check_work(output, work)


def is_foreign(output: Path, work: dict[str, Any]) -> bool:
    """Whether an unfinished bake of another plan lies beside an output. One that has lost its name is nobody's."""
    path = staging_folder(output) / WORK
    return path.exists() and read_work(path) != json.loads(json.dumps(work))


def open_staging(
    output: Path, work: dict[str, Any], depth: int, reserved: int, shard: tuple[int, int] | None, fresh: bool
) -> Staging:
    """The staging of an output, locked: for one shard (slices first .. stop - 1), or, with None, for all of it.

    `fresh` forgets what an earlier bake has left. Raises BakeError if another process works there, or if what it left
    belongs to another plan.
    """
    folder = staging_folder(output)
    staging = Staging(folder, hash_of(work), depth, reserved, shard, _lock(folder, output, shard))
    try:
        if fresh:
            staging.empty()
        check_work(output, work)
    except BaseException:
        if fresh:
            staging.clear()
        staging.close()
        raise
    return staging


def _lock(folder: Path, output: Path, shard: tuple[int, int] | None) -> list[BinaryIO]:
    """All of the staging, or a share in it and the shard's own part."""
    if shard is None:
        return [_locked(folder / LOCK, output)]
    whole = _locked(folder / LOCK, output, shared=True)
    try:
        return [whole, _locked(folder / f"{LOCK}.{shard[0]:09d}", output)]
    except BaseException:
        whole.close()
        raise


def _locked(path: Path, output: Path, shared: bool = False) -> BinaryIO:
    try:
        return locked(path, shared)
    except BlockingIOError:
        raise BakeError(f"{output}: another process is baking it; wait for it, or write to another name") from None


def check_work(output: Path, work: dict[str, Any]) -> None:
    """The staging of an output must be for this work; a new one is given its name. Raises BakeError."""
    path, expected = staging_folder(output) / WORK, json.loads(json.dumps(work))
    if not path.exists():
        with replacing(path) as file:
            file.write(json.dumps(work, sort_keys=True, indent=1).encode())
    found = read_work(path)
    if found != expected:
        differ = sorted(key for key in {*found, *expected} if found.get(key) != expected.get(key))
        raise BakeError(
            f"{output}: an unfinished bake of another plan lies in {path.parent} (different: {', '.join(differ)}); "
            "finish it with its own flags, or begin anew with --overwrite"
        )


def read_work(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        found = None
    return found if isinstance(found, dict) else {"work": "unreadable"}


def _records(journal: Path, work: str) -> list[Record]:
    """The lines of a journal that are whole and about this work."""
    try:
        lines = journal.read_bytes().split(b"\n")
    except FileNotFoundError:
        return []
    records = []
    for line in lines[:-1]:
        with suppress(ValueError, TypeError, KeyError):
            values = json.loads(line)
            if values["work"] != work:
                continue
            spans = [{name: Span(*span) for name, span in values[kind].items()} for kind in ("streams", "files")]
            records.append(Record(int(values["z"]), int(values["slices"]), *spans))
    return records
