"""SliceNet: depth of an equirect panorama from a sequence of vertical slices.

Pintore et al., "SliceNet: deep dense depth estimation from a single indoor panorama using a slice-based
representation", CVPR 2021. A panorama of a levelled camera has gravity along its columns. The network therefore folds
the features of a column into one vector, runs an LSTM over the columns, and unfolds each column again in a decoder.

The full-size ResNet-50 model has the published parameter names and shapes, so published checkpoints load
(:func:`load_checkpoint`). :class:`SliceNetConfig` describes smaller variants.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

BACKBONES: dict[str, tuple[bool, tuple[int, int, int, int]]] = {
    # name: (bottleneck blocks?, blocks per stage)
    "resnet18": (False, (2, 2, 2, 2)),
    "resnet34": (False, (3, 4, 6, 3)),
    "resnet50": (True, (3, 4, 6, 3)),
}
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class CheckpointError(ValueError):
    """A checkpoint file does not hold a loadable SliceNet model."""


@dataclass(frozen=True)
class SliceNetConfig:
    """Shape of the network.

    Attributes:
        backbone: ``resnet18``, ``resnet34`` or ``resnet50``.
        height: rows of the input; a power of two, 64 or more. The width is twice that.
        width_multiplier: share of the usual ResNet channels; 1.0 in the published model.
        lstm_hidden: LSTM features per direction; 512 in the published model.
        column_stride: the LSTM runs on every n-th column (1, 2, 4) and the last decoder stages also double the width; 1
            in the published model.
        decoder_floor: minimum number of channels inside the decoder; 4 in the published model.
    """

    backbone: str = "resnet50"
    height: int = 512
    width_multiplier: float = 1.0
    lstm_hidden: int = 512
    column_stride: int = 1
    decoder_floor: int = 4

    def __post_init__(self) -> None:
        if self.backbone not in BACKBONES:
            raise ValueError(f"backbone must be one of {', '.join(BACKBONES)} (got {self.backbone!r})")
        if self.height < 64 or self.height & (self.height - 1):
            raise ValueError(f"height must be a power of two, 64 or more (got {self.height})")
        if self.column_stride not in (1, 2, 4):
            raise ValueError(f"column_stride must be 1, 2 or 4 (got {self.column_stride})")

    @property
    def width(self) -> int:
        """Columns of the input: twice its rows."""
        return 2 * self.height

    @property
    def base_channels(self) -> int:
        """Channels after the stem, a multiple of 8 so that each contraction to an eighth is an integer."""
        return max(8, round(64 * self.width_multiplier / 8) * 8)


class CircularPad(nn.Module):
    """Pads the width with columns from the opposite edge: the panorama has no left and right border."""

    def __init__(self, columns: int) -> None:
        super().__init__()
        self.columns = columns

    def forward(self, x: Tensor) -> Tensor:
        """Pad (B, C, H, W) to (B, C, H, W + 2 columns)."""
        # Slices and a concatenation export to plain ONNX operators.
        return torch.cat((x[..., -self.columns :], x, x[..., : self.columns]), dim=-1)


def wrapped_conv(
    inputs: int, outputs: int, kernel: int, stride: int | tuple[int, int] = 1, bias: bool = True
) -> nn.Sequential:
    """Return a convolution that is circular in width and zero-padded in height."""
    pad = kernel // 2
    conv = nn.Conv2d(inputs, outputs, kernel, stride=stride, padding=(pad, 0), bias=bias)
    return nn.Sequential(CircularPad(pad), conv)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions (ResNet-18 and -34)."""

    expansion = 1

    def __init__(self, inputs: int, planes: int, stride: int, downsample: nn.Module | None) -> None:
        super().__init__()
        self.conv1 = wrapped_conv(inputs, planes, 3, stride, bias=False)
        self.bn1 = nn.BatchNorm2d(planes)
        self.conv2 = wrapped_conv(planes, planes, 3, bias=False)
        self.bn2 = nn.BatchNorm2d(planes)
        self.downsample = downsample

    def forward(self, x: Tensor) -> Tensor:
        y = functional.relu(self.bn1(self.conv1(x)))
        y = self.bn2(self.conv2(y))
        return functional.relu(y + (x if self.downsample is None else self.downsample(x)))


class Bottleneck(nn.Module):
    """1x1, 3x3 (with the stride), 1x1 (ResNet-50)."""

    expansion = 4

    def __init__(self, inputs: int, planes: int, stride: int, downsample: nn.Module | None) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, planes, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(planes)
        self.conv2 = wrapped_conv(planes, planes, 3, stride, bias=False)
        self.bn2 = nn.BatchNorm2d(planes)
        self.conv3 = nn.Conv2d(planes, planes * self.expansion, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(planes * self.expansion)
        self.downsample = downsample

    def forward(self, x: Tensor) -> Tensor:
        y = functional.relu(self.bn1(self.conv1(x)))
        y = functional.relu(self.bn2(self.conv2(y)))
        y = self.bn3(self.conv3(y))
        return functional.relu(y + (x if self.downsample is None else self.downsample(x)))


class ResNetEncoder(nn.Module):
    """ResNet without its pooled head; circular in width except for the max-pool."""

    def __init__(self, config: SliceNetConfig) -> None:
        super().__init__()
        bottleneck, blocks = BACKBONES[config.backbone]
        block = Bottleneck if bottleneck else BasicBlock
        base = config.base_channels
        self.conv1 = wrapped_conv(3, base, 7, 2, bias=False)
        self.bn1 = nn.BatchNorm2d(base)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        self.channels: list[int] = []
        inputs = base
        for level, count in enumerate(blocks):
            planes = base * 2**level
            outputs = planes * block.expansion
            layers: list[nn.Module] = []
            for index in range(count):
                stride = 2 if level > 0 and index == 0 else 1
                downsample = None
                if stride != 1 or inputs != outputs:
                    downsample = nn.Sequential(
                        nn.Conv2d(inputs, outputs, 1, stride=stride, bias=False), nn.BatchNorm2d(outputs)
                    )
                layers.append(block(inputs, planes, stride, downsample))
                inputs = outputs
            self.add_module(f"layer{level + 1}", nn.Sequential(*layers))
            self.channels.append(outputs)

    def forward(self, x: Tensor) -> list[Tensor]:
        """Return the features of images (B, 3, H, W) at 1/4, 1/8, 1/16 and 1/32."""
        x = self.maxpool(functional.relu(self.bn1(self.conv1(x))))
        levels = []
        for level in range(4):
            x = self.get_submodule(f"layer{level + 1}")(x)
            levels.append(x)
        return levels


class ConvStage(nn.Module):
    """Circular 3x3 convolution, batch norm, PReLU with a slope per channel; optionally doubles the size first."""

    def __init__(
        self, inputs: int, outputs: int, stride: tuple[int, int] = (1, 1), upscale: tuple[int, int] = (1, 1)
    ) -> None:
        super().__init__()
        self.upscale = upscale
        self.layers = nn.Sequential(
            wrapped_conv(inputs, outputs, 3, stride), nn.BatchNorm2d(outputs), nn.PReLU(outputs)
        )

    def forward(self, x: Tensor) -> Tensor:
        if self.upscale != (1, 1):
            scale = (float(self.upscale[0]), float(self.upscale[1]))
            x = functional.interpolate(x, scale_factor=scale, mode="nearest")
        return self.layers(x)


class Contraction(nn.Module):
    """Folds the height of one encoder level: three strided stages, height and channels to an eighth."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        sizes = (channels, channels // 2, channels // 4, channels // 8)
        self.layer = nn.Sequential(*(ConvStage(a, b, (2, 1)) for a, b in pairwise(sizes)))

    def forward(self, x: Tensor, columns: int) -> Tensor:
        """Fold (B, C, H, W) to (B, C/8 * H/8, columns)."""
        x = self.layer(x)
        height, width = x.shape[-2:]
        if columns != width:
            # One column from the opposite edge on each side makes the interpolation circular.
            factor = columns // width
            x = torch.cat((x[..., -1:], x, x[..., :1]), dim=-1)
            size = (height, columns + 2 * factor)
            x = functional.interpolate(x, size=size, mode="bilinear", align_corners=False)
            x = x[..., factor:-factor]
        return x.flatten(1, 2)


class SliceNet(nn.Module):
    """Network from RGB (B, 3, H, 2H) in 0..1 to radial depth in metres (B, H, 2H), unclamped.

    Example:
        >>> model = SliceNet(SliceNetConfig(backbone="resnet18", height=64, lstm_hidden=16)).eval()
        >>> model(torch.zeros(1, 3, 64, 128)).shape
        torch.Size([1, 64, 128])
    """

    mean: Tensor
    std: Tensor

    def __init__(self, config: SliceNetConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or SliceNetConfig()
        encoder = ResNetEncoder(config)
        channels = encoder.channels
        # The dictionaries give the parameters their published names.
        self.feature_extractor = nn.ModuleDict({"encoder": encoder})
        contractions = nn.ModuleList(Contraction(count) for count in channels)
        self.slicing_module = nn.ModuleDict({"slc_lst": contractions})
        features = sum(
            (count // 8) * _contracted_height(config.height // 4 // 2**level) for level, count in enumerate(channels)
        )
        self.bi_rnn = nn.LSTM(features, config.lstm_hidden, num_layers=2, bidirectional=True)
        self.decoder = nn.ModuleList(_decoder_stages(config))
        # Not persistent: the published state has no such keys.
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        levels = self.feature_extractor["encoder"]((x - self.mean) / self.std)
        columns = self.config.width // self.config.column_stride
        contractions = enumerate(self.slicing_module["slc_lst"].children())
        # One feature vector for each column: (B, features, columns).
        features = torch.cat([part(levels[level], columns) for level, part in contractions], dim=1)
        sequence, _ = self.bi_rnn(features.permute(2, 0, 1))  # (columns, B, 2 hidden)
        y = sequence.permute(1, 2, 0).unsqueeze(2)  # (B, 2 hidden, 1, columns)
        for stage in self.decoder:
            y = stage(y)
        return y.squeeze(1)


def _contracted_height(height: int) -> int:
    """Return the rows after three stages of stride 2 with a padded 3x3 kernel."""
    for _ in range(3):
        height = (height + 1) // 2
    return height


def _decoder_stages(config: SliceNetConfig) -> list[ConvStage]:
    count = config.height.bit_length() - 1
    widening = config.column_stride.bit_length() - 1
    stages = []
    inputs = 2 * config.lstm_hidden
    for index in range(count):
        last = index == count - 1
        outputs = 1 if last else max(config.decoder_floor, inputs // 2)
        upscale = (2, 2) if index >= count - widening else (2, 1)
        stages.append(ConvStage(inputs, outputs, upscale=upscale))
        inputs = outputs
    return stages


def load_checkpoint(path: str | Path) -> SliceNet:
    """Load one of our checkpoints (``config``, ``state_dict``) or a published one (``kwargs``, ``state_dict``).

    Raises:
        CheckpointError: the file is not such a checkpoint, or its tensors do not fit the network it names.
    """
    payload = read_checkpoint(Path(path))
    try:
        if "config" in payload:
            config = SliceNetConfig(**payload["config"])
        else:
            options = payload["kwargs"]
            config = SliceNetConfig(options["backbone"], 512 if options.get("full_size", True) else 256)
        model = SliceNet(config)
        load_state(model, payload["state_dict"], path)
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: not a checkpoint of SliceNet with its shape and tensors ({error})") from error
    return model.eval()


def read_checkpoint(path: Path) -> Any:
    """Read a checkpoint to the CPU; only tensors and plain values, so that a file cannot run code.

    Raises:
        CheckpointError: the file is missing, damaged, or holds more.
    """
    try:
        if zipfile.is_zipfile(path):  # torch's format; torch itself does not verify the checksums
            with zipfile.ZipFile(path) as archive:
                if bad := archive.testzip():
                    raise CheckpointError(f"{path}: damaged: the checksum of {bad} does not match")
        return torch.load(path, map_location="cpu", weights_only=True)
    except CheckpointError:
        raise
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # torch.load raises anything from EOFError to RuntimeError
        first = str(error).split("\n")[0]
        text = f"{path}: damaged, or not a torch checkpoint of tensors and plain values ({first})"
        raise CheckpointError(text) from error


def load_state(model: nn.Module, state: dict[str, Tensor], path: str | Path) -> None:
    """Fill a network with the tensors of a checkpoint.

    Raises:
        CheckpointError: tensors are missing, unknown or have another shape; the message lists them.
    """
    try:
        model.load_state_dict(state, strict=True)
    except (RuntimeError, TypeError, AttributeError) as error:
        raise CheckpointError(f"{path}: {error}") from error
