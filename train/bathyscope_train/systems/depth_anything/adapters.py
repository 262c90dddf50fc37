"""Linear layers with few trainable parameters beside frozen ones, and how to merge them away.

=========  =================================================  =========================================
kind       effective weight                                   trains
=========  =================================================  =========================================
``lora``   ``W + s B A``                                      A, B
``dvlora`` ``W + s (V * B) (U * A)``, V and U a factor a row  A, B first; then U, V with A, B frozen
``ssb``    ``diag(B) W diag(A)``                              A, B: one factor an input and one an output
=========  =================================================  =========================================

The bias is never changed. Each starts as the layer that it adapts: B is zero in the low-rank kinds, A and B are one in
``ssb``. Parameters are named as in the published checkpoints (``lora_A`` ...).
"""

import copy
import math
from collections.abc import Callable, Iterator
from typing import Literal, TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

AdapterKind = Literal["lora", "dvlora", "ssb"]
Module = TypeVar("Module", bound=nn.Module)

ENCODER_MLPS = ("mlp.fc1", "mlp.fc2")
"""Endings of the names of the encoder's layers that are adapted."""


class AdaptedLinear(nn.Linear):
    """A linear layer whose weight is adapted; subclasses say how."""

    def effective_weight(self) -> Float[Tensor, "o i"]:
        """The weight of the plain layer that does the same."""
        raise NotImplementedError

    def merged(self) -> nn.Linear:
        """A plain layer with the same outputs."""
        plain = nn.Linear(
            self.in_features,
            self.out_features,
            bias=self.bias is not None,
            device=self.weight.device,
            dtype=self.weight.dtype,
        )
        with torch.no_grad():
            plain.weight.copy_(self.effective_weight())
            if self.bias is not None:
                plain.bias.copy_(self.bias)
        return plain


class LoraLinear(AdaptedLinear):
    """``y = x W^T + b + s (x A^T) B^T``.

    Args:
        inputs: Length of x.
        outputs: Length of y.
        bias: Whether there is a b.
        rank: Rows of A and columns of B.
        scale: The factor s.
    """

    def __init__(self, inputs: int, outputs: int, *, bias: bool = True, rank: int, scale: float) -> None:
        super().__init__(inputs, outputs, bias=bias)
        self.scale = scale
        self.lora_A = nn.Parameter(torch.empty(rank, inputs))
        self.lora_B = nn.Parameter(torch.zeros(outputs, rank))
        nn.init.kaiming_uniform_(self.lora_A, a=math.sqrt(5))

    def factors(self) -> tuple[Float[Tensor, "r i"], Float[Tensor, "o r"]]:
        """What the input is mapped by, then what that is mapped by."""
        return self.lora_A, self.lora_B

    def effective_weight(self) -> Float[Tensor, "o i"]:
        down, up = self.factors()
        return self.weight + self.scale * up @ down

    def forward(self, tokens: Float[Tensor, "*n i"]) -> Float[Tensor, "*n o"]:
        down, up = self.factors()
        return F.linear(tokens, self.weight, self.bias) + self.scale * F.linear(F.linear(tokens, down), up)


class DvLoraLinear(LoraLinear):
    """LoRA whose two factors are scaled row by row: ``y = x W^T + b + s x (U * A)^T (V * B)^T`` (EndoDAC).

    ``lora_U`` (r, 1) and ``lora_V`` (outputs, 1) start at one.
    """

    def __init__(self, inputs: int, outputs: int, *, bias: bool = True, rank: int, scale: float) -> None:
        super().__init__(inputs, outputs, bias=bias, rank=rank, scale=scale)
        self.lora_U = nn.Parameter(torch.ones(rank, 1))
        self.lora_V = nn.Parameter(torch.ones(outputs, 1))

    def factors(self) -> tuple[Float[Tensor, "r i"], Float[Tensor, "o r"]]:
        return self.lora_U * self.lora_A, self.lora_V * self.lora_B


class ScaledLinear(AdaptedLinear):
    """One factor for each input and each output of the weight: ``y = B * ((A * x) W^T) + b`` (EndoDAV's ``ssb``)."""

    def __init__(self, inputs: int, outputs: int, *, bias: bool = True) -> None:
        super().__init__(inputs, outputs, bias=bias)
        self.lora_A = nn.Parameter(torch.ones(inputs, 1))
        self.lora_B = nn.Parameter(torch.ones(outputs, 1))

    def effective_weight(self) -> Float[Tensor, "o i"]:
        return self.lora_B * self.weight * self.lora_A[:, 0]

    def forward(self, tokens: Float[Tensor, "*n i"]) -> Float[Tensor, "*n o"]:
        mapped = F.linear(tokens * self.lora_A[:, 0], self.weight) * self.lora_B[:, 0]
        return mapped if self.bias is None else mapped + self.bias


def adapted(plain: nn.Linear, kind: AdapterKind, *, rank: int = 4, scale: float = 1.0) -> AdaptedLinear:
    """A layer of ``kind`` that computes what ``plain`` does, and takes over its parameters."""
    inputs, outputs, bias = plain.in_features, plain.out_features, plain.bias is not None
    layer: AdaptedLinear
    if kind == "ssb":
        layer = ScaledLinear(inputs, outputs, bias=bias)
    elif kind == "lora":
        layer = LoraLinear(inputs, outputs, bias=bias, rank=rank, scale=scale)
    else:
        layer = DvLoraLinear(inputs, outputs, bias=bias, rank=rank, scale=scale)
    layer.weight, layer.bias = plain.weight, plain.bias
    return layer.to(plain.weight)


def replace_linears(module: nn.Module, replace: Callable[[str, nn.Linear], nn.Linear]) -> None:
    """Give every linear layer below ``module``, with its dotted name, to ``replace`` and put there what it answers."""
    for name, layer in list(module.named_modules()):
        if isinstance(layer, nn.Linear):
            parent, _, leaf = name.rpartition(".")
            setattr(module.get_submodule(parent), leaf, replace(name, layer))


def adapt(module: nn.Module, names: tuple[str, ...], kind: AdapterKind, *, rank: int = 4, scale: float = 1.0) -> None:
    """Adapt, in place, every linear layer below ``module`` whose dotted name ends in one of ``names``."""
    replace_linears(
        module,
        lambda name, layer: adapted(layer, kind, rank=rank, scale=scale) if name.endswith(names) else layer,
    )


def merge_adapters(module: Module) -> Module:
    """A copy of ``module`` without adapters and with the same outputs; what is exported and served."""
    plain = copy.deepcopy(module)
    replace_linears(plain, lambda _, layer: layer.merged() if isinstance(layer, AdaptedLinear) else layer)
    return plain


def adapter_parameters(module: nn.Module, names: str = "ABUV") -> Iterator[nn.Parameter]:
    """The adapters' parameters below ``module``: those called ``lora_`` and one of the letters ``names``."""
    for layer in module.modules():
        if isinstance(layer, AdaptedLinear):
            yield from (value for name, value in layer.named_parameters() if name[:5] == "lora_" and name[5:] in names)
