"""Tests marked `faults` run real commands for hours: only where they are asked for, as scripts/faults.sh does."""


def pytest_collection_modifyitems(config, items):
    if "faults" in (config.option.markexpr or ""):
        return
    whole = [item for item in items if item.get_closest_marker("faults")]
    config.hook.pytest_deselected(items=whole)
    items[:] = [item for item in items if not item.get_closest_marker("faults")]
