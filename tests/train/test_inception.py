"""SIFID: InceptionV3's first layers as the files of pytorch-fid and torchvision name them, and clear errors for others."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

pytest.importorskip(
    "stlpips_pytorch", reason="the VGG-16 weights come with stlpips-pytorch: pip install 'solidgrain[evaluate]'"
)

from solidgrain.runtime.errors import SolidgrainError
from solidgrain.train import quality
from solidgrain.train.cuts import as_image
from solidgrain.train.inception import Inception
from tests.train.conftest import blotches

IMAGE = as_image(blotches(67, 90))


class Layer(nn.Module):
    """A convolution, its batch norm and a ReLU, as torchvision's BasicConv2d."""

    def __init__(self, *shape, **settings):
        super().__init__()
        self.conv = nn.Conv2d(*shape, bias=False, **settings)
        self.bn = nn.BatchNorm2d(shape[1], eps=0.001)

    def forward(self, x):
        return torch.relu(self.bn(self.conv(x)))


class Reference(nn.Module):
    """The layers by themselves, from torch's own building blocks."""

    def __init__(self):
        super().__init__()
        self.Conv2d_1a_3x3 = Layer(3, 32, 3, stride=2)
        self.Conv2d_2a_3x3 = Layer(32, 32, 3)
        self.Conv2d_2b_3x3 = Layer(32, 64, 3, padding=1)
        self.Mixed_5b = nn.Linear(2, 2)  # a real file holds many more weights

    def forward(self, image):
        x = self.Conv2d_2b_3x3(self.Conv2d_2a_3x3(self.Conv2d_1a_3x3(2 * image - 1)))
        return nn.MaxPool2d(3, stride=2)(x)


@pytest.fixture(scope="module")
def reference():
    torch.manual_seed(4)
    network = Reference().eval()
    with torch.no_grad():
        for name, tensor in network.state_dict().items():
            if ".bn." in name and tensor.is_floating_point():
                tensor.copy_(0.5 + torch.rand(tensor.shape))
    return network


@pytest.fixture
def weights(reference, tmp_path):
    torch.save(reference.state_dict(), tmp_path / "inception.pth")
    return tmp_path / "inception.pth"


def test_features_are_those_of_the_network_put_together_from_torch_s_own_layers(reference, weights):
    with torch.no_grad():
        expected = reference(IMAGE)
    found = Inception(weights).features(IMAGE)
    assert found.shape == (1, 64, 15, 20)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_sifid_is_zero_for_the_same_image_symmetric_and_as_numpy_computes_it(weights):
    measure = quality.Measure(Inception(weights))
    one, other = (
        measure.statistics(as_image(np.ascontiguousarray(image))) for image in (blotches(64, 64), blotches(70, 64)[6:])
    )
    assert measure.distances(one, one)["sifid"] == pytest.approx(0, abs=1e-6)
    there, back = measure.distances(one, other)["sifid"], measure.distances(other, one)["sifid"]
    assert there == pytest.approx(back, rel=1e-6)
    assert there > 1e-4
    assert there == pytest.approx(frechet(one.inception, other.inception), rel=1e-5)


def frechet(a, b):
    """The distance with the root of a symmetric matrix, as the definition writes it: (C_a^1/2 C_b C_a^1/2)^1/2."""
    (mean_a, cov_a), (mean_b, cov_b) = ([part.numpy() for part in moments] for moments in (a, b))
    values, vectors = np.linalg.eigh(cov_a)
    root = vectors * np.sqrt(values.clip(0)) @ vectors.T
    middle = np.linalg.eigvalsh(root @ cov_b @ root).clip(0)
    return ((mean_a - mean_b) ** 2).sum() + np.trace(cov_a) + np.trace(cov_b) - 2 * np.sqrt(middle).sum()


def test_without_weights_there_is_no_sifid():
    measure = quality.Measure()
    one = measure.statistics(as_image(blotches(64, 64)))
    assert "sifid" not in measure.distances(one, one)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such file"),
        (b"", "not a weights file that torch reads"),
        (b"hello", "not a weights file that torch reads"),
        ([1, 2], "holds a list, expected a state dict"),
        ({"features.0.weight": torch.zeros(1)}, r"no Conv2d_1a_3x3\.conv\.weight; expected InceptionV3 weights"),
        ({"Conv2d_1a_3x3.conv.weight": torch.zeros(32, 1, 3, 3)}, r"shape \(32, 1, 3, 3\), expected \(32, 3, 3, 3\)"),
        ({"Conv2d_1a_3x3.conv.weight": "text"}, r"shape \(\), expected \(32, 3, 3, 3\)"),
    ],
)
def test_a_file_that_is_not_those_weights_is_refused_in_one_line(tmp_path, content, message):
    path = tmp_path / "weights.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(SolidgrainError, match=message) as caught:
        Inception(path)
    assert "\n" not in str(caught.value)
    assert "--inception" in str(caught.value)
