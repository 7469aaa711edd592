"""The completion network: it starts as its prior, keeps measured pixels, and is the same on a turned panorama."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from instant_ic.depth.model import DepthModel
from instant_ic.training.checkpoints import CheckpointError
from instant_ic.training.completion import CompletionConfig, CompletionNet, load_encoder
from instant_ic.training.export import ExportError, export_model
from instant_ic.training.losses import sigma_loss

TINY = CompletionConfig(64, (8, 8, 8), 2)


def inputs(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Random image, and a prior of 2 m (sigma .05) whose left half is unknown, with one measured row of 3 m."""
    prior = torch.zeros(1, 6, 64, 128)
    prior[:, 0, :, 64:], prior[:, 1, :, 64:] = 2.0, 0.05
    prior[:, 0, 32, 64:], prior[:, 1, 32, 64:], prior[:, 2, 32, 64:] = 3.0, 0.01, 1.0
    return torch.rand((1, 3, 64, 128), generator=torch.Generator().manual_seed(seed)), prior


def trained() -> CompletionNet:
    """A network whose head is not zero."""
    torch.manual_seed(0)
    model = CompletionNet(TINY)
    torch.nn.init.normal_(model.head.weight, std=0.2)
    return model.eval()


@torch.inference_mode()
def test_untrained_network_gives_the_prior_and_a_typical_depth() -> None:
    image, prior = inputs()
    depth, sigma = CompletionNet(TINY).eval()(image, prior)
    torch.testing.assert_close(depth[..., 64:], prior[:, 0, :, 64:], rtol=1e-6, atol=0)
    torch.testing.assert_close(sigma[..., 64:], prior[:, 1, :, 64:], rtol=1e-6, atol=0)
    torch.testing.assert_close(depth[..., :64], torch.full((1, 64, 64), 2.5), rtol=1e-6, atol=0)
    torch.testing.assert_close(sigma[..., :64], torch.full((1, 64, 64), 0.6), rtol=1e-6, atol=0)


@torch.inference_mode()
def test_an_output_of_one_is_the_priors_sigma() -> None:
    """Change 1 and spread log 2: the factor on the depth is exp(sigma) within .05 to .6, that on sigma 2."""
    model = CompletionNet(TINY).eval()
    model.head.bias.copy_(torch.tensor([1.0, np.log(2)]).repeat_interleave(16))
    image, prior = inputs()
    prior[:, 1, 5, 64:], prior[:, 1, 6, 64:] = 0.005, 0.1
    depth, sigma = model(image, prior)
    for row, step in ((5, 0.05), (6, 0.1)):
        assert depth[0, row, 100].item() == pytest.approx(2 * np.exp(step), rel=1e-5)
    assert depth[0, 5, 10].item() == pytest.approx(2.5 * np.exp(0.6), rel=1e-5)
    assert sigma[0, 6, 100].item() == pytest.approx(0.2, rel=1e-5)


@torch.inference_mode()
def test_the_encoder_keeps_its_statistics_in_training() -> None:
    model = CompletionNet(TINY).train()
    before = model.encoder.stem.norm.running_mean.clone()
    model(*inputs())
    assert torch.equal(before, model.encoder.stem.norm.running_mean) and model.head.training


@torch.inference_mode()
def test_output_passes_through_measured_points_exactly() -> None:
    image, prior = inputs()
    depth, sigma = trained()(image, prior)
    assert torch.equal(depth[0, 32, 64:], torch.full((64,), 3.0))
    assert torch.equal(sigma[0, 32, 64:], torch.full((64,), 0.01))
    assert depth[0, 31, 64:].std() > 0 and (depth > 0).all() and torch.isfinite(sigma).all()


@torch.inference_mode()
def test_turned_panorama_gives_turned_depth() -> None:
    model, (image, prior) = trained(), inputs()
    depth, _ = model(image, prior)
    turned, _ = model(image.roll(32, -1), prior.roll(32, -1))  # a multiple of the coarsest stride
    torch.testing.assert_close(turned, depth.roll(32, -1), rtol=1e-4, atol=1e-4)


def published(model: CompletionNet) -> dict[str, torch.Tensor]:
    """The encoder's weights under the names of the package's file."""
    parts = {"expand.conv": "_expand_conv", "expand.norm": "_bn0", "depthwise.conv": "_depthwise_conv",
             "depthwise.norm": "_bn1", "project.conv": "_project_conv", "project.norm": "_bn2"}  # fmt: skip
    state = {}
    for key, value in model.encoder.state_dict().items():
        for own, theirs in {**parts, "stem.conv": "_conv_stem", "stem.norm": "_bn0"}.items():
            key = key.replace(own, theirs)
        state[f"_{key}" if key.startswith("blocks") else key] = value
    return state | {"_fc.weight": torch.zeros(2, 2), "_blocks.11._bn0.weight": torch.zeros(2)}  # not used


def test_published_encoder_loads_by_its_names(tmp_path: Path) -> None:
    torch.manual_seed(3)
    source, target = CompletionNet(TINY), CompletionNet(TINY)
    torch.save(published(source), tmp_path / "lite0.pth")
    load_encoder(target, tmp_path / "lite0.pth")
    for key, value in source.encoder.state_dict().items():
        assert torch.equal(value, target.encoder.state_dict()[key]), key
    torch.save({"_conv_stem.weight": torch.zeros(3)}, tmp_path / "other.pth")
    with pytest.raises(CheckpointError, match="Missing key"):
        load_encoder(target, tmp_path / "other.pth")


def test_exported_file_completes_as_the_network_does(tmp_path: Path) -> None:
    model, (image, prior) = trained(), inputs()
    export_model(model, tmp_path / "c.onnx", "c", "Apache-2.0", 40.0)
    loaded = DepthModel.load(tmp_path / "c.onnx", threads=1)
    rgb = (image[0].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    with torch.inference_mode():
        depth, sigma = model(torch.from_numpy(rgb).permute(2, 0, 1)[None].float() / 255, prior)
    got, doubt = loaded.complete(rgb, prior[0].numpy())
    np.testing.assert_allclose(got, depth[0].numpy().clip(0.1, 40), rtol=1e-3)
    np.testing.assert_allclose(doubt, sigma[0].numpy(), rtol=1e-3)
    with pytest.raises(ValueError, match="c corrects fused depth"):
        loaded.estimate(rgb)
    with pytest.raises(ValueError, match="the prior must be"):
        loaded.complete(rgb, prior[0, :, :32].numpy())


def test_sigma_loss_is_smallest_where_68_percent_lie_within() -> None:
    rng = np.random.default_rng(0)
    error = torch.from_numpy(rng.laplace(0, 0.1, (1, 64, 64)).astype(np.float32))
    truth, rows = torch.full((1, 64, 64), 2.0), torch.ones(64)
    tried = torch.linspace(0.05, 0.3, 51)
    losses = [sigma_loss(truth * error.exp(), torch.full_like(truth, float(s)), truth, rows) for s in tried]
    best = float(tried[int(np.argmin(losses))])
    assert (error.abs() < best).float().mean().item() == pytest.approx(0.68, abs=0.03)


def test_a_file_that_differs_from_the_network_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "m.onnx"
    path.write_bytes(b"the model before")
    other = np.zeros((1, 64, 128), np.float32)
    monkeypatch.setattr(torch.onnx, "export", lambda model, inputs, path, **options: Path(path).write_bytes(b"file"))
    monkeypatch.setattr(
        "onnxruntime.InferenceSession", lambda *args, **options: SimpleNamespace(run=lambda *_: [other])
    )
    with pytest.raises(ExportError, match="difference to torch"):
        export_model(trained(), path, "m", "Apache-2.0", 40.0)
    assert path.read_bytes() == b"the model before" and list(tmp_path.iterdir()) == [path]
