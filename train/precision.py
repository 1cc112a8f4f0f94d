"""Where plain forward passes run in bfloat16."""

from __future__ import annotations

import torch

from solidgrain.train.settings import Settings


def use_bfloat16(settings: Settings, device: torch.device) -> bool:
    """Whether plain forward passes run in bfloat16: unless told so, only where that was measured to be faster.

    AVX-512 BF16 alone, without AMX, takes two thirds of float32's time on AMD's Zen 5 and a sixth more than it on Intel's Xeons
    (docs/training.md).
    """
    if settings.precision != "auto":
        return settings.precision == "bfloat16"
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    return bool(torch.cpu._is_amx_tile_supported()) or _is_amd_with_bfloat16()


def autocast(device: torch.device, reduced: bool) -> torch.autocast:
    """Forward passes inside are in bfloat16, if they are to be at all."""
    return torch.autocast(device.type, torch.bfloat16, enabled=reduced)


def _is_amd_with_bfloat16() -> bool:
    """Whether this processor is AMD's and has AVX-512 BF16; no where torch is too old to tell."""
    capabilities: dict[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
    return str(capabilities.get("cpu_name")).startswith("AMD") and bool(capabilities.get("avx512_bf16"))
