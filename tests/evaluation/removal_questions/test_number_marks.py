"""Numbers drawn into images."""

from __future__ import annotations

import numpy as np

from robocas_ms3.evaluation.removal_questions.marks import draw_numbers, find_inner_pixel
from robocas_ms3.evaluation.removal_questions.question_renderer import number_slots


def test_inner_pixel_is_the_middle_of_the_widest_part():
    mask = np.zeros((12, 20), bool)
    mask[2:9, 3:10] = True  # 7 x 7 with the middle (5, 6)
    mask[5, 10:18] = True  # a thin part, which moves the mean
    assert find_inner_pixel(mask) == (5, 6)


def test_border_of_the_image_counts_as_an_edge():
    assert find_inner_pixel(np.ones((5, 5), bool)) == (2, 2)


def test_number_is_drawn_at_its_mask_only():
    image, mask = np.full((100, 200, 3), 128, np.uint8), np.zeros((100, 200), bool)
    mask[40:61, 140:161] = True
    marked = draw_numbers(image, {7: mask})
    changed = np.argwhere((marked != image).any(axis=2))
    assert changed.min(axis=0).tolist() >= [50 - 16, 150 - 16]
    assert (changed.max(axis=0) <= [50 + 16, 150 + 16]).all()
    assert (image == 128).all()  # the image itself stays
    assert not np.array_equal(marked, draw_numbers(image, {1: mask}))


def test_circle_at_the_border_is_inside_the_image():
    image, mask = np.full((100, 200, 3), 128, np.uint8), np.zeros((100, 200), bool)
    mask[0, 0] = True
    marked = draw_numbers(image, {1: mask})
    assert (marked[:30, :30] != 128).any(axis=2).sum() > 500  # a whole circle with a radius of 14 pixels


def test_numbers_start_at_one_and_depend_on_the_seed_only():
    numbers = number_slots([2, 5, 7, 9], 3)
    assert sorted(numbers) == [2, 5, 7, 9]
    assert sorted(numbers.values()) == [1, 2, 3, 4]
    assert number_slots([2, 5, 7, 9], 3) == numbers
    assert len({tuple(number_slots([2, 5, 7, 9], seed).values()) for seed in range(20)}) > 5
