import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from managing import change
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import DatasetError
from robocas_ms3.datasets.actions import compute_action_space
from robocas_ms3.datasets.conversion.data_info import write_data_info
from robocas_ms3.datasets.sources.split import split_by_seed


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 300), min_size=1, max_size=200))
def test_split_is_nine_to_one_and_keeps_seeds_together(seeds):
    by_number = dict(enumerate(seeds))
    train, val = split_by_seed(by_number)
    assert sorted(train + val) == list(by_number)
    train_seeds, val_seeds = ({by_number[n] for n in part} for part in (train, val))
    assert not train_seeds & val_seeds
    count = len(set(seeds))
    assert len(val_seeds) == (0 if count == 1 else max(1, round(count / 10)))


def test_split_depends_only_on_the_seeds():
    seeds = {n: 100 + n for n in range(40)}
    backwards = {n: 139 - n for n in range(40)}
    chosen = {seeds[n] for n in split_by_seed(seeds)[1]}
    assert chosen == {backwards[n] for n in split_by_seed(backwards)[1]}
    assert len(chosen) == 4


def test_action_space_by_hand():
    # 0..100 and one last row that does not count: percentiles 1 and 99 are the values 1 and 99.
    positions = np.zeros((102, 3))
    positions[:101, 0] = np.arange(101)
    positions[101, 0] = 1e6
    turns = np.zeros((102, 3))
    turns[:101, 2] = np.linspace(-1, 1, 101)
    ranges = compute_action_space([positions], [Rotation.from_euler("xyz", turns).as_quat()])
    np.testing.assert_allclose(ranges["relative_position"], [[1, 0, 0], [99, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(ranges["relative_rotation"], [[0, 0, -0.98], [0, 0, 0.98]], atol=1e-12)


@pytest.mark.parametrize(
    ("new", "place"),
    [
        ({"rel_pos": np.full((7, 3), np.nan)}, "episode_0000001/episode_info.npz, rel_pos"),
        ({"rel_orn": np.full((7, 4), np.inf)}, "episode_0000001/episode_info.npz, rel_orn"),
        ({"rel_orn": np.zeros((7, 4))}, "data_info.json, action_space"),
        ({"rel_pos": np.zeros((1, 3)), "rel_orn": np.array([[0, 0, 0, 1.0]])}, "data_info.json, action_space"),
    ],
)
def test_data_info_never_has_nan(dataset, new, place):
    for number in (0, 1)[place.startswith("episode") :]:
        change(dataset / f"episode_000000{number}", **new)
    before = (dataset / "data_info.json").read_bytes()
    with pytest.raises(DatasetError) as error:
        write_data_info(dataset)
    assert str(error.value.where) == f"{dataset}/{place}"
    assert (dataset / "data_info.json").read_bytes() == before
