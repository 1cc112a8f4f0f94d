"""ONNX Runtime sessions: threads from the processor affinity, and the execution provider that was asked for or an error."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from solidgrain.runtime.errors import BundleError, ProviderError
from solidgrain.runtime.noise import RESOLUTION
from solidgrain.runtime.texture_file import TextureData
from solidgrain.runtime.workers import usable_threads

if TYPE_CHECKING:
    import onnxruntime

SUFFIX = "ExecutionProvider"
REMOTE = "AzureExecutionProvider"  # calls services, and leaves every other node of a graph to the CPU
ALIASES = {"directml": "dml"}
DEVICES = {"CUDAExecutionProvider": "cuda", "TensorrtExecutionProvider": "cuda", "DmlExecutionProvider": "dml"}


def available_providers() -> dict[str, str]:
    """The providers that this ONNX Runtime can really use: full names by short ones, such as "cpu" and "cuda"."""
    import onnxruntime

    names = [name for name in onnxruntime.get_available_providers() if name.endswith(SUFFIX) and name != REMOTE]
    return {name.removesuffix(SUFFIX).lower(): name for name in names}


def provider_options(full_name: str) -> dict[str, Any]:
    """Float32 means float32, since TF32 and bfloat16 cost visible precision; and no more threads than the process may use."""
    if full_name == "OpenVINOExecutionProvider":
        return {"device_type": "CPU", "precision": "FP32", "num_of_threads": usable_threads()}
    return {"use_tf32": 0} if full_name == "CUDAExecutionProvider" else {}


def memory_device(full_name: str) -> str:
    """Where a provider wants its inputs, as ONNX Runtime names devices: "cuda", "dml", or "cpu" for all others."""
    return DEVICES.get(full_name, "cpu")


def check_inputs(session: onnxruntime.InferenceSession, texture: TextureData, path: Path) -> None:
    """Raises BundleError if a graph does not take a texture of these shapes."""
    found = {node.name: list(node.shape) for node in session.get_inputs()}
    octaves = len(texture.transforms)
    expected = {name: list(array.shape) for name, array in texture.arrays().items()}
    expected |= {"offsets": [octaves, 3], "lattice": [octaves, 3, 3], "noise": [octaves, *[RESOLUTION] * 3]}
    wrong = [name for name, shape in expected.items() if found.get(name) != shape]
    if wrong or "points" not in found or [node.name for node in session.get_outputs()] != ["rgb"]:
        named = wrong[0] if wrong else "points or rgb"
        raise BundleError(f"{path}: not a sampler for this texture ({named} is {found.get(named)}); export the bundle again")


def open_session(path: Path, provider: str) -> onnxruntime.InferenceSession:
    """A session on one graph, running on the named provider and on no other.

    One thread per run: chunks run side by side, which needs no synchronisation inside the graph. Raises
    ProviderError if the provider cannot be had, BundleError if the graph cannot be loaded.
    """
    import onnxruntime

    offered = available_providers()
    full_name = offered.get(ALIASES.get(provider, provider))
    if full_name is None:
        raise ProviderError(
            f"provider {provider!r}: expected auto, kernel, or one that onnxruntime {onnxruntime.__version__} has: "
            f"{', '.join(offered)}; for others install the matching onnxruntime package (and only one of them)"
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    if full_name == "DmlExecutionProvider":  # documented requirement of DirectML
        options.enable_mem_pattern = False
    options.log_severity_level = 3  # errors; they arrive as exceptions as well
    try:
        session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=[(full_name, provider_options(full_name))])
    except Exception as error:  # ONNX Runtime raises types of its own, without a common base
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise BundleError(f"{path}: ONNX Runtime cannot load the graph ({reason}); export the bundle again") from error
    if session.get_providers()[0] != full_name:
        raise ProviderError(f"provider {provider!r}: onnxruntime fell back to {session.get_providers()[0]}; see its log")
    return session
