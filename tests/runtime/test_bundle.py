"""Loading checks everything, and says which file is wrong."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from solidgrain.export import bundle as bundle_module
from solidgrain.export.bundle import Details, write_bundle
from solidgrain.runtime import BundleError, EvaluationError, ProviderError, embedded_names, load
from solidgrain.runtime.bundle import embedded_folder, file_sha256, open_bundle
from solidgrain.runtime.files import exchanged
from solidgrain.runtime.texture_file import TextureData, read_texture, write_texture
from tests.toy import toy_weights


@pytest.fixture
def broken(toy_folder, tmp_path):
    """A copy of the toy bundle, for breaking."""
    return shutil.copytree(toy_folder, tmp_path / "broken")


def edit_manifest(folder, **changes):
    path = folder / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def test_granite_is_embedded_and_the_default():
    assert "granite" in embedded_names()
    assert load().name == "granite"


def test_embedded_textures_are_small():
    """What the wheel may weigh: 400 KB a texture, 5 MB all of them."""
    textures = [bundle for name in embedded_names() if not (bundle := open_bundle(embedded_folder(name))).is_space]
    sizes = [bundle.size for bundle in textures]
    assert len(sizes) >= 8
    assert max(sizes) <= 400_000
    assert sum(sizes) < 5_000_000


def test_an_unknown_name_suggests_close_ones():
    with pytest.raises(BundleError, match="did you mean granite"):
        load("granit")


def test_a_saved_texture_finds_its_bundle_and_looks_the_same(tmp_path, toy, toy_folder):
    toy.save(tmp_path / "mine.sgt.npz")
    with pytest.raises(BundleError, match="needs the bundle"):
        load(tmp_path / "mine.sgt.npz")
    again = load(tmp_path / "mine.sgt.npz", bundle=toy_folder)
    assert np.array_equal(again.grid((1, 8, 8)), toy.grid((1, 8, 8)))
    load("granite").save(tmp_path / "granite.sgt.npz")
    assert load(tmp_path / "granite.sgt.npz").name == "granite"


def test_equal_textures_are_equal_files_of_at_most_30_kilobytes(tmp_path):
    for name in ("a.sgt.npz", "b.sgt.npz"):
        load("granite").save(tmp_path / name)
    assert (tmp_path / "a.sgt.npz").read_bytes() == (tmp_path / "b.sgt.npz").read_bytes()
    assert (tmp_path / "a.sgt.npz").stat().st_size < 30_000


def test_a_texture_of_another_bundle_is_refused_with_the_sha256_that_it_needs(tmp_path, toy):
    toy.save(tmp_path / "mine.sgt.npz")
    with pytest.raises(BundleError, match=toy.data.sampler_sha256[:12]):
        load(tmp_path / "mine.sgt.npz", bundle=load("granite").bundle.folder)
    load("marble").save(tmp_path / "marble.sgt.npz")
    with pytest.raises(BundleError, match="that is marble, embedded"):
        load(tmp_path / "marble.sgt.npz", bundle="granite")


def test_a_texture_remembers_at_what_scale_its_photograph_was_encoded(tmp_path, toy):
    write_texture(tmp_path / "a.sgt.npz", toy.data)
    assert read_texture(tmp_path / "a.sgt.npz").scale == 1
    reduced = replace(toy.data, scale=2.5)
    write_texture(tmp_path / "b.sgt.npz", reduced)
    assert read_texture(tmp_path / "b.sgt.npz").scale == 2.5
    assert reduced.sha256 == toy.data.sha256
    write_texture(tmp_path / "c.sgt.npz", replace(toy.data, scale=-1.0))
    with pytest.raises(BundleError, match=r"scale -1\.0 is no positive number"):
        read_texture(tmp_path / "c.sgt.npz")


def test_the_bundle_of_a_texture_file_is_named_as_any_other(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    granite = load("granite")
    granite.save("mine.sgt.npz")
    assert load("mine.sgt.npz", bundle="granite").bundle.folder == granite.bundle.folder
    with pytest.raises(BundleError, match=r"granit: no such .* did you mean granite"):
        load("mine.sgt.npz", bundle="granit")


@pytest.mark.parametrize("name", ["sampler.onnx", "texture.sgt.npz"])
def test_a_missing_file_is_named(broken, name):
    (broken / name).unlink()
    with pytest.raises(BundleError, match=f"{name}: missing"):
        load(broken)


def test_a_missing_manifest_is_named(broken):
    (broken / "manifest.json").unlink()
    with pytest.raises(BundleError, match=r"no manifest\.json"):
        load(broken)


@pytest.mark.parametrize("name", ["sampler.onnx", "texture.sgt.npz"])
def test_a_corrupted_file_is_named(broken, name):
    data = bytearray((broken / name).read_bytes())
    data[len(data) // 2] ^= 1
    (broken / name).write_bytes(data)
    with pytest.raises(BundleError, match=f"{name}: sha256"):
        load(broken)


def test_a_swapped_graph_is_noticed(broken, tmp_path):
    other = write_bundle(tmp_path / "other", toy_weights(seed=6), Details(name="other", patch=64))
    shutil.copy(other / "sampler.onnx", broken / "sampler.onnx")
    with pytest.raises(BundleError, match="belongs to another bundle"):
        load(broken)


def test_a_graph_that_onnx_runtime_cannot_load_is_named(broken):
    (broken / "sampler.onnx").write_bytes(b"not a graph")
    digest = file_sha256(broken / "sampler.onnx")
    edit_manifest(broken, files={"sampler.onnx": digest, "texture.sgt.npz": file_sha256(broken / "texture.sgt.npz")})
    data = read_texture(broken / "texture.sgt.npz")
    write_texture(broken / "texture.sgt.npz", TextureData(data.name, digest, **data.arrays()))
    edit_manifest(broken, files={"sampler.onnx": digest, "texture.sgt.npz": file_sha256(broken / "texture.sgt.npz")})
    with pytest.raises(BundleError, match="ONNX Runtime cannot load"):
        load(broken)


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"format_version": 99}, "version 99"), ({"format": "zip"}, "format is 'zip'"), ({"files": {}}, "incomplete")],
)
def test_another_format_or_version_is_refused(broken, changes, message):
    edit_manifest(broken, **changes)
    with pytest.raises(BundleError, match=message):
        load(broken)


def test_colours_that_are_not_srgb_are_not_taken_for_it(broken):
    edit_manifest(broken, color_encoding="lin_ap1_scene")
    with pytest.raises(BundleError, match="colours are 'lin_ap1_scene', this solidgrain reads 'srgb_rec709_scene'"):
        load(broken)


def test_a_texture_that_the_manifest_does_not_vouch_for_is_not_loaded(broken):
    edit_manifest(broken, files={"sampler.onnx": file_sha256(broken / "sampler.onnx")})
    with pytest.raises(BundleError, match=r"texture\.sgt\.npz: not in the manifest"):
        load(broken)


def test_a_file_called_as_an_embedded_texture_does_not_hide_it(tmp_path, monkeypatch):
    (tmp_path / "granite").write_text("notes on granite")
    monkeypatch.chdir(tmp_path)
    assert load().name == load("granite").name == "granite"
    with pytest.raises(BundleError, match="not a texture file"):
        load("./granite")


def test_a_name_that_is_too_long_for_a_file_is_an_unknown_one():
    with pytest.raises(BundleError, match="no such texture"):
        load("a" * 5000)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": 1}'])
def test_a_manifest_that_is_no_manifest_is_refused(broken, text):
    (broken / "manifest.json").write_text(text)
    with pytest.raises(BundleError, match=r"manifest\.json"):
        load(broken)


@pytest.mark.parametrize(
    "changes",
    [{"files": [1]}, {"files": {"sampler.onnx": 5}}, {"octaves": "16"}, {"probe": {}}, {"training": None}, {"patch": None}],
)
def test_a_manifest_with_a_wrong_entry_is_refused(broken, changes):
    edit_manifest(broken, **changes)
    with pytest.raises(BundleError, match=next(iter(changes))):
        load(broken)


def test_a_graph_that_takes_other_inputs_is_refused(tmp_path):
    small = write_bundle(tmp_path / "small", toy_weights(octaves=8), Details(name="small", patch=64))
    large = write_bundle(tmp_path / "large", toy_weights(octaves=16), Details(name="large", patch=64))
    shutil.copy(small / "sampler.onnx", large / "sampler.onnx")
    digest = read_texture(small / "texture.sgt.npz").sampler_sha256
    data = read_texture(large / "texture.sgt.npz")
    write_texture(large / "texture.sgt.npz", TextureData("large", digest, **data.arrays()))
    edit_manifest(large, files={name: file_sha256(large / name) for name in ("sampler.onnx", "texture.sgt.npz")})
    with pytest.raises(BundleError, match=r"sampler\.onnx: not a sampler for this texture"):
        load(large)


def test_a_folder_of_the_same_name_does_not_hide_an_embedded_texture(tmp_path, monkeypatch):
    (tmp_path / "granite").mkdir()
    monkeypatch.chdir(tmp_path)
    assert load("granite").name == "granite"


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"hello"])
def test_a_damaged_texture_file_is_refused(tmp_path, content):
    path = tmp_path / "bad.sgt.npz"
    path.write_bytes(content)
    with pytest.raises(BundleError, match=r"bad\.sgt\.npz"):
        load(path)


def test_a_texture_file_with_any_byte_changed_is_read_or_refused(tmp_path, toy):
    """Other compression methods, encryption and headers of arrays that are no Python included."""
    toy.save(tmp_path / "toy.sgt.npz")
    whole, draw = (tmp_path / "toy.sgt.npz").read_bytes(), np.random.default_rng(0)
    heads = [place for place in range(len(whole)) if b"PK" in whole[max(0, place - 48) : place]]  # of members and the directory
    refused = 0
    for place in [*heads, *draw.integers(0, len(whole), 300).tolist()]:
        changed = bytearray(whole)
        changed[place] ^= int(draw.integers(1, 256))
        (tmp_path / "toy.sgt.npz").write_bytes(changed)
        try:
            read_texture(tmp_path / "toy.sgt.npz")
        except BundleError:
            refused += 1
    assert refused > 300


@pytest.mark.parametrize("name", ["nul\0x", "a\udcffb", "line\n"])
def test_a_name_that_no_file_could_hold_is_refused(toy, toy_folder, tmp_path, name):
    write_texture(tmp_path / "a.sgt.npz", replace(toy.data, name=name))
    with pytest.raises(BundleError, match="expected a name of printable characters"):
        load(tmp_path / "a.sgt.npz", bundle=toy_folder)


def test_nan_in_a_texture_file_is_refused(tmp_path, toy, toy_folder):
    arrays = toy.data.arrays()
    arrays["gamma"] = np.full_like(arrays["gamma"], np.nan)
    write_texture(tmp_path / "nan.sgt.npz", TextureData("toy", toy.data.sampler_sha256, **arrays))
    with pytest.raises(BundleError, match="gamma is not finite"):
        load(tmp_path / "nan.sgt.npz", bundle=toy_folder)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("noise_weights", lambda a: a[:, :1]),
        ("noise_weights", np.ravel),
        ("transforms", lambda a: a[:, None]),
        ("transforms", lambda a: a[0, 0, 0]),
        ("gamma", lambda a: a[None]),
        ("delta", lambda a: np.concatenate([a, a[:2]])),
    ],
)
def test_a_texture_of_other_shapes_is_refused(tmp_path, toy, toy_folder, name, change):
    arrays = toy.data.arrays()
    arrays[name] = change(arrays[name])
    write_texture(tmp_path / "odd.sgt.npz", TextureData("toy", toy.data.sampler_sha256, **arrays))
    with pytest.raises(BundleError, match=f"{name} of texture 'toy' has shape .* expected"):
        load(tmp_path / "odd.sgt.npz", bundle=toy_folder)


def test_a_model_that_returns_nan_is_an_error(tmp_path):
    weights = toy_weights()
    weights.weights[2][0, 0] = np.nan
    folder = write_bundle(tmp_path / "nan", weights, Details(name="nan", patch=64))
    with pytest.raises(EvaluationError, match="returned NaN"):
        load(folder).grid((1, 4, 4))


def test_a_provider_that_cannot_be_had_is_an_error_that_lists_the_others():
    with pytest.raises(ProviderError, match=r"'rocket'.*cpu"):
        load(provider="rocket")


def test_the_provider_that_runs_is_named(toy_folder):
    assert load(toy_folder, provider="cpu").provider == "CPUExecutionProvider"


@pytest.mark.parametrize("where", ["add", "rename"])
def test_a_bundle_that_cannot_be_replaced_stays(tmp_path, monkeypatch, where):
    folder = write_bundle(tmp_path / "toy", toy_weights(seed=1), Details(name="toy", patch=64))
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    def fail(*_):
        raise OSError(28, "No space left on device")

    def rename(path, target, rename=Path.rename):
        return fail() if where == "rename" and path.name.endswith(".tmp") else rename(path, target)

    monkeypatch.setattr(Path, "rename", rename)
    monkeypatch.setattr(bundle_module, "exchanged", lambda *_: False)  # as where the system cannot
    more = {"add": fail} if where == "add" else {}
    with pytest.raises(BundleError, match="No space left"):
        write_bundle(folder, toy_weights(seed=2), Details(name="toy", patch=64), overwrite=True, **more)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["toy"]


def test_a_bundle_that_is_replaced_is_never_away(tmp_path, monkeypatch):
    folder = write_bundle(tmp_path / "toy", toy_weights(seed=1), Details(name="toy", patch=64))
    if not exchanged(folder, shutil.copytree(folder, tmp_path / "copy")):
        pytest.skip("this system has no renameat2")
    shutil.rmtree(tmp_path / "copy")
    monkeypatch.setattr(Path, "rename", None)  # whatever moves it away would fail
    write_bundle(folder, toy_weights(seed=2), Details(name="other", patch=64), overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["toy"]
    assert open_bundle(folder).name == "other"


def test_a_space_is_a_bundle_itself():
    with pytest.raises(BundleError, match="stone: is a bundle itself, and --bundle is about texture files; leave nope out"):
        load("stone", bundle="nope")
