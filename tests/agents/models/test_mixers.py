"""Mixers: monotone in every robot's value, blind to the robots' order, free in the team's size."""

import pytest
import torch

from maexp.agents.models.critics import MIXERS, make_mixer

FEATURES = 5


@pytest.fixture(params=MIXERS)
def mixer(request):
    torch.manual_seed(0)
    mixer = make_mixer(request.param, FEATURES)
    for p in mixer.parameters():
        torch.nn.init.normal_(p)
    return mixer


@pytest.mark.parametrize("robots", [1, 2, 3, 8])
def test_monotone_for_every_team_size(mixer, robots):
    values = torch.randn(64, robots, 1, requires_grad=True)
    total = mixer(values, torch.randn(64, robots, FEATURES))
    assert total.shape == (64, 1)
    slope = torch.autograd.grad(total.sum(), values)[0]
    assert (slope >= 0).all() and (slope.mean() > 0.01)


def test_order_of_robots_does_not_matter(mixer):
    values, features = torch.randn(7, 4, 1), torch.randn(7, 4, FEATURES)
    order = torch.tensor([3, 1, 0, 2])
    torch.testing.assert_close(mixer(values[:, order], features[:, order]), mixer(values, features))


def test_qmix_weighs_robots_by_what_they_see():
    torch.manual_seed(0)
    mixer = make_mixer("qmix", FEATURES)
    for p in mixer.parameters():
        torch.nn.init.normal_(p)
    values = torch.zeros(1, 2, 1, requires_grad=True)
    slope = torch.autograd.grad(mixer(values, torch.randn(1, 2, FEATURES)).sum(), values)[0].flatten()
    assert not torch.isclose(slope[0], slope[1], rtol=1e-3)


def test_qmix_starts_near_the_sum():
    torch.manual_seed(0)
    mixer = make_mixer("qmix", 64)
    values, features = torch.rand(256, 3, 1) * 4, torch.randn(256, 3, 64).relu()
    error = (mixer(values, features) - values.sum(1)).abs().mean()
    assert error < 0.25 * values.sum(1).abs().mean()


def test_unknown_mixer_is_named():
    with pytest.raises(ValueError, match="algorithm.mixer='max'"):
        make_mixer("max", FEATURES)
