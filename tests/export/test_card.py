"""The model card says how a texture came about."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from solidgrain.export.card import write_card
from solidgrain.train.settings import preset


def card(**changes):
    entry = {"exemplar": "a.png", "license": "CC0-1.0", "credit": "", "sha256": 64 * "0"}
    settings = asdict(preset("fast", **changes))
    return write_card("a", {"settings": settings, "exemplars": [entry], "iterations": 1, "minutes": 1.0, "revision": "0"})


def test_a_comparison_of_the_paper_s_names_its_variant():
    assert "preset `fast`, variant `gan+vgg`, seed 0" in card(variant="gan+vgg")
    assert "preset `fast`, seed 0" in card()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ["| octaves | 32 |", "| began as | `stone`, whose iterations are not counted here |"]),
        ({"sampler_start": ""}, ["| octaves | 32, span 7 |", "| critic began as | that of `stone` |"]),
        ({"sampler_start": "", "critic_start": ""}, ["| octaves | 32, span 7 |\n| slices |"]),
        ({"sampler_start": "", "warm_start": "runs/other"}, ["| octaves | 32 |", "| began as | `runs/other`,"]),
    ],
)
def test_what_it_began_as_is_said_and_how_octaves_started_where_they_did(changes, said):
    for line in said:
        assert line in card(**changes)


@pytest.mark.parametrize(
    ("grain", "said"), [("x", "upright, from xy to xz |"), ("y", "upright, from xy to zy (z to the left) |")]
)
def test_the_planes_of_what_is_upright_are_named(grain, said):
    assert f"turned about the {grain} axis only, {said}" in card(grain=grain, upright=True)
