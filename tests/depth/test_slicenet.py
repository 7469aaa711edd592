"""The network: published names and shapes, geometry of a panorama, checkpoints."""

import hashlib
from pathlib import Path

import pytest
import torch

from instant_ic.depth.slicenet import (
    SMALL,
    CheckpointError,
    CircularPad,
    Contraction,
    SliceNet,
    SliceNetConfig,
    load_checkpoint,
)

TINY = SliceNetConfig(backbone="resnet18", height=64, width_multiplier=0.125, lstm_hidden=16)
KEYS = Path(__file__).resolve().parents[2].parent / "shared" / "facts" / "slicenet_keys.txt"
# SHA-256 over the sorted lines "name shape" of the published ResNet-50 model, 512 x 1024.
KEYS_SHA256 = "f48ab914fb4008517cb50e93d2328b7655f92c78b4f2d21d957df6403a59d7e7"


def names_and_shapes(model: SliceNet) -> list[str]:
    return [f"{key} {tuple(value.shape)}" for key, value in model.state_dict().items()]


@pytest.fixture(scope="module")
def published() -> SliceNet:
    with torch.device("meta"):  # shapes only: 80 million parameters need no memory
        return SliceNet(SliceNetConfig())


def test_published_names_and_shapes(published: SliceNet) -> None:
    lines = names_and_shapes(published)
    assert len(lines) == 502
    assert hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest() == KEYS_SHA256
    assert sum(p.numel() for p in published.parameters()) == 79_511_672


@pytest.mark.skipif(not KEYS.is_file(), reason="the list of published keys is not beside the checkout")
def test_published_names_line_by_line(published: SliceNet) -> None:
    assert names_and_shapes(published) == KEYS.read_text().splitlines()


def test_half_size_has_the_published_sequence(published: SliceNet) -> None:
    with torch.device("meta"):
        half = SliceNet(SliceNetConfig(height=256))
    assert (published.bi_rnn.input_size, half.bi_rnn.input_size) == (2048, 1024)
    assert (len(published.decoder), len(half.decoder)) == (9, 8)


@pytest.mark.parametrize(
    "config",
    [
        TINY,
        SliceNetConfig(backbone="resnet18", height=64, width_multiplier=0.25, lstm_hidden=16, column_stride=4),
        SliceNetConfig(backbone="resnet34", height=128, width_multiplier=0.125, lstm_hidden=8, column_stride=2),
        SliceNetConfig(backbone="resnet50", height=64, width_multiplier=0.125, lstm_hidden=8),
    ],
)
def test_output_has_the_input_size(config: SliceNetConfig) -> None:
    with torch.inference_mode():
        depth = SliceNet(config).eval()(torch.zeros(2, 3, config.height, config.width))
    assert depth.shape == (2, config.height, config.width)


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
    torch.save({"config": TINY.as_dict(), "state_dict": model.state_dict()}, path)
    loaded = load_checkpoint(path)
    picture = torch.rand(1, 3, 64, 128)
    with torch.inference_mode():
        assert torch.equal(loaded(picture), model(picture))


def test_published_layout_loads_strictly(tmp_path: Path, published: SliceNet) -> None:
    # A checkpoint of the published layout, filled with numbers that tell each tensor from the others.
    state = {
        key: torch.full(value.shape, float(index), dtype=value.dtype)
        for index, (key, value) in enumerate(published.state_dict().items())
    }
    path = tmp_path / "resnet50.pth"
    torch.save({"kwargs": {"backbone": "resnet50", "full_size": True}, "state_dict": state}, path)
    loaded = load_checkpoint(path).state_dict()
    assert all(loaded[key].flatten()[0] == index for index, key in enumerate(state))
    del state["bi_rnn.weight_ih_l0"]
    torch.save({"kwargs": {"backbone": "resnet50", "full_size": True}, "state_dict": state}, path)
    with pytest.raises(CheckpointError, match=r"bi_rnn\.weight_ih_l0"):
        load_checkpoint(path)


def test_what_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no such file"):
        load_checkpoint(tmp_path / "absent.pt")
    text = tmp_path / "text.pt"
    text.write_text("not a checkpoint")
    with pytest.raises(CheckpointError, match="not a torch checkpoint"):
        load_checkpoint(text)
    empty = tmp_path / "empty.pt"
    torch.save({"weights": {}}, empty)
    with pytest.raises(CheckpointError, match="no 'state_dict'"):
        load_checkpoint(empty)
    torch.save({"state_dict": {}}, empty)
    with pytest.raises(CheckpointError, match="neither 'config' nor 'kwargs'"):
        load_checkpoint(empty)


def test_configuration_is_checked() -> None:
    with pytest.raises(ValueError, match="backbone"):
        SliceNetConfig(backbone="vgg")
    with pytest.raises(ValueError, match="height"):
        SliceNetConfig(height=200)
    with pytest.raises(ValueError, match="column_stride"):
        SliceNetConfig(column_stride=3)


def test_small_model_is_small() -> None:
    with torch.device("meta"):
        count = sum(p.numel() for p in SliceNet(SMALL).parameters())
    assert count < 5_000_000
