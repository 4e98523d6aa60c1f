"""Select tests marked `faults`, which take hours, only with `-m faults`, as scripts/faults.sh does."""


def pytest_collection_modifyitems(config, items):
    if "faults" in (config.option.markexpr or ""):
        return
    whole = [item for item in items if item.get_closest_marker("faults")]
    config.hook.pytest_deselected(items=whole)
    items[:] = [item for item in items if not item.get_closest_marker("faults")]
