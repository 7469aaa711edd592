"""The network: published names and shapes, geometry of a panorama, checkpoints."""

import os
import pickle
from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from instant_ic.training.slicenet import (
    CheckpointError,
    CircularPad,
    Contraction,
    SliceNet,
    SliceNetConfig,
    load_checkpoint,
)

TINY = SliceNetConfig(backbone="resnet18", height=64, width_multiplier=0.125, lstm_hidden=16)
KEYS = Path(__file__).resolve().parents[2].parent / "shared" / "facts" / "slicenet_keys.txt"


def norm(name: str, channels: int) -> dict[str, tuple[int, ...]]:
    parts = ("weight", "bias", "running_mean", "running_var")
    return {f"{name}.{part}": (channels,) for part in parts} | {f"{name}.num_batches_tracked": ()}


def stage(name: str, inputs: int, outputs: int) -> dict[str, tuple[int, ...]]:
    conv = {f"{name}.layers.0.1.weight": (outputs, inputs, 3, 3), f"{name}.layers.0.1.bias": (outputs,)}
    return conv | norm(f"{name}.layers.1", outputs) | {f"{name}.layers.2.weight": (outputs,)}


def published_keys(full_size: bool = True) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the authors' ResNet-50 checkpoints, written out without the network under test."""
    root = "feature_extractor.encoder"
    keys = {f"{root}.conv1.1.weight": (64, 3, 7, 7)} | norm(f"{root}.bn1", 64)
    inputs = 64
    for level, (blocks, planes) in enumerate(((3, 64), (4, 128), (6, 256), (3, 512)), start=1):
        for block in range(blocks):
            name = f"{root}.layer{level}.{block}"
            keys |= {f"{name}.conv1.weight": (planes, inputs, 1, 1)} | norm(f"{name}.bn1", planes)
            keys |= {f"{name}.conv2.1.weight": (planes, planes, 3, 3)} | norm(f"{name}.bn2", planes)
            keys |= {f"{name}.conv3.weight": (4 * planes, planes, 1, 1)} | norm(f"{name}.bn3", 4 * planes)
            if block == 0:
                keys |= {f"{name}.downsample.0.weight": (4 * planes, inputs, 1, 1)}
                keys |= norm(f"{name}.downsample.1", 4 * planes)
            inputs = 4 * planes
    for level, channels in enumerate((256, 512, 1024, 2048)):
        for part in range(3):
            wide, narrow = channels // 2**part, channels // 2 ** (part + 1)
            keys |= stage(f"slicing_module.slc_lst.{level}.layer.{part}", wide, narrow)
    for layer, features in enumerate((2048 if full_size else 1024, 1024)):
        for way in ("", "_reverse"):
            keys |= {
                f"bi_rnn.weight_ih_l{layer}{way}": (2048, features),
                f"bi_rnn.weight_hh_l{layer}{way}": (2048, 512),
            }
            keys |= {f"bi_rnn.bias_{part}_l{layer}{way}": (2048,) for part in ("ih", "hh")}
    inputs = 1024
    for index in range(9 if full_size else 8):
        last = index == (8 if full_size else 7)
        outputs = 1 if last else max(4, inputs // 2)
        keys |= stage(f"decoder.{index}", inputs, outputs)
        inputs = outputs
    return keys


def names_and_shapes(model: SliceNet) -> list[str]:
    return [f"{key} {tuple(value.shape)}" for key, value in model.state_dict().items()]


@pytest.fixture(scope="module")
def published() -> SliceNet:
    with torch.device("meta"):  # shapes only: 80 million parameters need no memory
        return SliceNet(SliceNetConfig())


def test_published_names_and_shapes(published: SliceNet) -> None:
    lines = [f"{key} {shape}" for key, shape in published_keys().items()]
    assert len(lines) == 502
    assert sorted(names_and_shapes(published)) == sorted(lines)
    assert sum(p.numel() for p in published.parameters()) == 79_511_672
    with torch.device("meta"):
        half = SliceNet(SliceNetConfig(height=256))
    assert sorted(names_and_shapes(half)) == sorted(f"{key} {shape}" for key, shape in published_keys(False).items())


@pytest.mark.real_data
@pytest.mark.skipif(not KEYS.is_file(), reason="the list of published keys is not beside the checkout")
def test_published_names_line_by_line(published: SliceNet) -> None:
    lines = KEYS.read_text().splitlines()
    assert names_and_shapes(published) == lines
    assert sorted(f"{key} {shape}" for key, shape in published_keys().items()) == sorted(lines)


def test_output_of_wider_columns_has_the_input_size() -> None:
    config = SliceNetConfig(backbone="resnet50", height=64, width_multiplier=0.125, lstm_hidden=16, column_stride=4)
    with torch.inference_mode():
        assert SliceNet(config).eval()(torch.zeros(2, 3, 64, 128)).shape == (2, 64, 128)


def test_circular_pad_by_hand() -> None:
    row = torch.arange(4.0).view(1, 1, 1, 4)
    assert CircularPad(1)(row).flatten().tolist() == [3, 0, 1, 2, 3, 0]


def test_contraction_turns_with_the_panorama() -> None:
    # Everything up to the LSTM is circular: turning by a whole feature column turns the result by as much.
    level = Contraction(16).eval()
    x = torch.randn(1, 16, 8, 8, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        straight, turned = level(x, 32), level(x.roll(3, -1), 32)
    assert straight.shape == (1, 2, 32)
    torch.testing.assert_close(turned, straight.roll(12, -1))


def test_own_checkpoint_loads_strictly(tmp_path: Path) -> None:
    model = SliceNet(TINY).eval()
    path = tmp_path / "tiny.pt"
    torch.save({"config": asdict(TINY), "state_dict": model.state_dict()}, path)
    loaded = load_checkpoint(path)
    picture = torch.rand(1, 3, 64, 128)
    with torch.inference_mode():
        assert torch.equal(loaded(picture), model(picture))


def random_state(keys: dict[str, tuple[int, ...]]) -> dict[str, torch.Tensor]:
    """Random numbers, one for each output channel, so that 75 million parameters make a small file."""
    generator = torch.Generator().manual_seed(0)
    return {
        key: torch.rand((shape[0], *[1] * len(shape[1:])), generator=generator).expand(shape)
        if shape
        else torch.tensor(7)
        for key, shape in keys.items()
    }


def test_published_layout_loads_strictly(tmp_path: Path) -> None:
    state = random_state(published_keys())
    path = tmp_path / "resnet50.pth"
    torch.save({"kwargs": {"backbone": "resnet50", "full_size": True}, "state_dict": state}, path)
    model = load_checkpoint(path)
    assert (model.config.height, model.training) == (512, False)
    assert model.mean.flatten().tolist() == pytest.approx([0.485, 0.456, 0.406])
    loaded = model.state_dict()
    assert all(torch.equal(loaded[key], value) for key, value in state.items())


def tiny_checkpoint(path: Path, **changes: object) -> Path:
    """A checkpoint of ours with another value for a key of the file, or of its state (None: left out)."""
    state = SliceNet(TINY).state_dict()
    payload: dict[str, object] = {"config": asdict(TINY), "state_dict": state}
    for key, value in changes.items():
        target = payload if key in ("config", "kwargs", "state_dict") else state
        target.pop(key.replace("__", "."), None)
        if value is not None:
            target[key.replace("__", ".")] = value
    torch.save(payload, path)
    return path


class Evil:
    def __reduce__(self) -> tuple[object, ...]:
        return os.system, ("exit 3",)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bi_rnn__weight_ih_l0": None}, r"Missing key.*bi_rnn\.weight_ih_l0"),
        ({"extra": torch.zeros(1)}, r"Unexpected key.*extra"),
        ({"bi_rnn__bias_ih_l0": torch.zeros(3)}, r"size mismatch for bi_rnn\.bias_ih_l0"),
        ({"state_dict": [1]}, "not a checkpoint of SliceNet"),
        ({"config": None}, "not a checkpoint of SliceNet"),
        ({"config": {"backbone": "vgg"}}, "backbone must be one of"),
        ({"config": {"height": 200}}, "height must be a power of two"),
        ({"config": Evil()}, "not a torch checkpoint of tensors and plain values"),
    ],
)
def test_what_does_not_fit_is_told(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    path = tiny_checkpoint(tmp_path / "tiny.pt", **changes)
    with pytest.raises(CheckpointError, match=rf"(?s){message}") as caught:
        load_checkpoint(path)
    assert str(path) in str(caught.value)


def test_what_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="No such file"):
        load_checkpoint(tmp_path / "absent.pt")
    path = tmp_path / "x.pt"
    for content in (b"<html>404 not found", pickle.dumps(Evil())):
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match="not a torch checkpoint"):
            load_checkpoint(path)
    torch.save([1, 2], path)
    with pytest.raises(CheckpointError, match="not a checkpoint of SliceNet"):
        load_checkpoint(path)


def test_damage_anywhere_is_seen(tmp_path: Path) -> None:
    path = tiny_checkpoint(tmp_path / "tiny.pt")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(path)
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 1  # one bit of some weight
    path.write_bytes(flipped)
    with pytest.raises(CheckpointError, match="does not match"):
        load_checkpoint(path)
