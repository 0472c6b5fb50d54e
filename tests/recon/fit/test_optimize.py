"""Rates, their decay, and Adam over named groups."""

from __future__ import annotations

import pytest
import torch

from recon.fit.optimize import RATES, Adam, Decay, check_rates, without


def test_decay_is_flat_then_falls_to_its_last():
    decay = Decay(0.35, 0.05)
    assert decay(0) == decay(0.35) == 1
    assert decay(1) == pytest.approx(0.05)
    assert decay(0.675) == pytest.approx(0.05**0.5)


def test_a_group_without_a_rate_stands_still():
    groups = {"means": torch.zeros(3), "offsets": torch.zeros(2).double()}
    adam = Adam(groups, check_rates(without(RATES, "offsets"), groups), 1.0, 1.0)
    adam.step({"means": torch.ones(3), "offsets": torch.ones(2).double()}, 1.0)
    assert list(adam.groups) == ["means"] and not groups["means"].any()
    assert (adam.groups["means"] < 0).all()


def test_steps_are_in_the_units_of_the_scene():
    # Adam's first step is the rate itself: means move by footprints, offsets by frames
    groups = {"means": torch.zeros(1), "offsets": torch.zeros(1).double(), "quats": torch.zeros(1)}
    adam = Adam(groups, {"means": 0.03, "offsets": 0.02, "quats": 0.002}, footprint=10.0, frame_step=1 / 30)
    adam.step({n: torch.ones_like(t) for n, t in groups.items()}, 0.5)
    moved = {n: -float(t.detach()) for n, t in adam.groups.items()}
    assert moved == pytest.approx({"means": 0.15, "offsets": 0.02 / 30 * 0.5, "quats": 0.001}, rel=1e-5)


def test_restored_moments_continue_bit_by_bit():
    start = {"means": torch.randn(5, 3), "static.means": torch.randn(2, 3)}
    rates = {"means": 0.1, "static.means": 0.2}
    pull = [{n: torch.randn_like(t) for n, t in start.items()} for _ in range(6)]
    whole = Adam(start, rates, 1.0, 1.0)
    for g in pull:
        whole.step(g, 1.0)
    first = Adam(start, rates, 1.0, 1.0)
    for g in pull[:3]:
        first.step(g, 1.0)
    second = Adam(first.groups, rates, 1.0, 1.0)
    second.restore(first.moments())
    for g in pull[3:]:
        second.step(g, 1.0)
    for name in start:
        assert torch.equal(whole.groups[name], second.groups[name])


@pytest.mark.parametrize("rates", [{"meens": 0.1}, {"means": 0.0}, {"means": -1.0}, {"means": float("nan")}])
def test_rates_that_make_no_sense_are_refused(rates):
    with pytest.raises(ValueError, match="rates: expected"):
        check_rates(rates, {"means": torch.zeros(3)})


def test_freezing_what_has_no_rate_is_a_mistake():
    with pytest.raises(ValueError, match="freeze: expected"):
        without(RATES, "offset")


def test_strides_of_parameters_and_gradients_do_not_matter():
    value, pull = torch.randn(4, 3), torch.randn(4, 3)
    plain, strided = (Adam({"means": v}, {"means": 0.1}, 1.0, 1.0) for v in (value, value.T.contiguous().T))
    for _ in range(3):
        plain.step({"means": pull}, 1.0)
        strided.step({"means": pull.T.contiguous().T}, 1.0)
    assert torch.equal(plain.groups["means"], strided.groups["means"])
