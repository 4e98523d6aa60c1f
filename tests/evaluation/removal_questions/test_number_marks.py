"""Numbers drawn into images."""

from __future__ import annotations

import numpy as np

from robocas_ms3.evaluation.removal_questions.marks import draw_numbers, find_inner_pixel
from robocas_ms3.evaluation.removal_questions.question_renderer import number_slots


def make_mask(rows: slice, columns: slice) -> np.ndarray:
    mask = np.zeros((100, 200), bool)
    mask[rows, columns] = True
    return mask


def find_changes(image: np.ndarray, marked: np.ndarray) -> np.ndarray:
    return (marked != image).any(axis=2)


IMAGE = np.full((100, 200, 3), 128, np.uint8)


def test_inner_pixel_is_the_middle_of_the_widest_part():
    mask = np.zeros((12, 20), bool)
    mask[2:9, 3:10] = True  # 7 x 7 with the middle (5, 6)
    mask[5, 10:18] = True  # a thin part, which moves the mean
    assert find_inner_pixel(mask) == (5, 6)


def test_border_of_the_image_counts_as_an_edge():
    assert find_inner_pixel(np.ones((5, 5), bool)) == (2, 2)


def test_number_is_drawn_at_its_mask_only():
    mask = make_mask(slice(40, 61), slice(140, 161))
    marked = draw_numbers(IMAGE, {7: mask})
    rows, columns = np.nonzero(find_changes(IMAGE, marked))
    assert (rows.min(), columns.min()) >= (37, 137)
    assert 37 <= rows.min() <= rows.max() <= 63
    assert 137 <= columns.min() <= columns.max() <= 163
    assert (IMAGE == 128).all()  # the image itself stays
    assert not np.array_equal(marked, draw_numbers(IMAGE, {1: mask}))


def test_circles_of_touching_objects_do_not_overlap():
    """The middle of the large object is covered by the circle of the small object on it."""
    small, large = make_mask(slice(40, 60), slice(90, 110)), make_mask(slice(5, 95), slice(5, 195))
    large &= ~small
    alone = find_changes(IMAGE, draw_numbers(IMAGE, {1: small}))
    both = find_changes(IMAGE, draw_numbers(IMAGE, {1: small, 2: large}))
    assert both.sum() > 1.9 * alone.sum()  # two whole circles
    assert both[alone].all()


def test_numbers_start_at_one_and_depend_on_the_seed():
    numbers = number_slots([2, 5, 7, 9], 3)
    assert sorted(numbers) == [2, 5, 7, 9]
    assert sorted(numbers.values()) == [1, 2, 3, 4]
    assert number_slots([2, 5, 7, 9], 3) == numbers
    assert len({tuple(number_slots([2, 5, 7, 9], seed).values()) for seed in range(20)}) > 5
