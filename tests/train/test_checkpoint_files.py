"""Checkpoints lose nothing by being packed, are small, and those of earlier versions are still read."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
import torch

from solidgrain.runtime import TrainingError
from solidgrain.train.loop import Trainer
from solidgrain.train.packing import HEADER, MAGIC, pack, unpack
from solidgrain.train.run import CHECKPOINT_KEYS, Source
from solidgrain.train.settings import PRESETS, Budget
from solidgrain.train.space_run import create_space_run
from tests.train.spaces import numbered
from tests.train.test_training import CPU, new_run, tensors

LARGEST = 60e6  # bytes


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def unpacked_reference(content):
    """As the module's docstring says it, byte by byte."""
    magic, length = HEADER.unpack_from(content)
    assert magic == MAGIC
    each = -(-length // 4)
    body = content[HEADER.size + 4 :]
    planes = [body[place * each : (place + 1) * each] for place in range(3)] + [zlib.decompress(body[3 * each :])]
    return bytes(planes[place % 4][place // 4] for place in range(length))


@pytest.mark.parametrize("length", [0, 1, 3, 4, 5, 1001])
def test_packing_loses_nothing_whatever_the_length(length):
    content = np.random.default_rng(length).bytes(length)
    assert unpack(pack(content)) == unpacked_reference(pack(content)) == content


def test_a_changed_byte_anywhere_is_an_error():
    content, draw = pack(np.random.default_rng(0).bytes(1000)), np.random.default_rng(1)
    for place in range(8, len(content)):
        changed = bytearray(content)
        changed[place] ^= int(draw.integers(1, 256))
        with pytest.raises((ValueError, zlib.error)):
            unpack(bytes(changed))


def test_files_of_earlier_versions_are_read():
    content = np.random.default_rng(0).bytes(1000)
    packed = pack(content)
    assert unpack(b"SGTRAIN1" + packed[8:16] + packed[20:]) == content


def test_what_was_never_packed_is_left_as_it_is():
    assert unpack(b"PK\x03\x04 as torch writes it") == b"PK\x03\x04 as torch writes it"


@pytest.mark.parametrize("kept", [8, 15, 16, 600, -1])
def test_a_packed_file_that_is_cut_short_is_an_error_and_never_other_content(kept):
    with pytest.raises((ValueError, zlib.error)):
        unpack(pack(np.random.default_rng(0).bytes(1000))[:kept])


def test_floats_are_a_sixth_smaller():
    weights = np.random.default_rng(0).normal(size=100_000).astype(np.float32).tobytes()
    assert len(pack(weights)) < 0.85 * len(weights)


def stepped(run) -> Trainer:
    """A trainer whose optimisers have moments: after one step with the gradients of a small batch."""
    trainer = Trainer(run, CPU)
    trainer.step()
    return trainer


def test_a_space_s_checkpoint_is_small_and_comes_back_to_the_last_bit(tmp_path):
    members = [numbered(number, 130, 140) for number in range(3)]
    run = create_space_run(tmp_path / "run", PRESETS["fast space"], members, 0, Source("", "", ""), Budget())
    trainer = stepped(run)
    trainer.save()
    assert (tmp_path / "run" / "checkpoint.pt").stat().st_size < LARGEST
    again = Trainer(run, CPU)
    again.load()
    for part in ("critic", "sampler", "average", "critic_optimiser", "sampler_optimiser"):
        before, after = (dict(tensors(getattr(which, part).state_dict())) for which in (trainer, again))
        assert before.keys() == after.keys()
        assert [name for name in before if not torch.equal(before[name], after[name])] == []
    assert torch.equal(again.generator.get_state(), trainer.generator.get_state())


def test_the_checkpoint_of_an_earlier_version_is_taken_up(tmp_path, photograph):
    """They were torch's own files, not packed, and knew one learning rate for all of the sampler."""
    run = new_run(tmp_path / "run", photograph)
    stepped(run).save()
    state = run.load_checkpoint()
    (group,) = state["sampler_optimiser"]["param_groups"]
    assert "share" not in group
    torch.save(state, tmp_path / "run" / "checkpoint.pt")
    again = Trainer(run, CPU)
    again.load()
    assert again.iteration == 1
    found = run.load_checkpoint()
    assert found.keys() == state.keys() >= CHECKPOINT_KEYS
    assert [name for name, value in tensors(state) if not torch.equal(dict(tensors(found))[name], value)] == []


def test_a_checkpoint_that_cannot_be_read_is_not_called_damaged(tmp_path, photograph):
    run = new_run(tmp_path / "run", photograph)
    (tmp_path / "run" / "checkpoint.pt").mkdir()
    with pytest.raises(TrainingError, match=r"checkpoint\.pt: cannot read \(Is a directory\)"):
        run.load_checkpoint()


@pytest.mark.parametrize("harm", [lambda content: content[:-100], lambda content: content[:5000] + content[6000:]])
def test_a_damaged_checkpoint_is_one_line(tmp_path, photograph, harm):
    run = new_run(tmp_path / "run", photograph)
    stepped(run).save()
    path = tmp_path / "run" / "checkpoint.pt"
    path.write_bytes(harm(path.read_bytes()))
    with pytest.raises(TrainingError, match=r"checkpoint\.pt: damaged checkpoint"):
        run.load_checkpoint()
