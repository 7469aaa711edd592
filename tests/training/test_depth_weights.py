"""Weights to begin with: back from ONNX, and batch norms made whole again."""

import copy
import hashlib
import json
from pathlib import Path

import pytest
import torch
from torch import nn

from instant_ic.training.export import export_onnx
from instant_ic.training.slicenet import CheckpointError, SliceNet, SliceNetConfig
from instant_ic.training.weights import Start, load_start, unfold_norms

TINY = SliceNetConfig(backbone="resnet18", height=64, width_multiplier=0.125, lstm_hidden=8, column_stride=2,
                      decoder_floor=8)  # fmt: skip


@pytest.fixture(scope="module")
def model() -> SliceNet:
    torch.manual_seed(3)
    model = SliceNet(TINY).eval()
    for module in model.modules():  # as if it had been trained
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.running_mean, -0.3, 0.3), nn.init.uniform_(module.running_var, 0.5, 2.0)
            nn.init.uniform_(module.weight, 0.5, 1.5), nn.init.uniform_(module.bias, -0.3, 0.3)
        if isinstance(module, nn.PReLU):
            nn.init.uniform_(module.weight, 0.05, 0.4)
    nn.init.constant_(model.decoder[-1].get_submodule("layers.1").bias, 3.0)
    return model


@pytest.fixture(scope="module")
def start(file: Path) -> Start:
    return load_start(file, TINY)


@pytest.fixture(scope="module")
def file(model: SliceNet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("r") / "tiny.onnx"
    export_onnx(model, path, half_weights=True)
    return path


torch.set_num_threads(1)  # tiny layers: threads would wait for each other
PICTURES = torch.rand(2, 3, 64, 128, generator=torch.Generator().manual_seed(0))


def test_exported_weights_come_back(model: SliceNet, file: Path, start: Start) -> None:
    assert start.folded
    assert start.origin == {"file": "tiny.onnx", "sha256": hashlib.sha256(file.read_bytes()).hexdigest()}
    with torch.inference_mode():
        expected, got = model(PICTURES), start.model(PICTURES)
    assert (got - expected).abs().max() < 5e-3 * expected.abs().max()
    for name in ("bi_rnn.weight_ih_l1_reverse", "bi_rnn.weight_hh_l0"):  # not folded into anything: float16 alone
        torch.testing.assert_close(start.model.state_dict()[name], model.state_dict()[name].half().float())


def test_record_beside_the_file_goes_along(file: Path) -> None:
    file.with_suffix(".json").write_text(json.dumps({"steps": 7}))
    assert load_start(file, TINY).origin["record"] == {"steps": 7}
    file.with_suffix(".json").unlink()


def test_unfolding_changes_no_depth_and_steadies_the_training(start: Start) -> None:
    folded, whole = copy.deepcopy(start.model), copy.deepcopy(start.model)
    with torch.inference_mode():
        before = folded(PICTURES)
        broken = folded.train()(PICTURES)  # batch statistics, as in training
        unfold_norms(whole, PICTURES)
        after, steady = whole(PICTURES), whole.train()(PICTURES)
    scale = before.abs().max()
    assert (after - before).abs().max() < 1e-4 * scale
    assert (steady - before).abs().max() < 1e-3 * scale < 0.1 * (broken - before).abs().max()


def test_checkpoints_of_the_same_network_are_taken(model: SliceNet, tmp_path: Path) -> None:
    torch.save({"config": TINY.as_dict(), "state_dict": model.state_dict(), "record": {"steps": 9}}, tmp_path / "a.pt")
    start = load_start(tmp_path / "a.pt", TINY)
    assert not start.folded and start.origin["record"] == {"steps": 9}
    other = SliceNetConfig(backbone="resnet18", height=64, width_multiplier=0.25, lstm_hidden=8)
    with pytest.raises(CheckpointError, match="but the training uses"):
        load_start(tmp_path / "a.pt", other)


def test_wrong_files_are_told(file: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.onnx").write_bytes(b"no onnx")
    deeper = SliceNetConfig(backbone="resnet34", height=64, width_multiplier=0.125, lstm_hidden=8, column_stride=2,
                            decoder_floor=8)  # fmt: skip
    wider = SliceNetConfig(backbone="resnet18", height=64, width_multiplier=0.25, lstm_hidden=8, column_stride=2,
                           decoder_floor=8)  # fmt: skip
    for path, network, words in (
        (tmp_path / "absent.onnx", TINY, "cannot be read: No such file"),
        (tmp_path / "broken.onnx", TINY, "not an ONNX file"),
        (file, deeper, "Conv nodes"),
        (file, wider, "a tensor of shape"),
    ):
        with pytest.raises(CheckpointError, match=words):
            load_start(path, network)
