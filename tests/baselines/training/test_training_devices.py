"""What `tests/gpu` does on a GPU, on a processor: training in bf16, and acting."""

import devices
import pytest


@pytest.mark.parametrize("name", devices.CHANGES)
def test_a_run_in_bf16_is_broken_off_goes_on_and_acts(folder, tmp_path, name):
    devices.check(folder, tmp_path, name, "bf16", "cpu")
