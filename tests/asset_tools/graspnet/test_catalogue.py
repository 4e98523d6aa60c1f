import re

import pytest

from asset_tools.graspnet.catalogue import ENTRIES, find_catalogue_entry

# numbers in the configurations of RoboCAS-v0
V0_NUMBERS = [
    1,
    2,
    3,
    4,
    5,
    7,
    8,
    9,
    10,
    12,
    13,
    14,
    15,
    16,
    17,
    20,
    21,
    24,
    25,
    31,
    32,
    34,
    35,
    36,
    37,
    38,
    39,
    40,
    41,
]
V0_NUMBERS += [42, 44, 47, 51, 52, 53, 54, 57, 58, 59, 61, 62, 63, 64, 65, 66, 71]


def test_the_46_objects_have_unique_ids():
    assert list(ENTRIES) == V0_NUMBERS
    assert len({entry.id for entry in ENTRIES.values()}) == 46
    for number, entry in ENTRIES.items():
        assert entry.number == number
        assert re.fullmatch(r"[a-z0-9_]+", entry.id)
        assert 0.02 <= entry.mass <= 0.9


def test_other_objects_are_named_by_their_number():
    assert find_catalogue_entry(2).id == "tomato_soup_can"
    assert find_catalogue_entry(2).folder_name == "002"
    assert find_catalogue_entry(6).id == "graspnet_006"
    assert find_catalogue_entry(87).mass is None
    with pytest.raises(ValueError, match="88"):
        find_catalogue_entry(88)
