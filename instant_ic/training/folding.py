"""Decoder stages computed at half resolution: the same depth in less time.

A stage doubles each pixel and then applies a 3x3 convolution. Of the nine neighbours in the doubled map only four
differ. Convolving the small map once per phase (two or four output pixels per input pixel) and interleaving the results
therefore gives the same numbers (Shi et al., "Real-time single image and video super-resolution using an efficient
sub-pixel convolutional neural network", CVPR 2016). The network's last and largest maps are then never padded, copied
or reordered.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn
from torch.nn import functional

from instant_ic.training.slicenet import ConvStage, SliceNet, wrapped_conv


class FoldedStage(nn.Module):
    """Equivalent of a widening :class:`ConvStage` with one kernel per phase; for inference only."""

    def __init__(self, stage: ConvStage) -> None:
        super().__init__()
        conv, norm, prelu = stage.layers.get_submodule("0.1"), stage.layers[1], stage.layers[2]
        assert isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d) and isinstance(prelu, nn.PReLU)
        self.upscale = stage.upscale
        kernels = fold_kernel(conv.weight.detach(), stage.upscale)
        count = kernels.shape[0] // conv.out_channels
        self.layers = nn.Sequential(
            wrapped_conv(conv.in_channels, kernels.shape[0], 3),
            nn.BatchNorm2d(kernels.shape[0]),
            nn.PReLU(kernels.shape[0]),
        )
        state = {f"1.{key}": value for key, value in norm.state_dict().items() if value.ndim}
        state |= {"0.1.bias": conv.bias, "2.weight": prelu.weight}
        repeated = {key: value.detach().repeat_interleave(count) for key, value in state.items()}
        self.layers.load_state_dict(
            {**repeated, "0.1.weight": kernels, "1.num_batches_tracked": norm.num_batches_tracked}, strict=True
        )

    def forward(self, x: Tensor) -> Tensor:
        y = self.layers(x)
        if self.upscale == (2, 2):
            return functional.pixel_shuffle(y, 2)
        batch, channels, height, width = y.shape
        y = y.view(batch, channels // 2, 2, height, width)
        return y.transpose(2, 3).reshape(batch, channels // 2, 2 * height, width)


def fold_kernel(kernel: Tensor, upscale: tuple[int, int]) -> Tensor:
    """Return the kernel (n O, I, 3, 3) for the small map of one (O, I, 3, 3) for the doubled map; n = 2 or 4 phases.

    Along a doubled axis the even pixel has the small map's taps (w0, w1 + w2, 0), the odd one (0, w0 + w1, w2).
    """
    phases = [kernel]
    for axis in (2, 3):
        if upscale[axis - 2] == 2:
            phases = [half for part in phases for half in _halves(part, axis)]
    return torch.stack(phases, dim=1).flatten(0, 1)


def _halves(kernel: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    first, middle, last = kernel.unbind(axis)
    nothing = torch.zeros_like(first)
    return torch.stack((first, middle + last, nothing), axis), torch.stack((nothing, first + middle, last), axis)


def fold_upsampling(model: SliceNet) -> SliceNet:
    """Copy in evaluation mode with folded widening decoder stages; the depth differs by rounding only."""
    folded = copy.deepcopy(model).eval()
    for index, stage in enumerate(folded.decoder):
        assert isinstance(stage, ConvStage)
        folded.decoder[index] = FoldedStage(stage)
    return folded.eval()
