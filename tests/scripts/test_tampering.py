"""Every forgery of the benchmark is found by the check that is expected for it."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "tampering.py"


@pytest.mark.slow
def test_forgeries_are_found_by_the_expected_checks(tmp_path, capsys):
    spec = importlib.util.spec_from_file_location("tampering", SCRIPT)
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = script  # for its dataclass
    spec.loader.exec_module(script)
    script.main(script.Benchmark(tmp_path, fields=False))  # ends with an error if a check differs
    found = json.loads(capsys.readouterr().out)["found"]["forgeries"]
    assert sum(found.values()) == len(script.FORGERIES) >= 20
    assert found["none"] == 1, "a repeated line changes nothing"
