"""The networks are the paper's, and each loss does what its equation says."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from solidgrain.train.critic import Critic
from solidgrain.train.losses import color_loss, gradient_penalty, gram_matrices, mean_gram, style_loss
from solidgrain.train.noise import Noise, draw_noise, look_up
from solidgrain.train.sampler import Sampler
from solidgrain.train.settings import FAST, PAPER, preset, rate
from solidgrain.train.slices import about_axis, draw_rotations, draw_slices, flat_slice
from solidgrain.train.space import Space
from solidgrain.train.task import Instances
from tests.reference import locate, noise


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_the_critic_has_the_paper_s_layers():
    logits, activations = Critic(generator())(torch.zeros(2, 3, 128, 128))
    assert logits.shape == (2, 1)
    shapes = [tuple(activation.shape[1:]) for activation in activations]
    assert shapes == [
        (32, 128, 128), (64, 128, 128), (64, 64, 64), (128, 64, 64), (128, 32, 32),
        (256, 16, 16), (256, 8, 8), (256, 4, 4), (256, 2, 2),
    ]  # fmt: skip


@pytest.mark.parametrize("size", [32, 64, 200])
def test_the_critic_takes_other_patch_sizes(size):
    assert Critic(generator())(torch.zeros(1, 3, size, size))[0].shape == (1, 1)


def test_noise_lookup_is_trilinear_and_periodic():
    settings = preset("fast", octaves=4)
    instance = draw_noise(4, 64, generator())
    transforms = Sampler(settings, generator()).transforms().detach()
    points = torch.randn(1, 20, 3, generator=generator()) * 40
    found, tables = look_up(instance, transforms, points)[0], instance.tables[:, :64, :64, :64]
    for point, values in zip(points[0], found, strict=True):
        for table, transform, value in zip(tables, transforms, values, strict=True):
            expected = noise(table.numpy(), locate(transform.numpy(), tuple(point.tolist())))
            assert value.item() == pytest.approx(expected, abs=2e-3)  # float32 coordinates, up to 5000 texels out


def test_noise_lookup_stays_in_float32_under_autocast():
    instance, points = draw_noise(4, 64, generator()), torch.rand(1, 50, 3, generator=generator()) * 4
    transforms = torch.randn(4, 3, 3, generator=generator()) * 8
    with torch.autocast("cpu", torch.bfloat16):
        reduced = look_up(instance, transforms, points)
    assert reduced.dtype == torch.float32
    assert torch.equal(reduced, look_up(instance, transforms, points))


def test_moved_noise_is_the_same_noise_elsewhere():
    instance, points = draw_noise(3, 16, generator()), 40 * torch.rand(1, 50, 3, generator=generator())
    moved, along = instance.moved(generator()), 2 * torch.eye(3).expand(3, 3, 3)
    for octave, offset in enumerate(moved.offsets):
        expected = look_up(instance, along, points + offset / 2)[..., octave]
        assert torch.allclose(look_up(moved, along, points)[..., octave], expected, atol=1e-4)
    assert moved.offsets.min() >= 0
    assert 8 < moved.offsets.max() < 16


def test_shared_noise_is_another_instance_in_each_batch_and_no_other_numbers():
    for shared in (True, False):
        instances, random = Instances(preset("fast", shared_noise=shared), torch.device("cpu")), generator()
        first, second = instances.draw(random), instances.draw(random)
        assert torch.equal(first.offsets, second.offsets) != shared
        assert torch.equal(first.tables, second.tables) == shared


def test_each_octave_enters_one_hidden_layer_and_the_last_layer_gets_none():
    sampler = Sampler(PAPER, generator())
    assert len(sampler.hidden) == 5
    assert sampler.noise_weights.shape == (4, 4, 128)
    silence = Noise(torch.zeros(16, 65, 65, 65), torch.zeros(16, 3))
    still = sampler(silence, flat_slice(8, torch.device("cpu"))[None])
    assert torch.allclose(still, still[:, :1].expand_as(still))  # without noise, one constant colour


def test_equalized_layers_start_at_unit_variance():
    sampler = Sampler(preset("fast", width=512), generator())
    x = torch.randn(1000, 512, generator=generator())
    out = F.leaky_relu(sampler.hidden[0](x), 0.2)
    assert out.pow(2).mean().item() == pytest.approx(1, abs=0.1)


def test_octaves_of_the_paper_double_and_those_of_fast_stay_in_band():
    assert Sampler(PAPER, generator()).octave_scale.flatten().tolist()[::3] == [2.0**i for i in range(16)]
    assert Sampler(FAST, generator()).octave_scale.max().item() == pytest.approx(2**7)


def test_the_grain_starts_long_along_its_axis():
    scale = Sampler(preset("fast", grain="x", grain_ratio=0.125), generator()).octave_scale
    assert (scale[:, 0, 0] / scale[:, 0, 1]).tolist() == [0.125] * 32


def test_penalty_is_zero_for_a_critic_of_slope_one():
    class Slope(torch.nn.Module):
        def forward(self, images):
            return images.flatten(1).sum(1, keepdim=True) / images[0].numel() ** 0.5, []

    patches = torch.rand(2, 3, 16, 16, generator=generator())
    assert gradient_penalty(Slope(), patches, patches.flip(0), generator()).item() == pytest.approx(0, abs=1e-6)


def test_gram_matrix_is_the_mean_product_of_channels():
    activations = torch.randn(2, 5, 4, 6, generator=generator())
    expected = torch.einsum("bihw,bjhw->bij", activations, activations) / 24
    torch.testing.assert_close(gram_matrices(activations), expected)
    torch.testing.assert_close(mean_gram(activations)[0], expected.mean(0))


def test_style_loss_ignores_where_things_are():
    activations = torch.randn(2, 5, 8, 8, generator=generator())
    assert style_loss([activations], [activations.roll(3, -1)]).item() == pytest.approx(0, abs=1e-6)
    assert style_loss([activations], [activations * 1.5]).item() > 0.1


def test_style_loss_compares_each_slice_with_the_patch_in_its_place():
    """Only those of one exemplar stand side by side."""
    real, fake = torch.randn(2, 3, 5, 8, 8, generator=generator()) * torch.arange(1, 4)[:, None, None, None]
    one_by_one = [style_loss([real[k : k + 1]], [fake[k : k + 1]]) for k in range(3)]
    torch.testing.assert_close(style_loss([real], [fake]), torch.stack(one_by_one).mean())
    assert style_loss([real], [fake.roll(1, 0)]) > 1.1 * style_loss([real], [fake])


def test_an_energy_distance_lets_slices_differ_as_the_exemplar_s_patches_do():
    """Of patches three of which are dark and one is bright, the median is dark: only the energy asks for bright ones."""
    brightness = torch.tensor([1.0, 1.0, 1.0, 3.0])
    mixed, dark = (values[:, None, None, None].expand(4, 1, 2, 2).clone() for values in (brightness, torch.ones(4)))
    plain, energy = ([float(style_loss([mixed], [found], energy=on)) for found in (mixed, dark)] for on in (False, True))
    assert plain == [0, 2]  # patch by patch, in an order that slices do not know:
    unordered = [mixed[torch.tensor(order)] for order in ([0, 1, 2, 3], [3, 0, 1, 2], [0, 3, 1, 2], [0, 1, 3, 2])]
    assert np.mean([float(style_loss([mixed], [found])) for found in unordered]) > plain[1]
    assert [float(style_loss([mixed], [found], energy=True)) for found in unordered] == [energy[0]] * 4
    # Gram entries are 1 and 9: of 16 pairs (W, F) 6 differ, and 3 of 6 pairs (F, F'); of dark slices 4 of 16, and none
    assert energy == [pytest.approx(6 / 16 * 8 - 4 / 2), pytest.approx(4 / 16 * 8)]
    assert energy[0] < energy[1]


def test_an_energy_distance_of_one_patch_is_the_difference_and_may_be_relative():
    real, fake = torch.randn(2, 1, 5, 8, 8, generator=generator())
    torch.testing.assert_close(style_loss([real], [fake], energy=True), style_loss([real], [fake]))
    real, fake = torch.randn(2, 3, 5, 8, 8, generator=generator())
    relative = style_loss([real], [fake], relative=True, energy=True)
    torch.testing.assert_close(style_loss([9 * real], [9 * fake], relative=True, energy=True), relative)


def test_the_loss_of_colours_compares_distributions_whatever_their_order():
    colors = torch.rand(500, 3, generator=generator())
    assert color_loss(colors, colors.flip(0), generator()).item() == pytest.approx(0, abs=1e-6)
    shifted = color_loss(colors, colors + 0.1, generator()).item()
    assert shifted > 0.01
    assert color_loss(0.1 * colors, 0.1 * (colors + 0.1), generator()).item() == pytest.approx(shifted, rel=1e-3)


def test_the_loss_of_colours_tells_two_colours_from_all_between_them():
    """Which mean and covariance do not."""
    two = torch.tensor([[0.2, 0.4, 0.6], [0.8, 0.6, 0.4]]).repeat(500, 1)
    middle = two.mean(0)
    between = middle + torch.randn(1000, 1, generator=generator()) * (two[1] - two[0]) / 2
    torch.testing.assert_close(torch.cov(between.T), torch.cov(two.T), atol=0.01, rtol=0.1)
    mixed, again = color_loss(two, between, generator()), color_loss(two, two.flip(0), generator())
    assert mixed > 0.05
    assert again < 1e-6


def test_the_loss_of_colours_is_finite_for_an_exemplar_of_one_colour():
    flat = torch.full((9, 3), 0.3)
    found = torch.full((9, 3), 0.5, requires_grad=True)
    color_loss(flat, found, generator()).backward()
    assert found.grad.isfinite().all()


def test_colours_are_float32_where_hidden_layers_are_not():
    """A bright colour in bfloat16 has steps of 1/256, as large as a faint material's contrast."""
    sampler = Sampler(preset("fast", octaves=8), generator())
    sampler.take_colors(torch.full((3,), 0.9), 1e-6 * torch.eye(3))
    instance, points = draw_noise(8, 64, generator()), torch.rand(1, 99, 3, generator=generator())
    with torch.autocast("cpu", torch.bfloat16), torch.no_grad():
        rgb = sampler(instance, points)
    assert rgb.dtype == torch.float32
    assert not torch.equal(rgb, rgb.bfloat16().float())
    torch.testing.assert_close(rgb, sampler(instance, points).detach(), atol=1e-4, rtol=0)


def test_what_the_latent_code_says_of_a_texture_is_float32_where_other_layers_are_not():
    """An octave's T_i in bfloat16 would be off by whole texels."""
    space = Space(preset("fast space", octaves=8), generator())
    z = torch.randn(3, 32, generator=generator())
    exact = space.condition(z)
    with torch.autocast("cpu", torch.bfloat16):
        assert space.sampler.output(torch.ones(2, 128)).dtype == torch.bfloat16
        found = space.condition(z)
    assert all(torch.equal(a, b) and a.dtype == torch.float32 for a, b in zip(exact, found, strict=True))


@pytest.mark.parametrize("rotations", ["uniform", "euler"])
def test_slices_are_rotated_rigidly(rotations):
    turned = draw_rotations(preset("fast", batch=64, rotations=rotations), generator())
    torch.testing.assert_close(turned @ turned.transpose(1, 2), torch.eye(3).expand(64, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(turned), torch.ones(64))


def test_uniform_rotations_favour_no_direction():
    normals = draw_rotations(preset("fast", batch=4000), generator())[:, :, 2]
    assert normals.mean(0).abs().max() < 0.05
    assert (normals.T @ normals / 4000 - torch.eye(3) / 3).abs().max() < 0.03


def test_slices_of_a_grained_material_all_hold_the_grain():
    points = draw_slices(preset("fast", grain="x", batch=8), generator()).reshape(8, 64, 64, 3)
    along = points[:, :, 1:] - points[:, :, :-1]
    torch.testing.assert_close(along, torch.tensor([1 / 64, 0, 0]).expand_as(along), atol=1e-5, rtol=0)


@pytest.mark.parametrize("rotations", ["uniform", "axis"])
@pytest.mark.parametrize(("grain", "down", "depth"), [("x", [0, 1, 0], [0, 0, 1]), ("y", [1, 0, 0], [0, 0, -1])])
def test_upright_slices_turn_by_a_quarter(rotations, grain, down, depth):
    """What runs across the grain in them runs down, into the depth, or between the two."""
    settings = preset("fast", grain=grain, upright=True, batch=64, rotations=rotations)
    across = draw_rotations(settings, generator()) @ torch.tensor(down, dtype=torch.float32)
    shares = across @ torch.tensor([down, depth], dtype=torch.float32).T
    torch.testing.assert_close(shares.square().sum(1), torch.ones(64))
    assert shares.min() > -1e-6
    assert (shares.max(0).values > 0.9).all()


def test_a_quarter_turn_about_x_takes_y_to_z():
    turned = about_axis(0, torch.tensor([np.pi / 2], dtype=torch.float32))[0] @ torch.tensor([0.0, 1.0, 0.0])
    torch.testing.assert_close(turned, torch.tensor([0.0, 0.0, 1.0]), atol=1e-6, rtol=0)


def test_rates_halve_down_to_their_floor_and_the_paper_s_are_constant():
    assert rate(2e-3, 4e-4, 400, 400) == pytest.approx(1e-3)
    assert rate(2e-3, 4e-4, 400, 10_000) == 4e-4
    assert rate(PAPER.sampler_rate, PAPER.sampler_rate_floor, PAPER.sampler_half_life, 90_000) == 5e-4


def test_the_paper_preset_is_the_paper_s():
    expected = {
        "octaves": 16, "width": 128, "resolution": 64, "octave_span": 15.0, "orthogonal_start": False,
        "patch": 128, "batch": 16, "rotations": "euler", "transposed": False,
        "alpha": 0.1, "alpha_half_life": 0.0, "beta": 1.0, "gram_energy": False, "color_weight": 0.0,
        "penalty": 10.0, "penalty_every": 1, "drift": 0.001,
        "critic_rate": 2e-3, "sampler_rate": 5e-4,
    }  # fmt: skip
    assert {name: getattr(PAPER, name) for name in expected} == expected
