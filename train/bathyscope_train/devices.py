"""Which device trains, and in what precision."""

import torch

from bathyscope.errors import SettingsError


def choose_device(wanted: str, *, workers: int = 1) -> torch.device:
    """The device for ``cpu``, ``cuda`` or ``auto``, which takes cuda where there is one and one worker trains.

    Raises:
        SettingsError: If cuda is asked for where there is none.
    """
    present = torch.cuda.is_available()
    if wanted == "cuda" and not present:
        raise SettingsError(
            "device cuda was asked for, but torch finds none; say device=cpu, or install torch for CUDA"
        )
    return torch.device("cuda" if wanted == "cuda" or (wanted == "auto" and present and workers == 1) else "cpu")


def use_bfloat16(precision: str, device: torch.device | None = None) -> bool:
    """Whether the transformer runs in bfloat16; ``auto`` says so where the device multiplies matrices in it.

    On a CPU these are matrix units (AMX); without them bfloat16 is many times slower than float32.
    """
    if precision != "auto":
        return precision == "bfloat16"
    if device is not None and device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    return torch.cpu._is_amx_tile_supported()
