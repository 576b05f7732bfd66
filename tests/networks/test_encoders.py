"""Encoders: number and order of the features, scaling of inputs, and rejected configs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor, nn

from merl.core import MerlError
from merl.modalities import Depth, Image, Modality, Sequence, Vector
from merl.networks.encoders import EncoderOptions, make_encoder
from merl.networks.encoders.frames import ConvEncoder
from merl.networks.encoders.pretrained import TimmEncoder, has_timm
from merl.networks.encoders.vectors import Identity, MLPEncoder, Standardize
from merl.networks.initialization import orthogonal
from merl.networks.representation import Encoders


def image(*shape: int, low: int = 0, high: int = 255) -> Image:
    return Image(spaces.Box(low, high, shape, np.uint8))


def vector(length: int) -> Vector:
    return Vector(spaces.Box(-np.inf, np.inf, (length,), np.float32))


def noise(*shape: int) -> Tensor:
    return torch.randint(0, 256, shape, dtype=torch.uint8)


@pytest.mark.parametrize("shade", [0, 128, 255])
def test_pixels_are_scaled_to_half_a_unit_on_each_side(shade: int) -> None:
    encoder = ConvEncoder(image(5, 5, 3), 2, channels=4, strides=(2,)).double()
    stacks = torch.full((1, 2, 5, 5, 3), shade, dtype=torch.uint8)
    scaled = torch.full((1, 6, 5, 5), shade / 255 - 0.5, dtype=torch.float64)
    expected = encoder.convolutions(scaled).permute(0, 2, 3, 1).flatten(1)
    torch.testing.assert_close(encoder(stacks), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("low", "high"), [(0, 1), (0, 2), (0, 254), (0, 255), (1, 255), (200, 231)]
)
def test_pixels_are_scaled_by_the_given_bounds(low: int, high: int) -> None:
    torch.manual_seed(0)
    encoder = ConvEncoder(image(5, 5, 1, low=low, high=high), 2, channels=4, strides=(2,)).double()
    stacks = torch.randint(low, high + 1, (3, 2, 5, 5, 1), dtype=torch.uint8)
    stacks[0, 0, 0, 0], stacks[0, 0, 0, 1] = low, high
    scaled = (stacks[..., 0].double() - low) / (high - low) - 0.5
    expected = encoder.convolutions(scaled).permute(0, 2, 3, 1).flatten(1)
    torch.testing.assert_close(encoder(stacks), expected, rtol=0, atol=1e-12)


def test_bf16_encodes_a_binary_mask_accurately() -> None:
    torch.manual_seed(0)
    encoder = ConvEncoder(image(84, 84, 3, high=1), 3)
    orthogonal(encoder)
    mask = torch.randint(0, 2, (2, 3, 84, 84, 3), dtype=torch.uint8)
    exact = encoder(mask)
    with torch.autocast("cpu", torch.bfloat16):
        assert (encoder(mask) - exact).norm() < 0.01 * exact.norm()


def test_bf16_encodes_dark_and_bright_images_accurately() -> None:
    """A bias that absorbed half of all weights would be rounded coarsely, for all images alike."""
    torch.manual_seed(0)
    encoder = ConvEncoder(image(84, 84, 3), 3)
    orthogonal(encoder)
    for dark, bright in ((0, 40), (110, 146), (215, 256)):
        stacks = torch.randint(dark, bright, (2, 3, 84, 84, 3), dtype=torch.uint8)
        exact = encoder(stacks)
        with torch.autocast("cpu", torch.bfloat16):
            rounded = encoder(stacks)
        assert (rounded - exact).norm() < 0.01 * exact.norm()


def test_default_is_the_papers_encoder() -> None:
    encoder = ConvEncoder(image(84, 84, 3), 3)
    convolutions = [m for m in encoder.modules() if isinstance(m, torch.nn.Conv2d)]
    assert [c.stride[0] for c in convolutions] == [2, 1, 1, 1]
    assert all(c.kernel_size == (3, 3) and c.out_channels == 32 for c in convolutions)
    assert encoder.features == 32 * 35 * 35 == 39_200


@pytest.mark.parametrize("size", [(24, 28), (48, 48), (17, 31)])
@pytest.mark.parametrize("strides", [(2, 1, 1, 1), (2, 2, 1), (1,), (3, 2)])
def test_attribute_features_is_the_output_length(
    size: tuple[int, int], strides: tuple[int, ...]
) -> None:
    encoder = ConvEncoder(image(*size, 2), 3, channels=4, strides=strides)
    assert encoder(noise(2, 3, *size, 2)).shape == (2, encoder.features)


def test_features_are_ordered_by_row_column_channel() -> None:
    encoder = ConvEncoder(image(9, 11, 1), 3, channels=4, strides=(2,))
    stacks = noise(2, 3, 9, 11, 1)
    maps = encoder.convolutions(stacks[..., 0] / 255 - 0.5)  # (2, 4, 4, 5)
    features = encoder(stacks)
    for row, column, channel in [(0, 0, 0), (1, 3, 2), (3, 4, 3)]:
        flat = (row * 5 + column) * 4 + channel
        torch.testing.assert_close(features[:, flat], maps[:, channel, row, column])
    assert features.min() >= 0  # the last layer is a ReLU


@pytest.mark.parametrize(
    ("size", "strides", "fits"),
    [
        ((17, 17), (2, 1, 1, 1), True),
        ((15, 15), (2, 1, 1, 1), True),
        ((14, 15), (2, 1, 1, 1), False),
        ((15, 14), (2, 1, 1, 1), False),
        ((2, 2), (2, 2, 2, 2), False),
        ((1, 1), (4, 4), False),
    ],
)
def test_too_small_image_is_rejected(
    size: tuple[int, int], strides: tuple[int, ...], fits: bool
) -> None:
    if fits:
        assert ConvEncoder(image(*size, 1), 3, strides=strides).features == 32 * (
            1 if size[0] < 17 else 4
        )
    else:
        with pytest.raises(MerlError, match=f"{size[0]}x{size[1]} pixels is too small"):
            ConvEncoder(image(*size, 1), 3, strides=strides)


def test_identity_leaves_a_vector_unchanged() -> None:
    encoder = Identity(vector(7))
    values = torch.randn(3, 7)
    assert torch.equal(encoder(values), values)
    assert encoder.features == 7
    assert not list(encoder.parameters())


def test_vectors_are_standardised() -> None:
    draw = torch.Generator().manual_seed(0)
    scale = torch.tensor([5.0, 0.05, 0.0, 1e-4])
    center = torch.tensor([1.0, -0.2, 0.18, 0.0])

    def vectors(count: int) -> torch.Tensor:
        return center + scale * torch.randn(count, 4, generator=draw)

    scale_layer = Standardize(4)
    batches = [vectors(128) for _ in range(5)]
    for batch in batches:
        scale_layer.observe(batch)
    seen = torch.cat(batches)
    torch.testing.assert_close(scale_layer.mean, seen.mean(0))
    torch.testing.assert_close(scale_layer.variance, seen.var(0, correction=0))
    encoded = scale_layer(vectors(10_000))
    assert encoded.std(0)[:2] == pytest.approx(torch.ones(2), rel=0.1)
    assert encoded.mean(0) == pytest.approx(torch.zeros(4), abs=0.15)
    assert encoded.std(0)[2] < 1e-3  # a constant entry is not amplified
    assert encoded.std(0)[3] == pytest.approx(0.01, rel=0.1)
    assert not list(scale_layer.parameters())


def test_standardisation_is_fixed_after_enough_samples() -> None:
    scale = Standardize(1)
    for _ in range(Standardize.STEADY // 1000):
        scale.observe(torch.randn(1000, 1))
    before = {name: value.clone() for name, value in scale.state_dict().items()}
    scale.observe(torch.full((1000, 1), 50.0))
    for name, value in scale.state_dict().items():
        assert torch.equal(value, before[name])


def test_standardisation_is_accurate_far_from_zero() -> None:
    scale = Standardize(1)
    vectors = 1e4 + torch.randn(10, 500, 1, generator=torch.Generator().manual_seed(0))
    for batch in vectors:
        scale.observe(batch)
    assert scale(vectors.flatten(0, 1)).std() == pytest.approx(1, rel=0.01)


def test_outliers_are_clipped() -> None:
    scale = Standardize(2)
    scale.observe(torch.zeros(100, 2))
    assert scale(torch.tensor([[0.02, 3.0], [-1.0, 0.0]])).tolist() == [[2, 5], [-5, 0]]


def test_mlp_has_two_layers_and_ends_in_a_relu() -> None:
    encoder = MLPEncoder(vector(7), 16)
    assert encoder.features == 16
    assert sum(isinstance(m, torch.nn.Linear) for m in encoder.modules()) == 2
    out = encoder(torch.randn(50, 7))
    assert out.shape == (50, 16)
    assert out.min() == 0


def test_each_modality_is_encoded_images_first() -> None:
    keys: dict[str, Modality] = {"front": image(9, 9, 1), "wrist": image(9, 9, 1)}
    cameras = {key: ConvEncoder(image(9, 9, 1), 3, channels=2, strides=(2,)) for key in keys}
    keys["proprio"] = vector(5)
    encoders = Encoders({**cameras, "proprio": Identity(vector(5))}, keys, 4, standardize=False)
    stack = torch.randint(0, 256, (2, 3, 9, 9, 1), dtype=torch.uint8)
    observation = {"proprio": torch.randn(2, 5), "wrist": stack, "front": 255 - stack}
    encoded = encoders(observation)
    assert list(encoded) == list(encoders.features) == ["front", "wrist", "proprio"]
    assert {key: x.shape[1] for key, x in encoded.items()} == encoders.features
    middle = torch.full((2, 2), 4)
    shifted = encoders(observation, {"front": middle, "wrist": middle - 2})
    assert torch.equal(shifted["front"], encoded["front"])
    assert not torch.equal(shifted["wrist"], encoded["wrist"])


def depth(*shape: int) -> Depth:
    return Depth(spaces.Box(0.0, 2.0, shape, np.float32))


def history(samples: int, numbers: int) -> Sequence:
    return Sequence(spaces.Box(-np.inf, np.inf, (samples, numbers), np.float32))


OPTIONS = EncoderOptions(conv_channels=8, mlp_dim=16)
FITTING: list[tuple[str, Modality]] = [
    ("conv", image(24, 20, 3)),
    ("conv", depth(24, 20, 1)),
    ("impala", image(24, 21, 1)),
    ("impala", depth(8, 8, 1)),
    ("identity", vector(5)),
    ("identity", history(4, 3)),
    ("mlp", vector(5)),
    ("mlp", history(4, 3)),
    ("conv1d", history(1, 3)),
    ("conv1d", history(50, 6)),
    ("transformer", history(50, 6)),
]


@pytest.mark.parametrize(("name", "modality"), FITTING)
def test_an_encoder_by_name_learns_from_what_it_encodes(name: str, modality: Modality) -> None:
    torch.manual_seed(0)
    encoder = make_encoder(name, modality, 3, OPTIONS)
    orthogonal(encoder)
    stored = modality.random(4, 3, torch.Generator().manual_seed(0))
    taken = stored if hasattr(encoder, "takes_stored") else modality.to_input(stored)
    encoded = encoder(taken)
    assert encoded.shape == (4, encoder.features)
    assert torch.isfinite(encoded).all()
    assert not torch.allclose(encoded[0], encoded[1])
    if list(encoder.parameters()):
        encoded.square().sum().backward()
        assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in encoder.parameters())


@pytest.mark.parametrize("name", ["conv1d", "transformer"])
def test_the_order_of_a_history_matters(name: str) -> None:
    torch.manual_seed(0)
    modality = history(12, 3)
    encoder = make_encoder(name, modality, 3, OPTIONS)
    samples = torch.randn(2, 12, 3)
    assert not torch.allclose(encoder(samples), encoder(samples.flip(1)), atol=1e-3)


@pytest.mark.parametrize(
    ("name", "modality", "message"),
    [
        ("conv1d", image(24, 24, 3), "does not fit a key of kind image: choose from conv, impala"),
        ("conv", vector(3), "does not fit a key of kind vector: choose from identity, mlp"),
        ("impla", image(24, 24, 3), "did you mean 'impala'"),
        ("resnet", history(3, 3), "choose from identity, mlp, conv1d, transformer, module:Class"),
        ("impala", image(7, 24, 3), "7x24 pixels is too small for encoder impala"),
        ("nowhere:Encoder", vector(3), "No module named 'nowhere'"),
        (f"{__name__}:vector", vector(3), "has no class 'vector' that is a torch.nn.Module"),
        (f"{__name__}:Short", vector(3), r"shape \(2, 3\) .* `features` is 4"),
        (
            f"{__name__}:Failing",
            vector(3),
            r"failed: ValueError: no cable \(test_enc",
        ),
    ],
)
def test_an_encoder_that_does_not_fit_is_refused(
    name: str, modality: Modality, message: str
) -> None:
    with pytest.raises(MerlError, match=message):
        make_encoder(name, modality, 3, OPTIONS)


class Own(nn.Module):
    """An encoder of a user, with an initialisation of its own."""

    def __init__(self, modality: Modality, stack: int) -> None:
        super().__init__()
        self.features = 2
        self.layer = nn.Linear(modality.shape[0], 2)
        nn.init.constant_(self.layer.weight, 0.25)
        self.seen = 0

    def observe(self, values: Tensor) -> None:
        self.seen += len(values)

    def forward(self, values: Tensor) -> Tensor:
        return self.layer(values)


class Short(Own):
    def __init__(self, modality: Modality, stack: int) -> None:
        super().__init__(modality, stack)
        self.features = 4

    def forward(self, values: Tensor) -> Tensor:
        return values


class Failing(Own):
    def forward(self, values: Tensor) -> Tensor:
        raise ValueError("no cable")


def test_an_own_encoder_keeps_its_weights_and_sees_each_batch() -> None:
    modality = vector(3)
    encoder = make_encoder(f"{__name__}:Own", modality, 3, OPTIONS)
    assert encoder.features == 2
    encoders = Encoders({"joints": encoder}, {"joints": modality}, 0, standardize=False)
    orthogonal(encoders)
    assert (encoder.layer.weight == 0.25).all()
    encoders.observe({"joints": torch.zeros(7, 3)})
    assert encoder.seen == 7


def test_standardisation_applies_to_vectors_and_histories() -> None:
    modalities: dict[str, Modality] = {"joints": vector(2), "force": history(6, 3)}
    parts = {key: Identity(modality) for key, modality in modalities.items()}
    encoders = Encoders(parts, modalities, 0, standardize=True)
    values = {"joints": 100 + torch.randn(500, 2), "force": 5 * torch.randn(500, 6, 3) - 40}
    encoders.observe(values)
    for encoded in encoders(values).values():
        assert encoded.mean().abs() < 0.1
        assert encoded.std() == pytest.approx(1, rel=0.1)


timm = pytest.mark.skipif(not has_timm(), reason="timm is not installed")


@timm
@pytest.mark.parametrize("channels", [1, 3])
def test_a_timm_model_encodes_each_frame(channels: int) -> None:
    modality = image(64, 64, channels)
    encoder = make_encoder("resnet18", modality, 2, OPTIONS)
    assert encoder.features == 2 * 512
    stacks = modality.to_input(noise(3, 2, 64, 64, channels))
    encoded = encoder(stacks)
    assert torch.equal(encoder.train()(stacks), encoded)  # the statistics are fixed
    swapped = encoder(stacks.unflatten(1, (2, channels)).flip(1).flatten(1, 2))
    torch.testing.assert_close(swapped, encoded.roll(512, 1))
    with pytest.raises(MerlError, match="one or three channels, not 4"):
        make_encoder("resnet18", image(64, 64, 4), 2, OPTIONS)


@timm
def test_a_timm_model_takes_its_weights_from_a_local_file(tmp_path: Path) -> None:
    one, other = (make_encoder("resnet18", image(64, 64, 3), 1, OPTIONS) for _ in range(2))
    assert isinstance(one, TimmEncoder)
    assert isinstance(other, TimmEncoder)
    file = tmp_path / "weights.pt"
    torch.save(other.model.state_dict(), file)
    one.load(file)
    orthogonal(one)
    for mine, theirs in zip(one.parameters(), other.parameters(), strict=True):
        assert torch.equal(mine, theirs)
    larger = make_encoder("resnet34", image(64, 64, 3), 1, OPTIONS)
    assert isinstance(larger, TimmEncoder)
    with pytest.raises(MerlError, match="are of another model"):
        larger.load(file)
    torch.save(larger.model.state_dict(), file)
    with pytest.raises(MerlError, match="are of another model"):
        one.load(file)
    file.write_bytes(b"no weights")
    with pytest.raises(MerlError, match="of encoder 'resnet18'"):
        one.load(file)
    file.unlink()
    with pytest.raises(MerlError, match="there is no such file"):
        one.load(file)
