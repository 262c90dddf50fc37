"""Matrices and kernels rounded to what bfloat16 can hold, so that a file of half the size loses nothing more."""

import torch
from torch import Tensor, nn


def round_to_bfloat16(network: nn.Module) -> None:
    """Round matrices and kernels to what bfloat16 can hold; vectors (biases, norms) keep all bits."""
    with torch.no_grad():
        for parameter in network.parameters():
            if parameter.ndim > 1:
                parameter.copy_(parameter.to(torch.bfloat16).to(parameter.dtype))


def halved(tensor: Tensor) -> Tensor:
    """``tensor`` in bfloat16 where that loses nothing, else as it is."""
    half = tensor.to(torch.bfloat16)
    return half if torch.equal(half.to(tensor.dtype), tensor) else tensor
