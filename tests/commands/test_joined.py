"""Photographs of two groups, no two of which are matched, in one scene by the positions of some of them."""

from dataclasses import replace
from itertools import combinations

import torch

from torchrefrac.commands.reconstruct import reconstruct
from torchrefrac.config import Options
from torchrefrac.features import MatchOptions
from torchrefrac.files.capture import load_capture
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.truth import load_truth

LEVEL, SIGMA = 50.0, 0.05


def test_positions_of_two_photographs_in_each_group_make_one_scene(tmp_path, draw):
    folder, listed, views = embedded_scene("tank_small"), tmp_path / "pairs.txt", [0, 1, 2, 5, 6, 7]
    capture, true = load_capture(folder).of_views(views), load_truth(folder).center[views]
    pairs = [*combinations(capture.names[:3], 2), *combinations(capture.names[3:], 2)]
    listed.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")
    known = torch.tensor([True, False, True, True, False, True])[:, None].expand(-1, 3)
    stated = true + torch.tensor((0.0, 0.0, LEVEL)) + SIGMA * draw.normal(6, 3)
    capture = replace(capture, position=stated, position_sigma=torch.where(known, SIGMA, torch.inf).double())

    scene = reconstruct(capture, Options(matching=MatchOptions(pairs=str(listed))))

    assert scene.views.registered.all()
    assert scene.further == ()
    lift = torch.tensor((0.0, 0.0, (scene.assessment.lowered_by or 0.0) - LEVEL))
    off = scene.views.center + lift - true
    assert off.norm(dim=-1).max() < 4.0 * SIGMA
    assert not scene.findings
