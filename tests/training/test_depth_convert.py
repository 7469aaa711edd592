"""Checkpoint to ONNX: ``ic depth convert``, and the folded decoder that it writes."""

import contextlib
import io
import json
import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

from instant_ic.cli.main import main
from instant_ic.depth.manifest import load_manifest
from instant_ic.depth.model import DepthModel
from instant_ic.training import export
from instant_ic.training.export import ExportError, export_onnx
from instant_ic.training.slicenet import SliceNet, SliceNetConfig

torch.set_num_threads(1)
TINY = SliceNetConfig(
    backbone="resnet18", height=64, width_multiplier=0.125, lstm_hidden=16, column_stride=2, decoder_floor=8
)


def random_network(config: SliceNetConfig = TINY) -> SliceNet:
    """Random weights, with norms of random strength that have seen pictures: a depth that varies by metres."""
    torch.manual_seed(0)
    model = SliceNet(config)
    for module in model.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.momentum = None  # plain mean over the batches that follow
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.normal_(module.bias, 0.0, 0.2)
        if isinstance(module, torch.nn.PReLU):
            torch.nn.init.uniform_(module.weight, 0.1, 0.5)
    torch.nn.init.constant_(model.decoder[-1].layers[1].bias, 3.0)
    with torch.no_grad():
        for _ in range(2):
            model(torch.rand(2, 3, config.height, config.width))
    return model.eval()


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "tiny.pt"
    torch.save({"config": asdict(TINY), "state_dict": random_network().state_dict(), "record": {"steps": 3}}, path)
    return path


@pytest.fixture(scope="module")
def converted(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("converted") / "new" / "tiny.onnx"
    words = ["depth", "convert", str(checkpoint), "-o", str(output), "--half", "--max-range", "12", "--licence", "MIT"]
    told = io.StringIO()
    write = torch.onnx.export

    def write_and_keep(*args: object, **options: object) -> None:
        write(*args, **options)
        shutil.copy(args[2], output.parents[1] / "plain.onnx")

    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(told):
        patch.setattr(torch.onnx, "export", write_and_keep)
        assert main(words) == 0
    (output.parents[1] / "told.txt").write_text(told.getvalue())
    return output


@pytest.fixture(scope="module")
def exported(converted: Path) -> bytes:
    """What torch wrote, before its weights became float16."""
    return (converted.parents[1] / "plain.onnx").read_bytes()


def test_convert_writes_model_manifest_and_record(converted: Path) -> None:
    output, told = converted, (converted.parents[1] / "told.txt").read_text()
    assert "SliceNet resnet18, 128 x 64" in told and "exporting to ONNX" in told
    difference = float(told.split("largest difference to torch: ")[1].split()[0])
    assert 0 < difference < 1e-5
    record = json.loads(output.with_suffix(".json").read_text())
    assert record["steps"] == 3 and record["export"]["difference"] == pytest.approx(difference, rel=0.1)
    manifest = load_manifest(output.with_suffix(".yaml"))
    assert (manifest.max_range_m, manifest.licence, manifest.name) == (12.0, "MIT", "tiny")
    assert [p.name for p in sorted(output.parent.iterdir())] == ["tiny.json", "tiny.onnx", "tiny.yaml"]

    # float16 weights: about half of what the network's numbers take in float32.
    floats = sum(value.numel() for value in random_network().state_dict().values())
    assert output.stat().st_size < 0.75 * 4 * floats

    picture = np.random.default_rng(0).integers(0, 256, (64, 128, 3), np.uint8)
    with torch.inference_mode():
        expected = random_network()(torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255)[0].numpy()
    assert np.ptp(expected) > 0.5
    depth = DepthModel.load(output, threads=1).estimate(picture)
    np.testing.assert_allclose(depth, expected.clip(0.1, 12.0), atol=2e-2 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["absent.pt"], "absent.pt: cannot be read: No such file"),
        (["absent.pt", "-o", "model.bin"], "the name must end in .onnx"),
        (["{checkpoint}", "-o", "/proc/nowhere/x.onnx"], "/proc/nowhere"),
    ],
)
def test_convert_tells_faults_in_a_line(
    checkpoint: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [word.format(checkpoint=checkpoint) for word in words]
    assert main(["depth", "convert", *words]) == 1
    told = capsys.readouterr().err
    assert message in told and "Traceback" not in told


@pytest.fixture
def ready(exported: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """torch's exporter gives the file that it gave before, which takes no time."""
    monkeypatch.setattr(torch.onnx, "export", lambda model, args, path, **options: Path(path).write_bytes(exported))


@pytest.mark.usefixtures("ready")
def test_what_onnx_computes_otherwise_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "m.onnx"
    path.write_bytes(b"the model before")
    honest = export._run
    monkeypatch.setattr(export, "_run", lambda *args: honest(*args) * np.float32(1.01))
    with pytest.raises(ExportError, match=r"difference to torch: (9\.\de-03|1\.[0-2]e-02)"):
        export_onnx(random_network(), path)
    assert path.read_bytes() == b"the model before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_network_that_says_nothing_is_refused(tmp_path: Path) -> None:
    model = random_network()
    torch.nn.init.zeros_(model.decoder[-1].layers[1].weight)
    with pytest.raises(ExportError, match="outputs no depth"):
        export_onnx(model, tmp_path / "m.onnx")
