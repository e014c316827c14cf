"""Centerlines drawn into an image: what can be checked in the head."""

from __future__ import annotations

import torch
from torch import Tensor

from eqrt.training.networks.raster import RasterEncoder, densify, draw, samples_per_step


def image_of(lines: list[list[tuple[float, float]]], per_step: int = 1) -> Tensor:
    """8 x 8 cells of one metre; (0, 0) is the middle of cell [4, 4]."""
    points = torch.tensor(lines)[None]
    valid = torch.ones(points.shape[:3], dtype=torch.bool)
    return draw(points, valid, 8, 1.0, per_step)[0]


def cells(image: Tensor) -> list[tuple[int, int]]:
    """(row, column) of the cells that are drawn."""
    return [(cell // 8, cell % 8) for cell in image.flatten().nonzero().flatten().tolist()]


def test_a_point_is_one_cell_and_x_is_the_column() -> None:
    assert cells(image_of([[(0.0, 0.0)]])) == [(4, 4)]
    assert cells(image_of([[(2.0, -1.0)]])) == [(3, 6)]


def test_a_cell_reaches_half_its_size_to_each_side() -> None:
    assert cells(image_of([[(0.49, -0.49)]])) == [(4, 4)]
    assert cells(image_of([[(0.51, -0.51)]])) == [(3, 5)]


def test_lines_are_drawn_without_gaps() -> None:
    assert cells(image_of([[(-2.0, 0.0), (2.0, 0.0)]], per_step=4)) == [(4, c) for c in range(2, 7)]


def test_what_lies_outside_the_image_is_not_drawn() -> None:
    assert cells(image_of([[(3.4, 0.0), (3.6, 0.0), (0.0, -4.6), (-1e6, 1e6)]])) == [(4, 7)]


def test_points_that_cross_are_drawn_once() -> None:
    image = image_of([[(0.0, 0.0), (1.0, 0.0)], [(0.0, 0.0), (0.0, 1.0)]])
    assert cells(image) == [(4, 4), (4, 5), (5, 4)]
    assert image.max() == 1.0


def test_nothing_is_drawn_where_not_valid_nor_towards_it() -> None:
    points = torch.tensor([[[[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]]]])
    valid = torch.tensor([[[True, True, False]]])
    assert cells(draw(points, valid, 8, 1.0, 2)[0]) == [(4, 4), (4, 5), (4, 6)]
    assert cells(draw(points, valid & False, 8, 1.0, 2)[0]) == []


def test_every_scene_of_a_batch_has_its_own_image() -> None:
    points = torch.tensor([[[[0.0, 0.0]]], [[[1.0, 1.0]]]])
    images = draw(points, torch.ones(2, 1, 1, dtype=torch.bool), 8, 1.0, 1)
    assert [cells(image) for image in images] == [[(4, 4)], [(5, 5)]]


def test_a_scene_without_finite_positions_leaves_the_others_alone() -> None:
    points = torch.tensor([[[[float("inf"), float("nan")]]], [[[1.0, 1.0]]]])
    images = draw(points, torch.ones(2, 1, 1, dtype=torch.bool), 8, 1.0, 1)
    assert [cells(image) for image in images] == [[], [(5, 5)]]


def test_samples_lie_between_valid_neighbours() -> None:
    points = torch.tensor([[[[0.0, 0.0], [3.0, 0.0]]]])
    samples, valid = densify(points, torch.ones(1, 1, 2, dtype=torch.bool), 3)
    assert sorted(samples[0, :, 0].tolist()) == [0.0, 1.0, 2.0, 3.0]
    assert valid.all()


def test_samples_of_the_papers_lines_are_at_most_a_cell_apart() -> None:
    assert samples_per_step(100, 0.5) == 3  # points of a 100 m line are 1.01 m apart
    assert samples_per_step(16, 0.5) == 14
    assert samples_per_step(2, 500.0) == 1


def test_the_encoder_reads_the_image() -> None:
    torch.manual_seed(1)
    encoder = RasterEncoder(8, 1.0, 2, 3, [16, 5])
    valid = torch.ones(2, 1, 2, dtype=torch.bool)
    here = torch.tensor([[[[0.0, 0.0], [2.0, 0.0]]]])
    feature = encoder(torch.cat([here, here + 1.0]), valid)
    assert feature.shape == (2, 5)
    assert (feature[0] - feature[1]).abs().max() > 1e-6
