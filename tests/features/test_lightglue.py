"""LightGlue, with weights that make it match descriptors that are the same."""

import pytest
import torch
from kornia.feature import LightGlue

from torchrefrac.commands.pairs import ChosenPairs
from torchrefrac.commands.photographs import match_pairs
from torchrefrac.config import OptionError, Options
from torchrefrac.features import Features, MatchOptions, NetworkOptions
from torchrefrac.features.lightglue import match_by_lightglue
from torchrefrac.recorder import SilentRecorder


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(1)
    model = LightGlue(features=None, input_dim=8)
    for layer in model.transformers:  # nothing is exchanged: what goes in comes out
        for part in (layer.self_attn.ffn[-1], layer.cross_attn.ffn[-1]):
            torch.nn.init.zeros_(part.weight)
            torch.nn.init.zeros_(part.bias)
    for layer in model.log_assignment:
        layer.final_proj.weight.data.mul_(30.0)
        layer.matchability.bias.data.fill_(20.0)
    path = tmp_path_factory.mktemp("lightglue") / "weights.pth"
    torch.save(model.state_dict(), path)
    return str(path)


def _features(descriptors, pixels):
    count = len(pixels)
    return Features(pixels, descriptors, torch.zeros(count, 3, dtype=torch.uint8), torch.ones(count).double())


def test_keypoints_of_the_same_descriptors_match(weights, draw):
    pixels = draw.uniform(0.0, 100.0, 30, 2)
    descriptors = torch.nn.functional.normalize(draw.normal(30, 8).float(), dim=1)
    order = torch.randperm(30, generator=draw.generator)
    first, second = _features(descriptors, pixels), _features(descriptors[order], pixels[order])

    found = match_by_lightglue(
        first, second, ((100, 100), (100, 100)), MatchOptions(matcher="lightglue", weights=weights), torch.device("cpu")
    )

    assert len(found) > 20
    assert torch.equal(order[found[:, 1]], found[:, 0])


def test_pairs_of_photographs_are_matched_by_it(weights, draw):
    descriptors = torch.nn.functional.normalize(draw.normal(20, 8).float(), dim=1)
    features = [_features(descriptors, draw.uniform(0.0, 90.0, 20, 2)) for _ in range(3)]
    chosen = ChosenPairs(torch.tensor([[0, 2], [1, 2]]), "exhaustive", 3)
    options = MatchOptions(matcher="lightglue", weights=weights)

    pairs = match_pairs(features, chosen, options, SilentRecorder(), device="cpu", sizes=[(90, 90)] * 3)

    assert [(pair.first, pair.second) for pair in pairs] == [(0, 2), (1, 2)]
    assert all(len(pair) > 10 and torch.equal(pair.matches[:, 0], pair.matches[:, 1]) for pair in pairs)


def test_an_image_without_keypoints_has_no_matches(weights, draw):
    some = _features(torch.eye(8), draw.uniform(0.0, 9.0, 8, 2))
    none = _features(torch.zeros(0, 8), torch.zeros(0, 2, dtype=torch.float64))

    options = MatchOptions(matcher="lightglue", weights=weights)
    assert match_by_lightglue(some, none, ((9, 9), (9, 9)), options, torch.device("cpu")).shape == (0, 2)


def test_lightglue_takes_the_keypoints_that_it_was_trained_on():
    aliked = MatchOptions(matcher="lightglue", trained_on="aliked")

    assert Options(features=NetworkOptions("kornia_aliked"), matching=aliked).matching is aliked
    with pytest.raises(OptionError, match=r"trained on kornia_aliked, but features\.method is 'sift'"):
        Options(matching=aliked)
