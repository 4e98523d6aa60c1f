"""Rules for the specification of every task."""

import inspect

import pytest

from robocas_ms3.core.errors import ConfigError
from robocas_ms3.core.extensions import import_object
from robocas_ms3.scenes.config import load_config_for
from robocas_ms3.scenes.language.texts import Templates
from robocas_ms3.scenes.targets import TargetRule
from robocas_ms3.scenes.task_specs import TASKS


@pytest.mark.parametrize("spec", TASKS.values(), ids=list(TASKS))
def test_import_paths_of_a_task_spec_exist(spec):
    assert TASKS[spec.name] is spec
    assert load_config_for(spec).task == spec.name
    assert isinstance(import_object(spec.target), TargetRule)
    assert import_object(spec.env).SPEC is spec
    assert list(inspect.signature(import_object(spec.solver)).parameters) == ["arm"]
    for check in spec.checks:
        import_object(check)(load_config_for(spec))
    assert Templates.for_task(spec).upstream


@pytest.mark.parametrize(
    ("name", "standard", "slow"), [("pick", 800, 200), ("search", 2400, 600), ("open_pick", 2000, 500)]
)
def test_horizon_in_seconds_is_independent_of_the_rate(name, standard, slow):
    assert (TASKS[name].max_episode_steps, TASKS[name].horizon_steps(5)) == (standard, slow)


def test_configuration_of_another_task_is_an_error():
    with pytest.raises(ConfigError, match=r"RoboCASPick-v1 can't run .*select_table_orderly .expected task: pick"):
        load_config_for(TASKS["pick"], "select_table_orderly")
