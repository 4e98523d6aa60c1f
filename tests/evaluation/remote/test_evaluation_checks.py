"""A served policy checks the robot and the scenes of an evaluation before its first episode."""

import pytest

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

from remote_ends import RecordingPolicy, serve_answer, serving

from robocas_ms3.core.errors import EvaluationError, TrainingError
from robocas_ms3.evaluation.policies import make_policy
from robocas_ms3.evaluation.remote.wire import encode_message
from robocas_ms3.scenes.config import load_task_config

CONFIG = load_task_config("pick_table_scattered")


class CheckingPolicy(RecordingPolicy):
    """Policy for one robot that was trained in no scene."""

    def __init__(self):
        super().__init__()
        self.configs = {}

    def check_robot(self, robot):
        if robot != "panda":
            raise TrainingError("this robot has no inverse kinematics", where=robot)

    def protocol_warnings(self, configs):
        self.configs |= configs
        return [f"not trained for {', '.join(configs)}"]

    def list_training_differences(self, configs):
        return {name: ["task pick"] for name in configs}


def test_the_served_policy_gets_robot_and_configurations():
    policy = CheckingPolicy()
    with serving(policy) as url:
        remote = make_policy(url)
        remote.check_robot("panda")
        with pytest.raises(EvaluationError, match="no inverse kinematics"):
            remote.check_robot("hook")
        assert remote.protocol_warnings({"table": CONFIG}) == ["not trained for table"]
        assert remote.list_training_differences({"table": CONFIG}) == {"table": ["task pick"]}
        remote.close()
    assert policy.configs == {"table": CONFIG} and policy.episodes == []


def test_a_policy_or_server_without_checks_accepts_everything():
    with serving(RecordingPolicy()) as url, serve_answer(lambda socket, data: pytest.fail("a request")) as plain:
        for address in (url, plain):
            remote = make_policy(address)
            remote.check_robot("hook")
            assert remote.protocol_warnings({"table": CONFIG}) == []
            assert remote.list_training_differences({"table": CONFIG}) is None
            remote.close()


def test_scenes_that_the_server_does_not_know_are_not_compared():
    policy = CheckingPolicy()
    with serving(policy) as url:
        remote = make_policy(url)
        assert remote.list_training_differences({"table": CONFIG.model_copy(update={"room": None})}) is None
        assert remote.protocol_warnings({"table": CONFIG.model_copy(update={"room": None})}) == []
        remote.close()
    assert policy.configs == {}


@pytest.mark.parametrize("answer", [{"warnings": "text"}, {"training_differences": {"table": [1]}}, ["a list"]])
def test_invalid_answers_are_errors(answer):
    with serve_answer(encode_message(answer), {"robocas_checks_evaluations": True}) as url:
        remote = make_policy(url)
        with pytest.raises(EvaluationError, match="invalid answer"):
            remote.protocol_warnings({"table": CONFIG})
        remote.close()
