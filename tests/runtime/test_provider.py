"""Execution providers are chosen by name, refused by name, and never fallen back from, shown without their hardware."""

import time

import numpy as np
import onnxruntime
import pytest

from solidgrain.runtime import ProviderError, load, onnx_engine
from solidgrain.runtime.provider import available_providers
from solidgrain.runtime.workers import usable_threads

OFFERED = ["CUDAExecutionProvider", "DmlExecutionProvider", "CoreMLExecutionProvider", "OpenVINOExecutionProvider"]
NAMES = {"cuda": OFFERED[0], "directml": OFFERED[1], "dml": OFFERED[1], "coreml": OFFERED[2], "OpenVINO": OFFERED[3]}
RealSession, real_value = onnxruntime.InferenceSession, onnxruntime.OrtValue.ortvalue_from_numpy


@pytest.fixture
def machine(monkeypatch):
    """A machine that offers every provider: graphs really run on the CPU, and what was asked for is written down."""
    asked: dict[str, object] = {"devices": set()}

    class Session:
        falls_back = False

        def __init__(self, model, options, providers):
            self.session = RealSession(model, options, providers=["CPUExecutionProvider"])
            ((self.provider, asked["options"]),) = providers
            asked["mem_pattern"] = options.enable_mem_pattern

        def get_providers(self):
            return ["CPUExecutionProvider"] if self.falls_back else [self.provider, "CPUExecutionProvider"]

        def __getattr__(self, name):
            return getattr(self.session, name)

    def place(array, device="cpu", number=0):
        asked["devices"].add(device)
        return real_value(array)

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [*OFFERED, "CPUExecutionProvider"])
    monkeypatch.setattr(onnxruntime, "InferenceSession", Session)
    monkeypatch.setattr(onnxruntime.OrtValue, "ortvalue_from_numpy", staticmethod(place))
    asked["session"] = Session
    return asked


@pytest.mark.parametrize("name", NAMES)
def test_a_provider_is_chosen_by_its_name_and_by_no_other(machine, toy_folder, name):
    texture = load(toy_folder, provider=name)
    assert texture.provider == NAMES[name]
    assert texture.provider_note == ""
    reference = load(toy_folder, provider="cpu")
    assert np.array_equal(texture.grid((3, 30, 40), 2), reference.grid((3, 30, 40), 2))


def test_a_provider_that_computes_elsewhere_is_not_offered(monkeypatch, toy_folder):
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["AzureExecutionProvider", "CPUExecutionProvider"])
    assert list(available_providers()) == ["cpu"]
    with pytest.raises(ProviderError, match=r"has: cpu;"):
        load(toy_folder, provider="azure")


def test_float32_is_float32(machine, toy_folder):
    load(toy_folder, provider="cuda")
    assert machine["options"] == {"use_tf32": 0}
    load(toy_folder, provider="openvino")
    assert machine["options"]["precision"] == "FP32"


def test_a_device_runs_one_chunk_at_a_time_and_no_more_threads_than_it_may(machine, toy_folder, monkeypatch):
    running, most = [], []

    def run(self, binding):
        running.append(1)
        most.append(len(running))
        time.sleep(0.01)
        self.session.run_with_iobinding(binding)
        running.pop()

    monkeypatch.setattr(machine["session"], "run_with_iobinding", run, raising=False)
    monkeypatch.setattr(onnx_engine, "DEVICE_CHUNK", 64)
    load(toy_folder, provider="directml", threads=4).grid((2, 16, 16))
    assert len(most) == 8
    assert max(most) == 1
    load(toy_folder, provider="openvino")
    assert machine["options"]["num_of_threads"] == usable_threads()


def test_inputs_are_placed_on_the_device_once_and_chunks_are_large(machine, toy_folder):
    texture = load(toy_folder, provider="cuda")
    texture.grid((1, 8, 8))
    assert machine["devices"] == {"cuda"}
    machine["devices"].clear()
    texture.grid((1, 8, 8))
    assert machine["devices"] == set()
    (task,) = texture._instance(texture.tiling((1, 1, 1)), 0).grid_tasks(
        *[np.zeros(40)] * 3, np.empty((40, 40, 40, 3), np.float32)
    )
    assert task


def test_directml_gets_the_options_that_it_requires(machine, toy_folder):
    load(toy_folder, provider="directml").grid((1, 2, 2))
    assert machine["mem_pattern"] is False
    assert machine["devices"] == {"dml"}


def test_a_session_that_falls_back_is_an_error(machine, toy_folder):
    machine["session"].falls_back = True
    with pytest.raises(ProviderError, match="fell back to CPUExecutionProvider"):
        load(toy_folder, provider="cuda")


def test_auto_prefers_the_kernel_and_never_picks_a_device(machine, toy_folder, monkeypatch):
    monkeypatch.setenv("SOLIDGRAIN_KERNEL", "off")
    assert load(toy_folder).provider == "CPUExecutionProvider"
    monkeypatch.delenv("SOLIDGRAIN_KERNEL")
    assert load(toy_folder).provider.startswith(("kernel:", "CPU"))


@pytest.mark.parametrize("name", ["rocket", "tensorrt", ""])
def test_a_provider_that_cannot_be_had_is_refused_with_the_others(machine, toy_folder, name):
    with pytest.raises(
        ProviderError, match=r"expected auto, kernel, or one that onnxruntime .* has: cuda, dml, coreml, openvino, cpu"
    ):
        load(toy_folder, provider=name)
